"""Tracks: the keypoints of several references that observe the same point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from .views import Matches, PosedView

if TYPE_CHECKING:  # imported by what computes: services, which know the results, answer before
    from scipy.sparse import csc_array, csr_array


@dataclass(frozen=True, eq=False)
class Tracks:
    """Observations of points, sorted by point, then view; at most one per point and view, at least two per point.

    Attributes:
        point: (O,) index of the point, 0 to P - 1; each occurs.
        view: (O,) index of the observing reference.
        keypoint: (O,) index of the keypoint in that reference.
    """

    point: NDArray[np.intp]
    view: NDArray[np.intp]
    keypoint: NDArray[np.intp]

    @staticmethod
    def in_order(point: NDArray[np.intp], view: NDArray[np.intp], keypoint: NDArray[np.intp]) -> Tracks:
        """Sorts observations (O,) given in any order."""
        order = np.lexsort((view, point))
        return Tracks(point[order], view[order], keypoint[order])

    def and_last(self, tracks: Tracks, count: int) -> Tracks:
        """Appends tracks of further points, which follow the `count` points of these."""
        return Tracks(
            np.concatenate([self.point, count + tracks.point]),
            np.concatenate([self.view, tracks.view]),
            np.concatenate([self.keypoint, tracks.keypoint]),
        )

    @property
    def point_count(self) -> int:
        """Number of points."""
        return int(self.point[-1]) + 1 if len(self.point) else 0

    @cached_property
    def starts(self) -> NDArray[np.intp]:
        """Index (P,) of each point's first observation."""
        return np.flatnonzero(np.diff(self.point, prepend=-1))

    def select(self, points: NDArray[np.bool_]) -> Tracks:
        """The tracks of the chosen points, renumbered; ``points`` is (P,)."""
        keep = points[self.point]
        renumbered = np.cumsum(points) - 1
        return Tracks(renumbered[self.point[keep]], self.view[keep], self.keypoint[keep])

    @property
    def length(self) -> NDArray[np.intp]:
        """Number (O,) of observations of each observation's point."""
        return np.bincount(self.point)[self.point]

    def sum_columns(self, values: Array) -> Array:
        """Sums columns (..., O) over each point's observations, (..., P)."""
        return self._sums @ values if values.ndim == 1 else summed(self._sums, values)

    @cached_property
    def _sums(self) -> csr_array:
        """Matrix (P, O) whose product sums over each point's observations, five times as fast as `reduceat`."""
        from scipy.sparse import csr_array

        count, ends = len(self.point), np.append(self.starts, len(self.point))
        return csr_array((np.ones(count), np.arange(count), ends), shape=(self.point_count, count))

    def prune(self, observations: NDArray[np.bool_]) -> tuple[Tracks, NDArray[np.bool_], NDArray[np.bool_]]:
        """Keeps the chosen observations (O,), without points that have fewer than two of them.

        Also returns masks (O,) and (P,) of the observations and points that are kept.
        """
        count = np.bincount(self.point[observations], minlength=self.point_count)
        rows, points = observations & (count[self.point] >= 2), count >= 2
        renumbered = np.cumsum(points) - 1
        return Tracks(renumbered[self.point[rows]], self.view[rows], self.keypoint[rows]), rows, points


def summed(sums: csr_array | csc_array, values: Array) -> Array:
    """Product of a sparse matrix (P, O) with columns (N, O), (N, P): in one call, a third of the time of N."""
    return np.ascontiguousarray((sums @ np.ascontiguousarray(values.T)).T)


def build_tracks(
    pairs: Mapping[tuple[int, int], Matches], keypoint_counts: Sequence[int], anchor: int | None = None
) -> Tracks:
    """Merges pairwise matches, of views i < j, into tracks.

    An anchor merges only the pairs of that view (the paper), so that every track begins at one of its keypoints. Where
    a chain of matches reaches two keypoints of one view, the one with more matches is kept.
    """
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    offsets = np.concatenate([[0], np.cumsum(keypoint_counts)])
    used = [
        matches + offsets[[i, j]]
        for (i, j), matches in pairs.items()
        if (anchor is None or anchor in (i, j)) and len(matches)
    ]
    if not used:
        nothing = np.empty(0, np.intp)
        return Tracks(nothing, nothing, nothing)
    edges = np.concatenate(used)
    total = int(offsets[-1])
    graph = coo_array((np.ones(len(edges), np.int8), (edges[:, 0], edges[:, 1])), shape=(total, total))
    _, component = connected_components(graph, directed=False)
    degree = np.bincount(edges.ravel(), minlength=total)
    node = np.flatnonzero(degree)
    view = np.searchsorted(offsets, node, side="right") - 1
    # Sorted by (component, view, -degree), the first of each (component, view) is kept.
    order = np.lexsort((-degree[node], view, component[node]))
    node, view = node[order], view[order]
    label = component[node]
    first = np.concatenate([[True], (label[1:] != label[:-1]) | (view[1:] != view[:-1])])
    node, view, label = node[first], view[first], label[first]
    begins = np.diff(label, prepend=-1) > 0  # sorted by component
    point = np.cumsum(begins) - 1
    seen_twice = (np.bincount(point) >= 2)[point]
    point = np.cumsum(begins[seen_twice]) - 1
    return Tracks(point, view[seen_twice], node[seen_twice] - offsets[view[seen_twice]])


def keypoint_offsets(references: Sequence[PosedView]) -> NDArray[np.intp]:
    """Offsets (K + 1,) of each reference's keypoints when those of all references are concatenated."""
    return np.cumsum([0] + [len(reference.view.features) for reference in references])
