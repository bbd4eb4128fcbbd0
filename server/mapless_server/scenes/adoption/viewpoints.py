"""The viewpoints of a scene's surveyed references: which stand nearest to a photograph, and whose place it is."""

import math
from collections.abc import Callable, Iterable
from functools import cached_property
from weakref import WeakKeyDictionary

import numpy as np
from scipy.spatial import KDTree

from mapless.geometry import Array
from mapless_server.scenes.retrieval.index import Entries, Rows

LEAST_COSINE = 0.5
"""References look in a photograph's direction within 60 degrees."""
FIRST_NEAR, MOST_NEAR = 16, 1024
"""So many of the nearest are looked at, then eight times as many, then all."""


class Viewpoints:
    """Viewpoints of references, in a tree: one of a million is found in some 50 microseconds.

    Attributes:
        centres: camera centres (N, 3), world.
        axes: optical axes (N, 3), world, unit length.
    """

    def __init__(self, centres: Array, axes: Array) -> None:
        """Makes the object; N may be 0."""
        self.centres = centres
        self.axes = axes
        self._tree = KDTree(centres)

    def __len__(self) -> int:
        return len(self.centres)

    @cached_property
    def extent_m(self) -> float:
        """Length of the diagonal of the box around the centres; 0 for none."""
        return float(np.linalg.norm(np.ptp(self.centres, axis=0))) if len(self) else 0.0

    @property
    def spacing_m(self) -> float:
        """How far places are apart, as if they filled a square with the extent as its side."""
        return self.extent_m / math.sqrt(max(len(self), 1))

    def nearest(self, position: Array, count: int) -> Rows:
        """Indices of the references that stand nearest to a position (3,), the nearest first; at most so many."""
        return self._near(position, None, count)

    def looking(self, position: Array, forward: Array, count: int) -> Rows:
        """Likewise of those that look within 60 degrees of a direction (3,), unit length."""
        return self._near(position, forward, count)

    def place(self, position: Array, forward: Array | None) -> int:
        """Index of the reference whose place a position is: the nearest that looks within 60 degrees, or of all.

        Of all, too, where the direction is not known. N is at least 1.
        """
        found = self.nearest(position, 1) if forward is None else self.looking(position, forward, 1)
        return int(found[0] if len(found) else self.nearest(position, 1)[0])

    def around(self, centre: Array, axis: Array, count: int, distance_m: float = math.inf) -> list[int]:
        """Indices of the references around a viewpoint, the nearest first: so many that look within 60 degrees.

        The first is that of `place`; the others stand within this distance, that of what a photograph there shows.
        """
        first, *others = self.looking(centre, axis, count).tolist() or [self.place(centre, axis)]
        return [first, *(it for it in others if np.linalg.norm(self.centres[it] - centre) <= distance_m)]

    def _near(self, position: Array, forward: Array | None, count: int) -> Rows:
        near_count = max(FIRST_NEAR, 2 * count)
        while near_count < min(len(self), max(MOST_NEAR, 4 * count) + 1):
            distance, near = self._tree.query(position, near_count)
            # Others may be as far as the last.
            sure = near[distance < distance[-1]]
            if forward is not None:
                sure = sure[self.axes[sure] @ forward > LEAST_COSINE]
            if len(sure) >= count:
                return self._sorted(position, sure)[:count]
            near_count *= 8
        every = np.arange(len(self))
        if forward is not None:
            every = np.flatnonzero(self.axes @ forward > LEAST_COSINE)
        return self._sorted(position, every)[:count]

    def _sorted(self, position: Array, indices: Rows) -> Rows:
        distance = np.linalg.norm(self.centres[indices] - position, axis=1)
        return np.asarray(indices[np.lexsort((indices, distance))], np.intp)


_kept: WeakKeyDictionary[Entries, tuple[Rows, Viewpoints]] = WeakKeyDictionary()
"""Trees by generation of a scene, as long as it is in memory: to make one of 100,000 takes 50 ms."""


def surveyed_viewpoints(entries: Entries, adopted_keys: Callable[[], Iterable[str]]) -> tuple[Rows, Viewpoints]:
    """Rows (N,) of a scene's surveyed references in use, ascending, and their viewpoints, of these rows.

    Args:
        entries: the references in use at one generation.
        adopted_keys: reads the keys of those that were adopted, where they are not known of these entries.
    """
    found = _kept.get(entries)
    if found is None:
        its = list(entries.rows_of_keys(list(adopted_keys())).values())
        rows = np.setdiff1d(entries.rows(), its, assume_unique=True)
        found = _kept[entries] = rows, Viewpoints(entries.centres(rows), entries.axes(rows))
    return found
