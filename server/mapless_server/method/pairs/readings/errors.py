"""How far matched pairs of photographs are from satisfying their poses and cameras: `epipolar` of many pairs at once.

The matches are filtered by a fundamental matrix estimated from them alone, not by the poses that they are used to
check. A pair whose points lie behind a camera does not satisfy its poses, however small its distance.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from ...features.limits import MAX_SIDE_PX
from ...features.matching import CorrespondOptions, mutual_matches
from ...features.views import Features, Matches, PosedView, View
from ..agreement import MAX_ERROR_PX
from ..epipolar import PosedMatches, fundamental_inliers

Pair = tuple[int, int]
"""Indices of two photographs."""

SAMPLED_MATCHES = 64
"""Matches of a pair that explanations are compared by; a median of so many distinguishes mistakes."""

WRONG_SHARE = 0.4
"""Share of bad pairs above which more than single photographs are wrong, one of which makes one pair in five bad."""

FEW_SHARE = 0.25
"""Largest share of exceptions: of bad pairs where the poses should fit, of good pairs where they should not. Evidence:
readings."""


def distinct_matches(first: View, second: View) -> Matches:
    """Matches of descriptors that nothing else in the other view resembles."""
    return mutual_matches(first.features, second.features, CorrespondOptions.distinct_ratio)


def consistent(first: View, second: View, matches: Matches) -> Matches:
    """Those of the matches (M, 2) that satisfy one fundamental matrix, estimated from them; none if they are few."""
    return matches[fundamental_inliers(first, second, matches)]


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Two photographs with the matches that fit a fundamental matrix estimated from them."""

    pair: Pair
    matches: Matches


@dataclass(frozen=True)
class PairError:
    """Median epipolar error of a pair, and the error above which it is bad, pixels of the processed image.

    `behind_share` is the share of its points that lie behind a camera; NaN if too few have a parallax.
    """

    pair: Pair
    error_px: float
    threshold_px: float
    match_count: int
    behind_share: float = math.nan

    @property
    def is_behind(self) -> bool:
        """Whether most of its points lie behind a camera."""
        return self.behind_share > 0.5

    @property
    def is_bad(self) -> bool:
        """Whether the pair does not satisfy the poses."""
        return self.is_behind or not self.error_px <= self.threshold_px


Views = Mapping[int, PosedView]
"""By the index that pairs use."""


class PairSample:
    """Matched pairs, with at most so many matches of each, ready to be measured under other poses or cameras."""

    def __init__(self, views: Views, matched: Sequence[MatchedPair], most: int | None = None) -> None:
        """Takes every n-th match of a pair, so that `most` or fewer remain; all by default."""
        self.pairs = [item.pair for item in matched]
        kept = [item.matches[:: 1 if most is None else 1 + len(item.matches) // most] for item in matched]
        used = {i: [np.zeros(0, np.intp)] for i in sorted({i for pair in self.pairs for i in pair})}
        for pair, matches in zip(self.pairs, kept, strict=True):
            for side, i in enumerate(pair):
                used[i].append(matches[:, side].astype(np.intp))
        rows = {i: np.unique(np.concatenate(its)) for i, its in used.items()}
        self.views: dict[int, PosedView] = {i: _with_rows(views[i], its) for i, its in rows.items()}
        self._position = {i: position for position, i in enumerate(self.views)}
        starts = np.concatenate([[0], np.cumsum([len(it) for it in rows.values()])])
        self._ends = np.array([[self._position[i] for i in pair] for pair in self.pairs], np.intp).reshape(-1, 2)
        counts = np.array([len(it) for it in kept], np.intp)
        width = counts.max(initial=0)
        self._rows = np.zeros((2, len(self.pairs), width), np.intp)
        self._is_match = np.arange(width) < counts[:, None]
        for row, (pair, matches) in enumerate(zip(self.pairs, kept, strict=True)):
            for side, i in enumerate(pair):
                found = starts[self._position[i]] + np.searchsorted(rows[i], matches[:, side])
                self._rows[side, row, : len(matches)] = found

    def measure(self, views: Views | None = None, seconds: Views | None = None) -> list[PairError]:
        """Errors of all pairs; of other views with the same keypoints in the same order, if given.

        `seconds` are views of the second photographs of pairs, if they differ from those of the first.
        """
        if not self.pairs:
            return []
        posed, thresholds_px = self._posed(views, seconds)
        errors_px, behind = _medians(np.abs(posed.distances_px())), posed.behind_shares()
        figures = [it.tolist() for it in (errors_px, thresholds_px, self._is_match.sum(axis=1), behind)]
        return [PairError(*it) for it in zip(self.pairs, *figures, strict=True)]

    def distances_px(self, views: Views, seconds: Views) -> Array:
        """Signed distances (N,) of all matches of all pairs."""
        return np.asarray(self._posed(views, seconds)[0].distances_px()[self._is_match])

    def _posed(self, views: Views | None, seconds: Views | None) -> tuple[PosedMatches, Array]:
        """The pairs' matches with poses, and the largest errors (P,) of good pairs, pixels."""
        views = self.views if views is None else views
        sides_views = (views, views if seconds is None else seconds)
        ordered = [its[i] for its in sides_views for i in self._position]
        keypoints = [[its[i].view.features.keypoints for i in self._position] for its in sides_views]
        pixels = np.stack([np.concatenate(its)[rows] for its, rows in zip(keypoints, self._rows, strict=True)])
        x = np.where(self._is_match[..., None], pixels.astype(np.float64), np.nan)
        ends = self._ends + np.array([0, len(self._position)])
        sides = np.array([max(it.view.camera.width_px, it.view.camera.height_px) for it in ordered])
        return PosedMatches.of(ordered, ends, x), MAX_ERROR_PX * sides[ends].max(axis=1) / MAX_SIDE_PX


def _with_rows(posed: PosedView, rows: NDArray[np.intp]) -> PosedView:
    features = posed.view.features
    few = Features(features.keypoints[rows], features.descriptors[rows], features.sizes_px[rows])
    return replace(posed, view=replace(posed.view, features=few))


def _medians(values: Array) -> Array:
    """Medians of the finite values of each row, NaN of rows without any."""
    ordered = np.sort(values, axis=1)  # NaN last
    count = np.isfinite(ordered).sum(axis=1)
    rows = np.arange(len(ordered))
    low, high = (np.maximum(it, 0) for it in ((count - 1) // 2, count // 2))
    return np.where(count > 0, (ordered[rows, low] + ordered[rows, np.minimum(high, count - 1)]) / 2, np.nan)


def errors_of(views: Views, matched: Sequence[MatchedPair]) -> list[PairError]:
    """Errors of the pairs that have matches."""
    return PairSample(views, [item for item in matched if len(item.matches)]).measure()


def summary(errors: Sequence[PairError]) -> tuple[float, float]:
    """Median error, and share of bad pairs."""
    if not errors:
        return math.inf, 1.0
    return float(np.median([error.error_px for error in errors])), float(np.mean([error.is_bad for error in errors]))
