"""Checks what is given of a reconstruction's world before anything is computed."""

from collections.abc import Collection

import numpy as np

from mapless_tools.ingest.metres import Finder, Located

from ..pictures import Picture, Pictures
from .down import known_directions
from .options import WorldOptions
from .positions import MIN_POSITIONS, known_positions


def check_files(options: WorldOptions) -> None:
    """Raises ValueError, naming file and line, if a file of the options cannot be read or is not what it must be."""
    if options.positions is not None:
        known_positions(options.positions)
    if options.gravity is not None:
        known_directions(options.gravity)


def check_names(options: WorldOptions, pictures: Pictures) -> None:
    """Raises ValueError if names of the options are not those of photographs that take part, or too few are."""
    find = Finder([_unlocated(it) for it in pictures.chosen])
    reasons = {it.name: it.reason for it in pictures.omitted}
    for distance in options.distances:
        for name in (distance.first, distance.second):
            if name in reasons:
                raise ValueError(f"--distance: {name} takes no part: {reasons[name]}")
            if name not in find:
                raise ValueError(f"--distance: there is no photograph {name!r}; there are {_some(pictures)}")
    if options.positions is not None:
        _check_count(known_positions(options.positions)[0], find, MIN_POSITIONS, f"--positions {options.positions}")
    if options.gravity is not None:
        _check_count(known_directions(options.gravity), find, 1, f"--gravity {options.gravity}")


def _check_count(names: Collection[str], find: Finder, least: int, what: str) -> None:
    count = sum(it in find for it in names)
    if count < least:
        some = ", ".join(sorted(names)[:3])
        raise ValueError(f"{what}: {count} of its names ({some}, ...) are those of photographs; {least} are needed")


def _some(pictures: Pictures) -> str:
    return ", ".join(it.name for it in pictures.chosen[:3]) + ", ..."


def _unlocated(picture: Picture) -> Located:
    """A photograph by its names, at no place."""
    return Located(picture.name, (), tuple({picture.path.name, picture.source.name}), np.zeros(3))
