"""`mapless-server calibrate`: its flags. Imports what it needs when it runs, so that --help answers at once."""

from pathlib import Path
from typing import Annotated

import typer

from mapless_tools.connection import Connection, with_flags
from mapless_tools.ingest.command import FORMAT_NAMES

OUTPUT = Path("calibration-output")


@with_flags
def calibrate_command(
    folder: Annotated[
        Path | None, typer.Argument(help="Folder with photographs and their poses; not needed with --clear.")
    ] = None,
    scene: Annotated[
        str,
        typer.Option(
            help="Id of the scene to calibrate, in whose world the folder's poses are. Default: the folder is measured "
            "by itself, on a server of its own, and nothing is stored."
        ),
    ] = "",
    layout: Annotated[
        str, typer.Option("--layout", "--format", help=f"Layout of the folder: {FORMAT_NAMES}.")
    ] = "auto",
    references: Annotated[
        int | None,
        typer.Option(help="Without --scene: references, evenly spread over the photographs; default: leave one out."),
    ] = None,
    query_count: Annotated[
        int | None, typer.Option(help="Photographs to localize, evenly spread; default: all, or 40 with --references.")
    ] = None,
    k: Annotated[int, typer.Option(help="References that a photograph is compared with.")] = 10,
    variant: Annotated[str, typer.Option(help="Form of the method: coarse, no_structure, full or best.")] = "best",
    right_cm: Annotated[float, typer.Option(help="A right answer is at most this far off.")] = 10.0,
    right_deg: Annotated[float, typer.Option(help="And turned by this at most, degrees.")] = 5.0,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="With --scene: measure, store nothing.")] = False,
    clear: Annotated[bool, typer.Option("--clear", help="Remove the calibration of --scene; measures nothing.")] = (
        False
    ),
    output: Annotated[Path, typer.Option(help="Folder for report.html and report.json.")] = OUTPUT,
    *,
    connection: Connection,
) -> None:
    """Measure how often the truth lies within the radii that answers claim, and store factors that correct them.

    With --scene, photographs with known poses are localized in a scene that is there, none of them compared with
    itself; the factors by which its answers' radii are wrong are stored with it, and from then on its answers are
    calibrated. Exit code 1 when there is nothing to calibrate from.
    """
    from mapless_tools.evaluate.plan import EvaluationOptions
    from mapless_tools.usage import UsageError, failures_end_command, usage_errors

    from .findings import RightRule
    from .run import CalibrateOptions, calibrate, clear_calibration

    with failures_end_command(interrupted="interrupted; nothing is stored"):
        if clear:
            clear_calibration(folder, scene, connection)
            print(f"answers in scene {scene} are uncalibrated now")
            return
        if folder is None:
            raise UsageError("name the folder with photographs and their poses")
        with usage_errors():
            options = CalibrateOptions(
                scene=scene,
                layout=layout,
                evaluation=EvaluationOptions(references, query_count, k, variant),
                right=RightRule(right_cm / 100, right_deg),
                dry_run=dry_run,
            )
        calibrated = calibrate(folder, options, connection, output)
    raise typer.Exit(0 if calibrated else 1)
