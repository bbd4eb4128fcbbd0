"""Global descriptors of a large scene, in blocks, and of photographs that were not among its references.

Evenly distributed vectors would measure nothing: all are equally far from one another. Both sets here have places, and
views of a place that resemble one another more, the nearer they are.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapless_server.images import ImageLimits
from mapless_server.scenes.retrieval.vlad import DIMENSION, VladDescriptor
from mapless_server.serve.features import make_first_features
from mapless_server.settings import load_settings
from mapless_tools.ingest.formats.cameras import read_folder

Floats = NDArray[np.float32]

BLOCK = 10_000
"""References that are made at a time."""
QUERIED_BLOCKS = 10
VIEWS = 500
"""References at a planted place."""
PLACE_SHARE = 0.6
"""Similarity of two views of a planted place that are far apart: in the photographs 0.4 to 0.8."""
NEXT_SIMILARITY = 0.9
"""Similarity of a view and the next one: in the photographs, 0.8 to 0.95 where they are a video."""
LEAST_SIMILARITY, MOST_SIMILARITY = 0.6, 0.95
"""Of a changed descriptor and that of the photograph: of neighbouring photographs of a folder it is 0.4 to 0.95 in the
median, 0.8 in the middle of the folders."""
SEEN_CHANGES = 4
"""Differences between neighbouring photographs that a change is mixed of."""
UNSEEN_SHARE = 0.5
"""Length of the part of a change in any direction, as a share of the part that is mixed of them."""
HELD_OUT = 5
"""One in so many photographs is a query, and none of the references is made of it."""


@dataclass(frozen=True, eq=False)
class Vectors:
    """Descriptors of references, and of queries.

    Attributes:
        title: what they are.
        queries: (Q, D), unit length.
        blocks: makes those of the references, (`BLOCK`, D), unit length, the same each time.
    """

    title: str
    queries: Floats
    blocks: Callable[[], Iterator[Floats]]


def planted(count: int, seed: int) -> Vectors:
    """Places with views along a path, by an autoregressive process; queries are further views beside the paths."""
    own = (NEXT_SIMILARITY - PLACE_SHARE) / (1 - PLACE_SHARE)
    place_count = BLOCK // VIEWS

    def block(first: int) -> tuple[Floats, Floats]:
        """The views (BLOCK, D) of some places, and a query at each (P, D)."""
        random = np.random.default_rng([seed, first])
        centres = np.sqrt(PLACE_SHARE) * _unit(_noise(random, place_count))
        path = np.empty((place_count, VIEWS, DIMENSION), np.float32)
        path[:, 0] = _noise(random, place_count)
        for i in range(1, VIEWS):
            path[:, i] = own * path[:, i - 1] + np.sqrt(1 - own**2) * _noise(random, place_count)
        at = path[np.arange(place_count), random.integers(VIEWS, size=place_count)]
        beside = own * at + np.sqrt(1 - own**2) * _noise(random, place_count)
        views = centres[:, None] + np.sqrt(1 - PLACE_SHARE) * path
        return _unit(views.reshape(BLOCK, DIMENSION)), _unit(centres + np.sqrt(1 - PLACE_SHARE) * beside)

    firsts = range(0, count, BLOCK)
    some = np.unique(np.linspace(0, len(firsts) - 1, min(len(firsts), QUERIED_BLOCKS)).round().astype(int))
    queries = np.concatenate([block(firsts[i])[1] for i in some])
    return Vectors("planted places", queries, lambda: (block(first)[0] for first in firsts))


def photographed(data: Path, count: int, seed: int) -> Vectors:
    """Those of photographs in folders with cameras.json, each changed many times; every fifth photograph is a query."""
    by_folder = _described(data)
    references = [it[np.arange(len(it)) % HELD_OUT != 2] for it in by_folder]
    queries = np.concatenate([it[np.arange(len(it)) % HELD_OUT == 2] for it in by_folder])
    differences = np.concatenate([it[1:] - it[:-1] for it in references])
    differences = _unit(differences[np.linalg.norm(differences, axis=1) > 1e-3])
    everything = np.concatenate(references)

    def block(first: int) -> Floats:
        random = np.random.default_rng([seed, first])
        of = everything[random.integers(len(everything), size=BLOCK)]
        chosen = differences[random.integers(len(differences), size=(SEEN_CHANGES, BLOCK))]
        change = _unit((chosen * random.standard_normal((SEEN_CHANGES, BLOCK, 1), np.float32)).sum(axis=0))
        change += UNSEEN_SHARE * _unit(random.standard_normal((BLOCK, DIMENSION), np.float32))
        change = _unit(change - (change * of).sum(axis=1, keepdims=True) * of)
        similarity = random.uniform(LEAST_SIMILARITY, MOST_SIMILARITY, (BLOCK, 1)).astype(np.float32)
        return np.asarray(similarity * of + np.sqrt(1 - similarity**2) * change, np.float32)

    title = f"{len(everything)} photographs with changes"
    return Vectors(title, queries, lambda: (block(first) for first in range(0, count, BLOCK)))


def _described(data: Path) -> list[Floats]:
    """Descriptors (N, D) of the photographs of each folder, in the order of their names."""
    _, extractor = make_first_features(load_settings({}).settings)
    descriptor, limits = VladDescriptor.of(extractor), ImageLimits()
    folders = sorted(it.parent for it in data.glob("*/cameras.json"))
    return [
        np.array([descriptor.describe(frame.described(extractor, limits)) for frame in read_folder(it).frames])
        for it in folders
    ]


def _noise(random: np.random.Generator, count: int) -> Floats:
    """Random vectors (N, D) of about unit length, whose numbers decrease as the principal components of photographs."""
    deviations = np.arange(1, DIMENSION + 1) ** -0.5
    deviations /= np.linalg.norm(deviations)
    return random.standard_normal((count, DIMENSION), np.float32) * deviations.astype(np.float32)


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True), np.float32)
