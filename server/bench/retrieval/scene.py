"""A store with a scene of many references, whose poses and descriptors are what retrieval needs of them."""

from __future__ import annotations

import uuid
from dataclasses import dataclass, field
from functools import cache

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform
from mapless.provenance import GIVEN_POSE
from mapless_server.method.features.views import Features, View
from mapless_server.scenes.retrieval.quantizing import quantized
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store, changes, rows
from mapless_server.store.codec import encode_geometry, sha256_for

from .vectors import Floats, Vectors

SCENE, DESCRIPTOR = SceneKey("large"), "measured"
BEST = 10
SIDE_M, POINTS = 300.0, 100
"""References stand on a square lattice of this side, with so many points along it, one after the other."""
_INSERT_REFERENCE = (
    "INSERT INTO reference (key, scene_id, reference_id, geometry, geometry_sha256, image_sha256, feature_count, "
    "create_time_us, generation) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)"
)
_INSERT_DESCRIPTOR = "INSERT INTO global_descriptor (reference_key, name, data, sha256) VALUES (?, ?, ?, ?)"
_NO_SHA256 = "0" * 64

_CAMERA = Camera(64, 64, 64.0, 64.0, 31.5, 31.5)
_NO_FEATURES = View(_CAMERA, Features(np.empty((0, 2), np.float32), np.empty((0, 8), np.int8), np.empty(0, np.float32)))


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
    """The reference of a number, as a caller adds it."""
    pose = RigidTransform(np.eye(3), np.array([*_place(number), 0.0]))
    return NewReference(f"r{number:08d}", b"photograph", _CAMERA, pose, {"none": _NO_FEATURES}, {DESCRIPTOR: vector})


def _place(number: int) -> tuple[float, float]:
    """Where the reference of a number stands, metres: on the lattice's next point."""
    column, row = divmod(number % POINTS**2, POINTS)
    return column * SIDE_M / POINTS, row * SIDE_M / POINTS


@cache
def _geometry(x_m: float, y_m: float) -> bytes:
    return encode_geometry(_CAMERA, RigidTransform(np.eye(3), np.array([x_m, y_m, 0.0])), GIVEN_POSE)


def number_of(reference_id: str) -> int:
    """The number in a reference's id."""
    return int(reference_id[1:])


def fill(store: Store, vectors: Vectors) -> NDArray[np.intp]:
    """Makes the scene; returns the numbers (Q, 10) of what an exact search finds for each query."""
    best, number = Best(vectors.queries), 0
    store.create_scene(SCENE)
    for block in vectors.blocks():
        best.add(number, block)
        _add(store, number, block)
        number += len(block)
    return best.numbers


def _add(store: Store, first: int, vectors: Floats) -> None:
    """Adds references (N, D) without photographs and features, which retrieval does not read."""
    described = [(uuid.uuid4().hex, vector) for vector in vectors]
    with store.changing() as connection:
        generation = changes.begin_change(connection, SCENE, len(vectors))
        of_references = []
        for number, (key, _) in enumerate(described, first):
            geometry = _geometry(*_place(number))
            checked = geometry, sha256_for(key, geometry)
            of_references.append((key, SCENE, f"r{number:08d}", *checked, _NO_SHA256, 0, 0, generation))
        descriptors = [tuple(rows.descriptor_row(key, DESCRIPTOR, vector).values()) for key, vector in described]
        connection.exec_driver_sql(_INSERT_REFERENCE, of_references)
        connection.exec_driver_sql(_INSERT_DESCRIPTOR, descriptors)
