"""A store with a scene of many references, whose poses and descriptors are what retrieval needs of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform
from mapless_server.method.features.views import Features, View
from mapless_server.scenes.retrieval.quantizing import quantized
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store

from .vectors import Floats, Vectors

SCENE, DESCRIPTOR = SceneKey("large"), "measured"
BEST = 10
SIDE_M = 300.0
"""References stand on a square lattice of this side."""

_CAMERA = Camera(64, 64, 64.0, 64.0, 31.5, 31.5)
_NO_FEATURES = View(_CAMERA, Features(np.empty((0, 2), np.float32), np.empty((0, 8), np.int8), np.empty(0, np.float32)))
_AT_A_TIME = 2000


@dataclass(eq=False)
class Best:
    """The numbers (Q, 10) of the references that an exact search finds first for each query, the most similar first."""

    queries: Floats
    numbers: NDArray[np.intp] = field(init=False)
    similarity: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.numbers = np.empty((len(self.queries), 0), np.intp)
        self.similarity = np.empty((len(self.queries), 0), np.float32)

    def add(self, first: int, vectors: Floats) -> None:
        """Compares further references (N, D), numbered from `first`, as the server does."""
        rows, inverse_norms = quantized(vectors.astype(np.float16).astype(np.float32))
        similarity = self.queries @ rows.astype(np.float32).T * inverse_norms
        likely = np.argpartition(-similarity, BEST, axis=1)[:, :BEST]
        numbers = np.hstack([self.numbers, likely + first])
        similarities = np.hstack([self.similarity, np.take_along_axis(similarity, likely, 1)])
        order = np.argsort(-similarities, axis=1)[:, :BEST]
        self.numbers = np.take_along_axis(numbers, order, 1)
        self.similarity = np.take_along_axis(similarities, order, 1)


def reference(number: int, vector: Floats) -> NewReference:
    """The reference of a number, on the lattice of a million."""
    x, y = divmod(number, 1000)
    pose = RigidTransform(np.eye(3), np.array([x, y, 0.0]) * SIDE_M / 1000)
    return NewReference(f"r{number:08d}", b"photograph", _CAMERA, pose, {"none": _NO_FEATURES}, {DESCRIPTOR: vector})


def number_of(reference_id: str) -> int:
    """The number in a reference's id."""
    return int(reference_id[1:])


def fill(store: Store, vectors: Vectors) -> NDArray[np.intp]:
    """Makes the scene; returns the numbers (Q, 10) of what an exact search finds for each query."""
    best, number = Best(vectors.queries), 0
    store.create_scene(SCENE)
    for block in vectors.blocks():
        best.add(number, block)
        for start in range(0, len(block), _AT_A_TIME):
            some = enumerate(block[start : start + _AT_A_TIME], number + start)
            store.add_references(SCENE, [reference(i, vector) for i, vector in some])
        number += len(block)
    return best.numbers
