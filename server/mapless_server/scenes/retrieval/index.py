"""A scene's descriptors and poses: updated by what has changed, read without locks.

A scene is in memory, and its search is exact: every reference's similarity is computed, so nothing is missed and
nothing has to be trained. It is bounded by memory bandwidth. Descriptors are held as 8-bit integers with the norm of
each row, see `quantizing`. A reference takes D bytes and about 0.35 KB for its pose and its names: with 1024 numbers
1.5 KB. One core of a busy machine ranks 1,000 references in 1 ms, 10,000 in 4 and 100,000 in 33.

A large scene is in an index file, and only what has changed since is in memory. Its rows stand in lists of similar
ones, of which a search reads the most similar; what it reads is compared in the same way (`Entries.similar`).
"""

import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform
from mapless_server.method.features.views import View
from mapless_server.store import IndexedReference, SceneChanges

from .index_file import IndexFile
from .lists import likely_rows
from .quantizing import Vector as Vector
from .quantizing import products, quantized
from .table import SMALLEST_CAPACITY, Table, grown, name_row


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

CONSIDERED = 20_000
"""Rows of an index file that a search compares, at least: the most similar lists that have so many. Evidence:
retrieval-lists."""
CONSIDERED_SHARE = 0.02
"""The same as a share of all rows of the file. Evidence: retrieval-lists."""


@dataclass(frozen=True, eq=False)
class Similar:
    """The references that a search has compared with a photograph.

    Attributes:
        rows: (N,), ascending; those that may be the most similar, or all.
        similarity: (N,), NaN for references without a descriptor.
        typical: median similarity of all references, known ones, to which the search was limited; inf without any. If
            not all were compared, that of their lists.
    """

    rows: Rows
    similarity: NDArray[np.float32]
    typical: float


@dataclass(frozen=True, eq=False)
class Entries:
    """The references of a scene at one generation; not changed by later updates.

    The rows of the file, if there is one, are the first; those of the table follow.
    """

    generation: int
    _table: Table
    _inverse_norms: NDArray[np.float32]
    """(n,): converts products with rows into similarities; 0 for a vector of zeros, NaN where there is none."""
    _alive: NDArray[np.bool_]
    """(n,): whether the row's reference has not been removed."""
    _count: int
    file: IndexFile | None = None

    def __len__(self) -> int:
        return self._count

    def __contains__(self, reference_id: object) -> bool:
        return isinstance(reference_id, str) and self._find(reference_id) is not None

    @property
    def is_exact(self) -> bool:
        """Whether a search compares all references."""
        return self.file is None

    @property
    def described_count(self) -> int:
        """Number of references with a descriptor."""
        return int(np.count_nonzero(self._alive & ~np.isnan(self._inverse_norms)))

    def changed_counts(self) -> tuple[int, int]:
        """Numbers of references with descriptors that are not in the file, and of those in it that were removed."""
        first = self._first
        new = np.count_nonzero(self._alive[first:] & ~np.isnan(self._inverse_norms[first:]))
        gone = np.count_nonzero(~self._alive[:first] & ~np.isnan(self._inverse_norms[:first]))
        return int(new), int(gone)

    @property
    def _first(self) -> int:
        """First row of the table."""
        return 0 if self.file is None else len(self.file)

    def rows(self, among: Collection[str] | None = None) -> Rows:
        """Rows (N,) of the references, ascending; only of these ids if given."""
        if among is None:
            return np.flatnonzero(self._alive)
        found = (self._find(reference_id) for reference_id in among)
        return np.array(sorted({row for row in found if row is not None}), np.intp)

    def rows_of_keys(self, keys: Collection[str]) -> dict[str, int]:
        """Rows of the references with these keys, as far as they are here, ascending."""
        found = ((key, self._row_of_key(key)) for key in keys)
        here = [(key, row) for key, row in found if row is not None and row < len(self._alive) and self._alive[row]]
        return dict(sorted(here, key=lambda it: it[1]))

    def similarities(self, vector: Vector, rows: Rows) -> NDArray[np.float32]:
        """Similarity (N,) of a unit vector (D,) with rows, ascending; NaN for references without a descriptor."""
        cut = int(np.searchsorted(rows, self._first))
        found = self._table_products(vector, rows[cut:] - self._first)
        if self.file is not None:
            found = np.concatenate([self.file.products(vector, rows[:cut]), found])
        return found * self._inverse_norms[rows]

    def similar(self, vector: Vector | None, rows: Rows, count: int) -> Similar:
        """Compares a unit vector (D,) with those of some rows, ascending, that may be the `count` most similar.

        With all of them, unless more than `CONSIDERED` stand in a file. Without a vector nothing is similar.
        """
        if vector is None:
            return Similar(rows, np.full(len(rows), np.nan, np.float32), np.inf)
        considered = max(CONSIDERED, 10 * count, int(CONSIDERED_SHARE * self._first))
        cut = int(np.searchsorted(rows, self._first))
        if self.file is None or cut <= considered:
            similarity = self.similarities(vector, rows)
            known = similarity[~np.isnan(similarity)]
            return Similar(rows, similarity, float(np.median(known)) if len(known) else np.inf)
        likely, typical = likely_rows(rows[:cut], vector, self.file, considered)
        chosen = np.concatenate([likely, rows[cut:]])
        return Similar(chosen, self.similarities(vector, chosen), typical)

    def vector(self, row: int) -> Vector | None:
        """The descriptor (D,) of a row, rounded, of unit length; None if it has none."""
        inverse_norm = self._inverse_norms[row]
        if np.isnan(inverse_norm):
            return None
        in_table = row - self._first
        steps = self._table.vectors[in_table] if self.file is None or in_table >= 0 else self.file.row(row)
        return np.asarray(steps * inverse_norm, np.float32)

    def centres(self, rows: Rows) -> Array:
        """Camera centres (N, 3), world, metres, of rows, ascending or not."""
        return self._viewpoints(rows, 3, slice(0, 3))

    def axes(self, rows: Rows) -> Array:
        """Optical axes (N, 3), unit length, world."""
        return self._viewpoints(rows, 2, slice(3, 6))

    def extent_m(self) -> float:
        """Distance of the furthest reference from the world's origin; with a file, maybe that of a deleted one."""
        rows = np.flatnonzero(self._alive[self._first :]) + self._first
        in_table = float(np.linalg.norm(self.centres(rows), axis=1).max(initial=0.0))
        return in_table if self.file is None else max(in_table, self.file.header.extent_m)

    def reference(self, row: int) -> tuple[str, str, RigidTransform]:
        """Id, key and world_from_camera of a row."""
        in_table = row - self._first
        if self.file is not None and in_table < 0:
            return self.file.reference(row)
        pose = self._table.poses[in_table].copy()
        return self._table.ids[in_table], self._table.keys[in_table], RigidTransform(pose[:, :3], pose[:, 3])

    def undescribed(self) -> list[tuple[str, str]]:
        """Id and key of the references that have no descriptor."""
        rows = (np.flatnonzero(self._alive & np.isnan(self._inverse_norms)) - self._first).tolist()
        return [(self._table.ids[row], self._table.keys[row]) for row in rows]

    def _table_products(self, vector: Vector, rows: Rows) -> NDArray[np.float32]:
        """Products (N,) of a vector with rows of the table."""
        used = len(self._alive) - self._first
        # If most rows are wanted, all are read in order; otherwise the wanted ones are gathered.
        if len(rows) > used // 2:
            return products(self._table.vectors[:used], vector)[rows]
        return products(self._table.vectors, vector, rows)

    def _viewpoints(self, rows: Rows, column: int, in_file: slice) -> Array:
        in_table = rows - self._first
        if self.file is None or (in_table >= 0).all():
            return self._table.poses[in_table, :, column]
        filed = np.flatnonzero(in_table < 0)
        if len(filed) == len(rows):
            return self.file.viewpoints[rows, in_file]
        found = np.empty((len(rows), 3))
        found[filed] = self.file.viewpoints[rows[filed], in_file]
        others = np.flatnonzero(in_table >= 0)
        found[others] = self._table.poses[in_table[others], :, column]
        return found

    def _row_of_key(self, key: str) -> int | None:
        """The newest row of a key, used or not."""
        row = self._table.row_of_key.get(key)
        if row is not None:
            return row + self._first
        return None if self.file is None else self.file.find_key(key)

    def _find(self, reference_id: str) -> int | None:
        row = self._table.row_of_id.get(reference_id)
        if row is not None and row + self._first >= len(
            self._alive
        ):  # it was replaced later: find the row of that time
            alive = np.flatnonzero(self._alive[self._first :]).tolist()
            row = next((i for i in alive if self._table.ids[i] == reference_id), None)
        if row is not None and self._alive[row + self._first]:
            return row + self._first
        in_file = None if self.file is None else self.file.find_id(reference_id)
        return in_file if in_file is not None and self._alive[in_file] else None


class SceneIndex:
    """One scene in memory: updated by one thread at a time, read by any number without locks."""

    def __init__(self, dimension: int, file: IndexFile | None = None) -> None:
        """Makes an index of descriptors with `dimension` numbers: empty, or as it is in a file.

        IndexDamaged if the file is damaged.
        """
        self._dimension = dimension
        self._lock = threading.Lock()
        self._entries = self._empty(-1, 0) if file is None else self._filed(file)

    @property
    def file(self) -> IndexFile | None:
        """The file that is used; None if the scene is in memory."""
        return self._entries.file

    @property
    def generation(self) -> int:
        """Generation of the scene at the last update; -1 before the first."""
        return self._entries.generation

    @property
    def size_bytes(self) -> int:
        """Memory of the index, bytes."""
        entries, file = self._entries, self._entries.file
        of_file = 0 if file is None else file.memory_bytes
        return of_file + entries._table.size_bytes() + entries._inverse_norms.nbytes + entries._alive.nbytes

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
            known = {it.key for it in changes.added if before._row_of_key(it.key) is not None}
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
        table = Table.empty(self._dimension, max(capacity, SMALLEST_CAPACITY))
        return Entries(generation, table, np.empty(0, np.float32), np.empty(0, bool), 0)

    def _filed(self, file: IndexFile) -> Entries:
        """The references of a file; those without a descriptor are held in the table, which can be changed."""
        count = len(file)
        lacking = np.isnan(file.inverse_norms)
        table = Table.empty(self._dimension, SMALLEST_CAPACITY)
        described = Entries(
            file.header.generation, table, file.inverse_norms, ~lacking, count - int(lacking.sum()), file
        )
        others = (file.reference(row) for row in np.flatnonzero(lacking).tolist())
        added = [IndexedReference(*it, descriptor=None) for it in others]
        return _with(described, added, file.header.generation)


def _without(entries: Entries, keys: Collection[str]) -> Entries:
    """Returns the entries without some keys, copied to a new table if most rows have been removed."""
    rows = [row for row in map(entries._row_of_key, keys) if row is not None]
    if not rows:
        return entries
    alive = entries._alive.copy()
    alive[rows] = False
    count = int(alive.sum())
    kept = replace(entries, _alive=alive, _count=count)
    is_sparse = len(alive) > 2 * count + SMALLEST_CAPACITY
    return _compacted(kept) if is_sparse and kept.is_exact else kept  # a file is made again


def _compacted(entries: Entries) -> Entries:
    table, rows = entries._table, entries.rows()
    count = len(rows)
    new = Table.empty(table.vectors.shape[1], max(count, SMALLEST_CAPACITY))
    new.vectors[:count], new.poses[:count] = table.vectors[rows], table.poses[rows]
    for i, row in enumerate(rows.tolist()):
        name_row(new, table.ids[row], table.keys[row], i)
    return Entries(entries.generation, new, entries._inverse_norms[rows], np.ones(count, bool), count)


def _described(entries: Entries, vectors: Mapping[str, Vector]) -> Entries:
    """Returns the entries with vectors for references that had none."""
    norms = entries._inverse_norms.copy()
    for key, vector in vectors.items():
        row = entries._table.row_of_key.get(key)
        if row is not None and np.isnan(norms[row + entries._first]):
            # No reader uses the row: in all entries that have it, its norm is NaN.
            entries._table.vectors[row], norms[row + entries._first] = _quantized(vector)
    return replace(entries, _inverse_norms=norms)


def _with(entries: Entries, added: Collection[IndexedReference], generation: int) -> Entries:
    """Returns the entries with new ones added, at the next generation."""
    first, in_file = len(entries._alive), entries._first
    count = first + len(added)
    table = grown(entries._table, count - in_file)
    norms = np.full(count, np.nan, np.float32)
    norms[:first] = entries._inverse_norms
    for row, reference in enumerate(added, first - in_file):
        pose = reference.world_from_camera
        table.poses[row, :, :3], table.poses[row, :, 3] = pose.rotation, pose.translation
        if reference.descriptor is not None:
            table.vectors[row], norms[row + in_file] = _quantized(reference.descriptor)
        name_row(table, reference.reference_id, reference.key, row)
    alive = np.ones(count, bool)
    alive[:first] = entries._alive
    return Entries(generation, table, norms, alive, entries._count + len(added), entries.file)


def _quantized(vector: Vector) -> tuple[NDArray[np.int8], float]:
    rows, inverse_norms = quantized(vector[None])
    return rows[0], float(inverse_norms[0])
