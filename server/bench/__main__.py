"""`python -m bench DATA`: accuracy on the real scenes against targets and against a map, and what a call costs."""

from pathlib import Path
from typing import Annotated

import typer

from mapless_tools.usage import failures_end_command


def main(
    data: Annotated[Path, typer.Argument(help="Folder of the scenes' folders.")],
    quick: Annotated[bool, typer.Option(help="A few queries a scene: to see that it runs.")] = False,
) -> None:
    """Measure all scenes against their targets, and latency and memory; writes bench-output/bench.json."""
    with failures_end_command():
        from .command import bench

        bench(data, quick)


if __name__ == "__main__":
    typer.run(main)
