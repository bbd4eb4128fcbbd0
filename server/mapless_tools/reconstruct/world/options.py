"""The known unit of length, origin and way up of a reconstruction, and the flags that give them."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

from mapless_tools.ingest.metres import KnownDistance

FAMILIES = {
    "36h11": ("DICT_APRILTAG_36h11", 587),
    "36h10": ("DICT_APRILTAG_36h10", 2320),
    "25h9": ("DICT_APRILTAG_25h9", 35),
    "16h5": ("DICT_APRILTAG_16h5", 30),
    **{f"{n}x{n}_{count}": (f"DICT_{n}X{n}_{count}", count) for n in (4, 5, 6, 7) for count in (50, 100, 250, 1000)},
    "original": ("DICT_ARUCO_ORIGINAL", 1024),
    "mip_36h12": ("DICT_ARUCO_MIP_36h12", 250),
}
"""Families of AprilTag and ArUco: OpenCV's name of each and its number of tags."""

AXES = ("x", "y", "z", "-x", "-y", "-z")
_EXAMPLE = "36h11:0=0.16 is tag 0 of AprilTag's 36h11, whose black square is 0.16 m wide"


@dataclass(frozen=True, order=True)
class TagId:
    """A tag: its family, one of FAMILIES, and its number in it."""

    family: str
    number: int

    def __post_init__(self) -> None:
        if self.family not in FAMILIES:
            raise ValueError(f"tag {self}: unknown family; known are {', '.join(FAMILIES)}")
        count = FAMILIES[self.family][1]
        if not 0 <= self.number < count:
            raise ValueError(f"tag {self}: {self.family} has tags 0 to {count - 1}")

    def __str__(self) -> str:
        return f"{self.family}:{self.number}"


@dataclass(frozen=True)
class SizedTag:
    """A tag and the length of an edge of its black square, metres."""

    tag: TagId
    edge_m: float

    def __post_init__(self) -> None:
        if not 0 < self.edge_m < math.inf:
            raise ValueError(f"tag {self.tag}: its edge must be above 0 m, is {self.edge_m:g}")


@dataclass(frozen=True)
class WorldOptions:
    """The knowledge of a reconstruction's world; nothing by default but GPS in EXIF, where that suffices.

    `origin` is a tag of `tags`. `positions` is a CSV file of camera centres, metres (name, x, y, z), or a folder of
    photographs with metric poses in a known layout; `positions_up` is the axis that points up in them, "" if none is
    known. `gravity` is a CSV file of the direction down in cameras' axes (name, x right, y down, z forward of the
    photograph as stored), of any length.
    """

    tags: tuple[SizedTag, ...] = ()
    origin: TagId | None = None
    distances: tuple[KnownDistance, ...] = ()
    positions: Path | None = None
    positions_up: str = ""
    gravity: Path | None = None
    gps: bool = True

    def __post_init__(self) -> None:
        tags = [it.tag for it in self.tags]
        for tag in tags:
            if tags.count(tag) > 1:
                raise ValueError(f"tag {tag} is given {tags.count(tag)} times")
        if self.origin is not None and self.origin not in tags:
            raise ValueError(f"origin: tag {self.origin} needs its size, --tag {self.origin}=METRES")
        if self.origin is not None and self.positions is not None:
            raise ValueError("give one of --origin and --positions: each of them determines the axes of the world")
        if self.positions_up not in ("", *AXES):
            raise ValueError(f"positions_up must be one of {', '.join(AXES)}, not {self.positions_up!r}")
        if self.positions_up and self.positions is None:
            raise ValueError("positions_up is the axis of positions, which are not given")


def parse_tag(text: str) -> TagId:
    """Reads FAMILY:NUMBER, as 36h11:0; ValueError says what is wrong with it."""
    family, colon, number = text.strip().partition(":")
    family = family.lower().removeprefix("dict_").removeprefix("apriltag_").removeprefix("aruco_").removeprefix("tag")
    if not colon or not number.strip().isdecimal():
        raise ValueError(f"tag {text!r}: must be FAMILY:NUMBER; {_EXAMPLE}")
    return TagId(family, int(number))


def parse_sized_tag(text: str) -> SizedTag:
    """Reads FAMILY:NUMBER=METRES, as 36h11:0=0.16; ValueError says what is wrong with it."""
    tag, _, edge = text.partition("=")
    try:
        edge_m = float(edge)
    except ValueError:
        raise ValueError(f"tag {text!r}: must be FAMILY:NUMBER=METRES; {_EXAMPLE}") from None
    return SizedTag(parse_tag(tag), edge_m)
