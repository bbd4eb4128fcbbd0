"""Rows of references in memory, appended and never moved."""

import sys
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

SMALLEST_CAPACITY = 8
"""Rows of the smallest table: a group may be of thousands of scenes with a few references."""
_GROWTH = 1.5


@dataclass(frozen=True, eq=False)
class Table:
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
    def empty(dimension: int, capacity: int) -> "Table":
        """Makes a table with room for this many rows."""
        return Table(np.empty((capacity, dimension), np.int8), np.empty((capacity, 3, 4)), [], [], {}, {})

    def size_bytes(self) -> int:
        """Size of the arrays and, estimated by the first ones, of the names, bytes."""
        containers = sum(map(sys.getsizeof, (self.ids, self.keys, self.row_of_key, self.row_of_id)))
        names = sum(map(sys.getsizeof, (*self.ids[:1], *self.keys[:1]))) + sys.getsizeof(1 << 20)
        return self.vectors.nbytes + self.poses.nbytes + containers + names * len(self.ids)


def grown(table: Table, count: int) -> Table:
    """Returns the table with room for this many rows; names are shared, because they are only appended."""
    capacity, dimension = table.vectors.shape
    if count <= capacity:
        return table
    bigger = Table.empty(dimension, max(count, int(_GROWTH * capacity)))
    bigger.vectors[:capacity], bigger.poses[:capacity] = table.vectors, table.poses
    return replace(table, vectors=bigger.vectors, poses=bigger.poses)


def name_row(table: Table, reference_id: str, key: str, row: int) -> None:
    """Adds the names of a row to the table, after those of the row before."""
    table.ids.append(reference_id)
    table.keys.append(key)
    table.row_of_key[key] = table.row_of_id[reference_id] = row
