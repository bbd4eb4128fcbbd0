"""The flags of `mapless-server reconstruct`. Imports modules when it runs, so that --help is quick."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from mapless_tools.connection import with_flags

from .world.flags import WorldFlags

Frames = Annotated[int, typer.Option(help="Frames of all videos together, at most.")]
Lenses = Annotated[
    list[str] | None,
    typer.Option(
        metavar="fisheye|FILE",
        help="fisheye: all lenses are. FILE: the intrinsics of a calibrated camera (JSON), used as they are for "
        "photographs of its size. May be repeated.",
    ),
]
FeaturesName = Annotated[str, typer.Option(help="Local features, as the setting of the server names them.")]


@with_flags
def reconstruct_command(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="SOURCE... OUT",
            help="Videos, photographs and folders of photographs; then the folder to write.",
            show_default=False,
        ),
    ],
    frames: Frames = 150,
    lens: Lenses = None,
    part: Annotated[int, typer.Option(help="Which part to write, if the photographs show several places.")] = 1,
    features: FeaturesName = "auto",
    *,
    world: WorldFlags,
) -> None:
    """Compute the poses of videos and photographs that have none, and write them to a folder that can be imported.

    Run it again to go on where it was interrupted. The folder gets photographs, cameras.json, report.html and
    scene.glb, all of them or none.
    """
    from mapless_tools.usage import failures_end_command

    with failures_end_command(ValueError, interrupted="interrupted; run it again to go on"):
        from .cameras import LensOptions
        from .folder import reconstruct_into
        from .run import ReconstructOptions
        from .sources import SourceOptions

        *sources, out = paths
        wanted = SourceOptions(frames=frames, excluded=(out,))
        options = ReconstructOptions(part, features, LensOptions.of(lens or ()), world.options())
        reconstruct_into(sources, out, wanted, options)
    print(f"to localize in it: mapless-server import {out} SCENE")
