"""`mapless-server demo`, `bench` and `bench-network`: what this installation answers, how accurately, and how fast."""

from pathlib import Path
from typing import Annotated

import typer

from mapless_server.serve.command import fail
from mapless_server.serve.libraries import configure_libraries
from mapless_server.settings import ConfigError, load_settings


def demo_command(
    data: Annotated[
        Path | None, typer.Option(help="Folder with images/ and cameras.json; default: mapless's own room.")
    ] = None,
    output: Annotated[Path, typer.Option(help="Folder for the pictures.")] = Path("demo-output"),
) -> None:
    """Localize photographs end to end, judge every answer and draw it; exit code 1 if it did not go well."""
    from mapless_tools.demo.run import run_demo
    from mapless_tools.usage import failures_end_command

    with failures_end_command(ValueError):
        went_well = run_demo(data, output)
    raise typer.Exit(0 if went_well else 1)


def bench_command(
    data: Annotated[Path, typer.Argument(help="Folder of the scenes' folders.")],
    quick: Annotated[bool, typer.Option(help="A few queries a scene: to see that it runs.")] = False,
) -> None:
    """Measure all scenes against their targets, and latency and memory; writes bench-output/bench.json."""
    from mapless_tools.bench import bench
    from mapless_tools.usage import failures_end_command

    with failures_end_command():
        bench(data, quick)


def bench_network_command(
    quick: Annotated[bool, typer.Option(help="Few repetitions, nothing compiled: to see that it runs.")] = False,
    only: Annotated[list[str] | None, typer.Option(help="A part to run; again for more; default: all.")] = None,
    output: Annotated[Path, typer.Option(help="Folder for network.json and network.md.")] = Path("bench-output"),
) -> None:
    """Measure the networks beside the least time that their arithmetic takes, and whole queries."""
    try:
        configure_libraries(load_settings({}).settings)
    except ConfigError as error:
        fail(str(error))

    from mapless_tools.bench_network.command import PARTS, bench_network

    unknown = [part for part in only or () if part not in PARTS]
    if unknown:
        fail(f"unknown parts {', '.join(unknown)}; known: {', '.join(PARTS)}")
    bench_network(quick, only, output)
