"""The command `mapless-server`. Commands import what they need when they run, so that --help answers at once."""

from __future__ import annotations

import asyncio
import logging
import os
import sys
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from . import __version__
from .settings import ConfigError, Settings, load_settings

app = typer.Typer(
    help="Visual localization without a map, as a gRPC service.",
    no_args_is_help=True,
    add_completion=False,
    # A traceback with local variables prints image bytes and secrets.
    pretty_exceptions_show_locals=False,
)


def _help(setting: str) -> str:
    return str(Settings.model_fields[setting].description)


def _print_version(wanted: bool) -> None:
    if wanted:
        print(f"mapless-server {__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: Annotated[
        bool, typer.Option("--version", callback=_print_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    pass


@app.command("serve")
def serve_command(
    config: Annotated[Path | None, typer.Option(help="TOML file of settings; also MAPLESS_CONFIG.")] = None,
    host: Annotated[str | None, typer.Option(help=_help("host"))] = None,
    port: Annotated[int | None, typer.Option(help=_help("port"))] = None,
    data_dir: Annotated[Path | None, typer.Option(help=_help("data_dir"))] = None,
    backend: Annotated[str | None, typer.Option(help=_help("backend"))] = None,
    features: Annotated[str | None, typer.Option(help=_help("features"))] = None,
    workers: Annotated[int | None, typer.Option(help=_help("workers"))] = None,
    max_waiting: Annotated[int | None, typer.Option(help=_help("max_waiting"))] = None,
    default_deadline_s: Annotated[float | None, typer.Option(help=_help("default_deadline_s"))] = None,
    max_message_mib: Annotated[int | None, typer.Option(help=_help("max_message_mib"))] = None,
    max_image_mib: Annotated[int | None, typer.Option(help=_help("max_image_mib"))] = None,
    max_image_megapixels: Annotated[float | None, typer.Option(help=_help("max_image_megapixels"))] = None,
    retrieval_max_references: Annotated[int | None, typer.Option(help=_help("retrieval_max_references"))] = None,
    reference_cache_mib: Annotated[int | None, typer.Option(help=_help("reference_cache_mib"))] = None,
    drain_grace_s: Annotated[float | None, typer.Option(help=_help("drain_grace_s"))] = None,
    reflection: Annotated[bool | None, typer.Option(help=_help("reflection"))] = None,
    log_level: Annotated[str | None, typer.Option(help=_help("log_level"))] = None,
) -> None:
    """Serve until SIGTERM. Every flag is also a setting of the file and of the environment, as MAPLESS_<FLAG>."""
    flags: dict[str, Any] = {name: value for name, value in locals().items() if name in Settings.model_fields}
    try:
        loaded = load_settings(flags, config)
    except ConfigError as error:
        _fail(str(error))
    settings = loaded.settings
    logging.basicConfig(
        level=settings.log_level.upper(), stream=sys.stderr, format="%(asctime)s %(levelname)s %(name)s: %(message)s"
    )
    logging.getLogger(__name__).info("mapless-server %s\n%s", __version__, loaded)
    _configure_libraries(settings)

    from .serve import StartupError, serve

    try:
        asyncio.run(serve(settings))
    except StartupError as error:
        _fail(str(error))


@app.command("demo")
def demo_command(
    data: Annotated[
        Path | None, typer.Option(help="Folder with images/ and cameras.json; default: a room rendered on the spot.")
    ] = None,
    output: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("demo-output"),
) -> None:
    """Localize photographs end to end, judge every answer and draw it; exit code 1 if it did not go well."""
    from mapless import MaplessError

    from .child import ServerFailed
    from .demo.run import run_demo

    try:
        went_well = run_demo(data, output)
    except (ValueError, OSError) as error:
        _fail(str(error))
    except (ServerFailed, MaplessError) as error:
        _fail(str(error), code=1)
    raise typer.Exit(0 if went_well else 1)


@app.command("evaluate")
def evaluate_command(
    folder: Annotated[Path, typer.Argument(help="Folder with images/ and cameras.json.")],
    references: Annotated[
        int | None, typer.Option(help="References, evenly spread over the frames; default: leave one out.")
    ] = None,
    queries: Annotated[
        int | None, typer.Option(help="Queries, evenly spread; default: 40, or every frame when one is left out.")
    ] = None,
    k: Annotated[int, typer.Option(help="References that a query is given.")] = 10,
    variant: Annotated[str, typer.Option(help="Form of the method: coarse, no_structure, full or best.")] = "best",
    scale: Annotated[str, typer.Option(help="Metric scale: triangulation, trajectory or two_stage.")] = "two_stage",
    json: Annotated[Path | None, typer.Option(help="File to write the figures to, with every query.")] = None,
) -> None:
    """Measure accuracy and latency on photographs with known poses, through a server of its own."""
    from mapless import MaplessError

    from .child import ServerFailed
    from .evaluation.command import evaluate_folder
    from .evaluation.plan import UsageError

    try:
        evaluate_folder(
            folder,
            json,
            reference_count=references,
            query_count=queries,
            k=k,
            variant=variant,
            scale_strategy=scale,
        )
    except UsageError as error:
        _fail(str(error))
    except (ServerFailed, MaplessError) as error:
        _fail(str(error), code=1)


@app.command("bench")
def bench_command(
    data: Annotated[Path, typer.Argument(help="Folder of the scenes' folders.")],
    quick: Annotated[bool, typer.Option(help="A few queries a scene: to see that it runs.")] = False,
) -> None:
    """Measure all scenes against their targets, and latency and memory; writes bench-output/bench.json."""
    from mapless import MaplessError

    from .bench import bench
    from .child import ServerFailed
    from .evaluation.plan import UsageError

    try:
        bench(data, quick)
    except UsageError as error:
        _fail(str(error))
    except (ServerFailed, MaplessError) as error:
        _fail(str(error), code=1)


def _configure_libraries(settings: Settings) -> None:
    """Sets what libraries read from the environment once, when they are imported; what is set already stays."""
    environment = {
        # Calls run side by side, and matching shares out its own work. The matrices are small, and BLAS threads wait
        # for one another in a busy loop: with two, on two cores of which one was taken, a call took 1.9 s, not 0.4.
        "OPENBLAS_NUM_THREADS": "1",
        "MKL_NUM_THREADS": "1",
        # Stands behind our own reading of headers.
        "OPENCV_IO_MAX_IMAGE_PIXELS": str(round(settings.max_image_megapixels * 1_000_000)),
        # What is wrong with a file or an address, we say ourselves.
        "OPENCV_LOG_LEVEL": "SILENT",
        "GRPC_VERBOSITY": "NONE",
    }
    for name, value in environment.items():
        os.environ.setdefault(name, value)


def _fail(message: str, code: int = 2) -> NoReturn:
    print(f"mapless-server: {message}", file=sys.stderr)
    raise typer.Exit(code)
