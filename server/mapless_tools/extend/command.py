"""The flags of `mapless-server extend`. Imports modules when it runs, so that --help is quick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapless_server.serve.command import fail
from mapless_tools.connection import Connection, Scene, with_flags
from mapless_tools.reconstruct.command import FeaturesName, Frames, Lenses


@with_flags
def extend_command(
    scene: Scene,
    photos: Annotated[
        list[Path], typer.Argument(help="Videos, photographs and folders of photographs, without poses.")
    ],
    frames: Frames = 150,
    lens: Lenses = None,
    features: FeaturesName = "auto",
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Place the photographs, store nothing.")] = False,
    report: Annotated[Path | None, typer.Option(help="JSON file for the whole report.")] = None,
    work: Annotated[
        Path | None, typer.Option(help="Folder for what an interrupted run continues; default: ./SCENE-extended.")
    ] = None,
    data_dir: Annotated[
        Path | None,
        typer.Option(help="Folder of the store, where no --address is given; default: that of the settings."),
    ] = None,
    *,
    connection: Connection,
) -> None:
    """Place photographs without poses in a scene, together, and store those that fit as references.

    The scene's references stay as they are. Run it again to go on where it was interrupted.
    """
    from mapless_server.settings import load_settings
    from mapless_tools.output_files import check_writable
    from mapless_tools.reconstruct.cameras import LensOptions
    from mapless_tools.reconstruct.run import ReconstructOptions
    from mapless_tools.reconstruct.sources import SourceOptions
    from mapless_tools.usage import failures_end_command

    from .options import ExtendOptions
    from .session import extend_scene

    with failures_end_command(ValueError, interrupted="interrupted, nothing half-made; run it again to go on"):
        if data_dir is not None and connection.address:
            raise ValueError("--data-dir is a store, --address a server: give one of them")
        if report is not None:
            check_writable(report)
        settings = load_settings({"data_dir": data_dir}).settings
        out = work or Path(f"{scene}-extended")
        sources = SourceOptions(frames=frames, excluded=(out,))
        options = ExtendOptions(ReconstructOptions(features=features, lens=LensOptions.of(lens or ())))
        trouble = extend_scene((scene, photos, out), sources, options, connection, settings, report, dry_run)
    if trouble:
        fail(trouble, code=1)
