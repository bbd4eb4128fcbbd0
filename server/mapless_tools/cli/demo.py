"""`mapless-server demo`: what this installation answers."""

from pathlib import Path
from typing import Annotated

import typer


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
