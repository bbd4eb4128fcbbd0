"""The flags of what is known of a reconstruction's world. Imports what it needs when it runs: --help is quick."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from mapless_tools.ingest.command import DISTANCE_SEPARATOR

if TYPE_CHECKING:
    from .options import WorldOptions


@dataclass(frozen=True)
class WorldFlags:
    """Each field is a flag of a command whose class is `ImportCommand`, which joins the three values of a distance."""

    tag: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FAMILY:ID=METRES",
            help="A printed AprilTag or ArUco marker and the edge of its black square: 36h11:0=0.16, "
            "4x4_50:0=0.1. May be repeated.",
        ),
    ] = None
    origin: Annotated[
        str, typer.Option(metavar="FAMILY:ID", help="Tag whose centre is the origin; x along its top, y down its side.")
    ] = ""
    distance: Annotated[
        list[str] | None,
        typer.Option(
            metavar="A B METRES", help="Measured distance of the cameras of two photographs; may be repeated."
        ),
    ] = None
    positions: Annotated[
        Path | None,
        typer.Option(help="Known camera positions: CSV (name, x, y, z in metres), or a folder of an ARKit app."),
    ] = None
    positions_up: Annotated[str, typer.Option(help="Axis of the positions that points up: y in ARKit's worlds.")] = ""
    gravity: Annotated[
        Path | None, typer.Option(help="Direction down in cameras' axes: CSV (name, x right, y down, z forward).")
    ] = None
    gps: Annotated[bool, typer.Option("--gps/--no-gps", help="Use GPS in EXIF, where it is precise enough.")] = True

    def options(self) -> WorldOptions:
        """The options of the flags; ValueError names the flag and what is wrong with it."""
        from mapless_tools.ingest.metres import known_distance

        from .options import WorldOptions, parse_sized_tag, parse_tag

        return WorldOptions(
            tags=tuple(map(parse_sized_tag, self.tag or ())),
            origin=parse_tag(self.origin) if self.origin else None,
            distances=tuple(known_distance(*it.split(DISTANCE_SEPARATOR)) for it in self.distance or ()),
            positions=self.positions,
            positions_up=self.positions_up,
            gravity=self.gravity,
            gps=self.gps,
        )
