"""Which keypoints of different photographs show the same thing.

Between references, whose poses are known, a match must also lie on the epipolar line; these matches depend on nothing but
the two stored references, so they are remembered. Matches of the query with each reference come from descriptors alone.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from threading import Lock

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, cross_matrix

from .views import Features, PosedView, View

Matches = NDArray[np.int32]
"""(M, 2): keypoint indices in the first and in the second view."""


@dataclass(frozen=True)
class CorrespondOptions:
    """Options of matching.

    Attributes:
        reference_ratio: a match between references is kept when the second-best descriptor is at least this much further
            away (Lowe's ratio of distances); loose, because the epipolar line filters too.
        query_ratio: the same for matches with the query, which have no other filter.
        epipolar_px: greatest distance from the epipolar line, in both images; keypoints are good to about a pixel.
        remembered_pairs: how many pairs of references are remembered, about 8 KiB each.
    """

    reference_ratio: float = 0.9
    query_ratio: float = 0.85
    epipolar_px: float = 2.0
    remembered_pairs: int = 20_000

    def __post_init__(self) -> None:
        if not (0 < self.reference_ratio <= 1 and 0 < self.query_ratio <= 1 and self.epipolar_px > 0):
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True, eq=False)
class Correspondences:
    """Matches of one query and its references.

    Attributes:
        reference_pairs: for each i < j, matches between references i and j.
        query_matches: for each reference, matches (query keypoint, reference keypoint).
    """

    reference_pairs: Mapping[tuple[int, int], Matches]
    query_matches: tuple[Matches, ...]


class Matcher:
    """Matches views; remembers pairs of references. Safe to use from several threads."""

    def __init__(self, options: CorrespondOptions | None = None) -> None:
        self.options = options or CorrespondOptions()
        self._remembered: OrderedDict[tuple[str, str], Matches] = OrderedDict()
        self._lock = Lock()

    def correspond(self, query: View, references: Sequence[PosedView]) -> Correspondences:
        """Matches between all pairs of references and between the query and each."""
        pairs = {
            (i, j): self.match_references(references[i], references[j])
            for i, j in combinations(range(len(references)), 2)
        }
        return Correspondences(pairs, tuple(self.match_query(query, reference) for reference in references))

    def match_query(self, query: View, reference: PosedView) -> Matches:
        """Matches (query keypoint, reference keypoint)."""
        return mutual_matches(query.features, reference.view.features, self.options.query_ratio)

    def match_references(self, first: PosedView, second: PosedView) -> Matches:
        """Matches between two references, each within `epipolar_px` of the epipolar line of the known poses."""
        key = (first.key, second.key)
        with self._lock:
            if key in self._remembered:
                self._remembered.move_to_end(key)
                return self._remembered[key]
        matches = mutual_matches(first.view.features, second.view.features, self.options.reference_ratio)
        matches = matches[epipolar_distance_px(first, second, matches) < self.options.epipolar_px]
        with self._lock:
            self._remembered[key] = matches
            while len(self._remembered) > self.options.remembered_pairs:
                self._remembered.popitem(last=False)
        return matches


def mutual_matches(first: Features, second: Features, ratio: float) -> Matches:
    """Mutual nearest neighbours that pass the ratio test from first to second.

    Descriptors have unit length, so with cosine s the distance is sqrt(2 - 2 s).
    """
    if len(first) < 2 or len(second) < 2:
        return np.empty((0, 2), np.int32)
    similarity = first.descriptors @ second.descriptors.T  # (N, M)
    rows = np.arange(len(first))
    nearest = similarity.argmax(axis=1)
    best = similarity[rows, nearest]
    # Best of its column too: compared by value, because an argmax along columns costs ten times the maximum.
    mutual = best >= similarity.max(axis=0)[nearest]
    similarity[rows, nearest] = -1.0
    second_best = similarity.max(axis=1)
    keep = mutual & (1 - best < ratio**2 * (1 - second_best))
    return np.stack([rows[keep], nearest[keep]], axis=1).astype(np.int32)


def epipolar_distance_px(first: PosedView, second: PosedView, matches: Matches) -> Array:
    """Distance (M,) of matches from the epipolar lines of the known poses, the larger of both images; 0 if both stand at
    one place, where there is no such line.
    """
    first_from_second = first.world_from_camera.inverse().compose(second.world_from_camera)
    if np.linalg.norm(first_from_second.translation) < 1e-6:
        return np.zeros(len(matches))
    essential = cross_matrix(first_from_second.translation) @ first_from_second.rotation
    k_first_inv, k_second_inv = (np.linalg.inv(v.view.camera.matrix()) for v in (first, second))
    fundamental = k_first_inv.T @ essential @ k_second_inv  # x_first^T F x_second = 0
    x_first = _homogeneous(first.view.features.keypoints[matches[:, 0]])
    x_second = _homogeneous(second.view.features.keypoints[matches[:, 1]])
    line_in_first, line_in_second = x_second @ fundamental.T, x_first @ fundamental
    algebraic = np.abs((x_first * line_in_first).sum(axis=1))
    shortest_normal = np.minimum(
        np.linalg.norm(line_in_first[:, :2], axis=1), np.linalg.norm(line_in_second[:, :2], axis=1)
    )
    distance: Array = algebraic / np.maximum(shortest_normal, 1e-12)
    return distance


def _homogeneous(pixels: NDArray[np.float32]) -> Array:
    return np.concatenate([pixels.astype(np.float64), np.ones((len(pixels), 1))], axis=1)
