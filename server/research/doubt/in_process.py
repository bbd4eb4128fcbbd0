"""Many photographs of other places, asked of the method's own modules: how many are accepted.

Features are computed once a photograph, so that a query takes a tenth of a second. The ladder has the attempts that
need no server: those with other matches and other solvers, not those with stronger features or a turned raster.
"""

from collections.abc import Iterator
from functools import cache
from pathlib import Path

from mapless_server.method.judge.answer import Localization
from mapless_tools.evaluate.plan import evenly_spread
from mapless_tools.ingest.formats.cameras import read_folder
from research.contradictions.asking import Row
from research.evidence.places import Pair, Place, answered, read_place

from .scenes import FOLDERS, crossed

QUERIES = 2000
PHOTOGRAPHS, REFERENCES = 20, 10
"""Photographs of a folder that are described, and those of them that a query is given."""


def accepted(scenes: Path, count: int = QUERIES) -> Iterator[Row]:
    """So many queries with SIFT; a row each, with its outcome "localized" or the reason of its rejection."""
    for measured in answered(_pairs(scenes, count)):
        outcome = measured.answer.outcome
        if isinstance(outcome, Localization):
            yield {"name": measured.pair.title, "outcome": "localized", "trust": outcome.trust}
        else:
            yield {"name": measured.pair.title, "outcome": outcome.reason.value}


def _pairs(scenes: Path, count: int) -> Iterator[Pair]:
    @cache
    def place_of(folder: str) -> Place:
        frames = range(len(read_folder(scenes / folder).frames))
        return read_place(scenes / folder, evenly_spread(frames, PHOTOGRAPHS))

    taken = dict.fromkeys(FOLDERS, 0)
    for folder, at in crossed(count):
        own, other = place_of(folder), place_of(at)
        indices, number = sorted(own.views), taken[folder]
        index = indices[number % len(indices)]
        taken[folder] += 1
        references = other.most_matching(own.views[index], sorted(other.views), REFERENCES)
        yield Pair(f"{folder} {index} in {at}", REFERENCES, own.views[index], other.posed(references), None)
