"""A scene's descriptors and poses in memory: updated by what has changed, read without locks.

The search is exact: every reference's similarity is computed, so nothing is missed and nothing has to be trained. It is
bounded by memory bandwidth. Descriptors are held as 8-bit integers with the norm of each row, which takes a quarter of
float32's memory in the same time (parts of the matrix are converted to float32 in the processor's cache) and changes a
similarity by less than 0.002. A reference takes D bytes and about 0.35 KB for its pose and its names: with 1024 numbers
1.4 KB, 1.4 GB for a million. One core of a busy machine ranks 1,000 references in 1 ms, 10,000 in 4 and 100,000 in 33;
a million take a third of a second.

Beyond a million references per server: distribute scenes over servers, since a query uses one scene; index the centres
by a grid, so that a position prior selects few rows; and only then search approximately (inverted file with product
quantization, the best 1,000 scored again with these rows), measured against this search.
"""

import sys
import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform
from mapless_server.method.features.views import View
from mapless_server.store import IndexedReference, SceneChanges

Vector = NDArray[np.float32]
"""(D,) of unit length, so that a dot product is a similarity, -1 to 1; zeros for a view without features."""


class GlobalDescriptor(Protocol):
    """Describes a whole photograph by one vector.

    Attributes:
        name: identifies the descriptor and everything that changes its vectors; the key of stored vectors.
        dimension: D, the length of its vectors.
        extractor: name of the local features that it is computed from; None if it uses pixels.
    """

    name: str
    dimension: int
    extractor: str | None

    def describe(self, view: View) -> Vector:
        """Computes the vector (D,) of a view, which needs its photograph if the descriptor uses pixels.

        A view without features (a blank wall) gives zeros, which are similar to nothing.
        """
        ...


Rows = NDArray[np.intp]

_CHUNK_BYTES = 1 << 20
"""Bytes of float32 that are converted at a time, so that they fit a core's cache."""

_LARGEST = 127
_SMALLEST_CAPACITY = 64
_GROWTH = 1.5


@dataclass(frozen=True, eq=False)
class _Table:
    """One row per reference. Rows are appended after those that any Entries use, and not changed except as stated.

    Attributes:
        vectors: (capacity, D) int8. A row is written once, before its norm is set.
        poses: (capacity, 3, 4), world_from_camera.
        ids, keys: ids and keys of the references, one for each row.
        row_of_key: row of each key.
        row_of_id: newest row of each id.
    """

    vectors: NDArray[np.int8]
    poses: NDArray[np.float64]
    ids: list[str]
    keys: list[str]
    row_of_key: dict[str, int]
    row_of_id: dict[str, int]

    @staticmethod
    def empty(dimension: int, capacity: int) -> "_Table":
        """Makes a table with room for this many rows."""
        return _Table(np.empty((capacity, dimension), np.int8), np.empty((capacity, 3, 4)), [], [], {}, {})

    def size_bytes(self) -> int:
        """Size of the arrays and, estimated by the first ones, of the names, bytes."""
        containers = sum(map(sys.getsizeof, (self.ids, self.keys, self.row_of_key, self.row_of_id)))
        names = sum(map(sys.getsizeof, (*self.ids[:1], *self.keys[:1]))) + sys.getsizeof(1 << 20)
        return self.vectors.nbytes + self.poses.nbytes + containers + names * len(self.ids)


@dataclass(frozen=True, eq=False)
class Entries:
    """The references of a scene at one generation; not changed by later updates."""

    generation: int
    _table: _Table
    _inverse_norms: NDArray[np.float32]
    """(n,): converts products with rows into similarities; 0 for a vector of zeros, NaN where there is none."""
    _alive: NDArray[np.bool_]
    """(n,): whether the row's reference has not been removed."""
    _count: int

    def __len__(self) -> int:
        return self._count

    def __contains__(self, reference_id: object) -> bool:
        return isinstance(reference_id, str) and self._find(reference_id) is not None

    def rows(self, among: Collection[str] | None = None) -> Rows:
        """Rows (N,) of the references, ascending; only of these ids if given."""
        if among is None:
            return np.flatnonzero(self._alive)
        found = (self._find(reference_id) for reference_id in among)
        return np.array(sorted({row for row in found if row is not None}), np.intp)

    def rows_of_keys(self, keys: Collection[str]) -> dict[str, int]:
        """Rows of the references with these keys, as far as they are here, ascending."""
        found = ((key, self._table.row_of_key.get(key, len(self._alive))) for key in keys)
        here = ((key, row) for key, row in found if row < len(self._alive) and self._alive[row])
        return dict(sorted(here, key=lambda it: it[1]))

    def similarities(self, vector: Vector, rows: Rows) -> NDArray[np.float32]:
        """Similarity (N,) of a unit vector (D,) with rows; NaN for references without a descriptor."""
        vectors = self._table.vectors
        # If most rows are wanted, all are read in order; otherwise the wanted ones are gathered.
        is_dense = len(rows) > len(self._alive) // 2
        first, last = (0, len(self._alive)) if is_dense else (0, len(rows))
        products = np.empty(last, np.float32)
        step = max(1, _CHUNK_BYTES // (4 * vectors.shape[1]))
        chunk = np.empty((step, vectors.shape[1]), np.float32)
        for start in range(first, last, step):
            stop = min(start + step, last)
            part = chunk[: stop - start]
            part[:] = vectors[start:stop] if is_dense else vectors[rows[start:stop]]
            np.dot(part, vector, out=products[start:stop])
        return (products[rows] if is_dense else products) * self._inverse_norms[rows]

    def vector(self, row: int) -> Vector | None:
        """The descriptor (D,) of a row, rounded, of unit length; None if it has none."""
        inverse_norm = self._inverse_norms[row]
        return None if np.isnan(inverse_norm) else self._table.vectors[row] * inverse_norm

    def centres(self, rows: Rows) -> Array:
        """Camera centres (N, 3), world, metres."""
        return self._table.poses[rows, :, 3]

    def axes(self, rows: Rows) -> Array:
        """Optical axes (N, 3), unit length, world."""
        return self._table.poses[rows, :, 2]

    def reference(self, row: int) -> tuple[str, str, RigidTransform]:
        """Id, key and world_from_camera of a row."""
        pose = self._table.poses[row].copy()
        return self._table.ids[row], self._table.keys[row], RigidTransform(pose[:, :3], pose[:, 3])

    def undescribed(self) -> list[tuple[str, str]]:
        """Id and key of the references that have no descriptor."""
        rows = np.flatnonzero(self._alive & np.isnan(self._inverse_norms)).tolist()
        return [(self._table.ids[row], self._table.keys[row]) for row in rows]

    def _find(self, reference_id: str) -> int | None:
        row = self._table.row_of_id.get(reference_id)
        if row is not None and row >= len(self._alive):  # it was replaced later: find the row of that time
            before = (i for i in np.flatnonzero(self._alive).tolist() if self._table.ids[i] == reference_id)
            row = next(before, None)
        return row if row is not None and self._alive[row] else None


class SceneIndex:
    """One scene in memory: updated by one thread at a time, read by any number without locks."""

    def __init__(self, dimension: int) -> None:
        """Makes an empty index of descriptors with `dimension` numbers."""
        self._dimension = dimension
        self._lock = threading.Lock()
        self._entries = self._empty(-1, 0)

    @property
    def generation(self) -> int:
        """Generation of the scene at the last update; -1 before the first."""
        return self._entries.generation

    @property
    def size_bytes(self) -> int:
        """Memory of the index, bytes."""
        entries = self._entries
        return entries._table.size_bytes() + entries._inverse_norms.nbytes + entries._alive.nbytes

    def entries(self) -> Entries:
        """Returns the scene as it is now."""
        return self._entries

    def apply(self, changes: SceneChanges) -> None:
        """Updates the index; readers see all of the change or none.

        ValueError if a descriptor has another length; nothing is changed then.
        """
        for reference in changes.added:
            if reference.descriptor is not None:
                self._check(reference.descriptor)
        with self._lock:
            before = self._empty(changes.generation, len(changes.added)) if changes.is_whole else self._entries
            known = before._table.row_of_key
            late = {it.key: it.descriptor for it in changes.added if it.key in known and it.descriptor is not None}
            new = list({it.key: it for it in changes.added if it.key not in known}.values())
            kept = _without(before, changes.removed)
            self._entries = _with(_described(kept, late), new, changes.generation)

    def describe(self, vectors: Mapping[str, Vector]) -> None:
        """Adds vectors that were computed later, by the references' keys; ignores unknown references.

        ValueError if a vector has another length.
        """
        for vector in vectors.values():
            self._check(vector)
        with self._lock:
            self._entries = _described(self._entries, vectors)

    def _check(self, vector: Vector) -> None:
        if vector.shape != (self._dimension,):
            raise ValueError(f"a descriptor has the shape {vector.shape}, the index holds ({self._dimension},)")

    def _empty(self, generation: int, capacity: int) -> Entries:
        table = _Table.empty(self._dimension, max(capacity, _SMALLEST_CAPACITY))
        return Entries(generation, table, np.empty(0, np.float32), np.empty(0, bool), 0)


def _without(entries: Entries, keys: Collection[str]) -> Entries:
    """Returns the entries without some keys, copied to a new table if most rows have been removed."""
    row_of_key = entries._table.row_of_key
    rows = [row_of_key[key] for key in keys if key in row_of_key]
    if not rows:
        return entries
    alive = entries._alive.copy()
    alive[rows] = False
    count = int(alive.sum())
    kept = replace(entries, _alive=alive, _count=count)
    return _compacted(kept) if len(alive) > 2 * count + _SMALLEST_CAPACITY else kept


def _compacted(entries: Entries) -> Entries:
    table, rows = entries._table, entries.rows()
    count = len(rows)
    new = _Table.empty(table.vectors.shape[1], max(count, _SMALLEST_CAPACITY))
    new.vectors[:count], new.poses[:count] = table.vectors[rows], table.poses[rows]
    for i, row in enumerate(rows.tolist()):
        _name(new, table.ids[row], table.keys[row], i)
    return Entries(entries.generation, new, entries._inverse_norms[rows], np.ones(count, bool), count)


def _described(entries: Entries, vectors: Mapping[str, Vector]) -> Entries:
    """Returns the entries with vectors for references that had none."""
    norms = entries._inverse_norms.copy()
    for key, vector in vectors.items():
        row = entries._table.row_of_key.get(key)
        if row is not None and np.isnan(norms[row]):
            # No reader uses the row: in all entries that have it, its norm is NaN.
            entries._table.vectors[row], norms[row] = _quantized(vector)
    return replace(entries, _inverse_norms=norms)


def _with(entries: Entries, added: Collection[IndexedReference], generation: int) -> Entries:
    """Returns the entries with new ones added, at the next generation."""
    first = len(entries._alive)
    count = first + len(added)
    table = _grown(entries._table, count)
    norms = np.full(count, np.nan, np.float32)
    norms[:first] = entries._inverse_norms
    for row, reference in enumerate(added, first):
        pose = reference.world_from_camera
        table.poses[row, :, :3], table.poses[row, :, 3] = pose.rotation, pose.translation
        if reference.descriptor is not None:
            table.vectors[row], norms[row] = _quantized(reference.descriptor)
        _name(table, reference.reference_id, reference.key, row)
    alive = np.ones(count, bool)
    alive[:first] = entries._alive
    return Entries(generation, table, norms, alive, entries._count + len(added))


def _grown(table: _Table, count: int) -> _Table:
    """Returns the table with room for this many rows; names are shared, because they are only appended."""
    capacity, dimension = table.vectors.shape
    if count <= capacity:
        return table
    bigger = _Table.empty(dimension, max(count, int(_GROWTH * capacity)))
    bigger.vectors[:capacity], bigger.poses[:capacity] = table.vectors, table.poses
    return replace(table, vectors=bigger.vectors, poses=bigger.poses)


def _name(table: _Table, reference_id: str, key: str, row: int) -> None:
    table.ids.append(reference_id)
    table.keys.append(key)
    table.row_of_key[key] = table.row_of_id[reference_id] = row


def _quantized(vector: Vector) -> tuple[NDArray[np.int8], float]:
    """Quantizes a vector to a 127th of its largest number; also returns the inverse of its norm, 0 for zeros."""
    largest = float(np.abs(vector).max(initial=0.0))
    if not largest > 0:
        return np.zeros(vector.shape, np.int8), 0.0
    steps = np.rint(vector * (_LARGEST / largest))
    return steps.astype(np.int8), 1 / float(np.linalg.norm(steps))
