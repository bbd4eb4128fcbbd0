"""How far matched pairs of photographs are from satisfying their poses and cameras.

The measure is the Sampson distance from the epipolar constraint, x_first' F x_second = 0: to first order, how far both
keypoints together must be moved to satisfy it, in pixels. The matches are filtered by a fundamental matrix estimated
from them alone, not by the poses that they are used to check.

The measure does not depend on scale: poses in feet satisfy it like poses in metres. Nor does it depend on the choice of
world axes, which changes no relative pose.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import poselib

from mapless.geometry import Array

from ..nearest import fundamental_matrix, mutual_matches
from ..views import Matches, PosedView, View

Pair = tuple[int, int]
"""Indices of two photographs, the smaller first."""

RATIO = 0.8
"""Lowe's ratio; strict, since few right matches are better here than many with some wrong ones."""
FUNDAMENTAL_PX = 1.5
"""Largest distance from the epipolar lines; keypoints are accurate to about a pixel."""
MIN_MATCHES = 24
"""Fewer inliers are no evidence: any eight matches satisfy some fundamental matrix."""


def consistent_matches(first: View, second: View) -> Matches:
    """Inlier matches of one fundamental matrix, without use of poses; none if there are too few."""
    matches = mutual_matches(first.features, second.features, RATIO)
    if len(matches) < MIN_MATCHES:
        return matches[:0]
    _, info = poselib.estimate_fundamental(
        first.features.keypoints[matches[:, 0]].astype(np.float64),
        second.features.keypoints[matches[:, 1]].astype(np.float64),
        {"max_epipolar_error": FUNDAMENTAL_PX},
        {},
    )
    agreeing = matches[np.asarray(info["inliers"], bool)]
    return agreeing if len(agreeing) >= MIN_MATCHES else matches[:0]


def sampson_px(first: PosedView, second: PosedView, matches: Matches) -> Array:
    """Sampson distances (M,) of matches, pixels; NaN without a baseline, where F is not defined."""
    fundamental = fundamental_matrix(first, second)
    x_first, x_second = (
        np.column_stack([view.view.features.keypoints[matches[:, side]], np.ones(len(matches))])
        for side, view in enumerate((first, second))
    )
    lines_first, lines_second = x_second @ fundamental.T, x_first @ fundamental
    slope = np.sqrt((lines_first[:, :2] ** 2).sum(axis=1) + (lines_second[:, :2] ** 2).sum(axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.abs((x_first * lines_first).sum(axis=1)) / slope)


def pair_error_px(first: PosedView, second: PosedView, matches: Matches) -> float:
    """Median Sampson distance of matches, pixels; NaN without matches or without a baseline."""
    return float(np.median(sampson_px(first, second, matches))) if len(matches) else float("nan")


THRESHOLD_PX = 3.0
"""Of an image whose longer side is 1024 pixels. Good poses give 0.1 (surveyed) to 0.8 px (motion capture, a rolling
shutter); a phone's tracking up to two. Wrong conventions give tens."""


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Two photographs with the matches that fit a fundamental matrix estimated from them."""

    pair: Pair
    matches: Matches


@dataclass(frozen=True)
class PairError:
    """Median epipolar error of a pair, and the error above which it is bad, pixels of the processed image."""

    pair: Pair
    error_px: float
    threshold_px: float
    match_count: int

    @property
    def is_bad(self) -> bool:
        """Whether the pair does not satisfy the poses."""
        return not self.error_px <= self.threshold_px


Views = Mapping[int, PosedView]
"""By the index that pairs use."""


def errors_of(views: Views, matched: Sequence[MatchedPair]) -> list[PairError]:
    """Errors of the pairs, without those of photographs at one place."""
    errors = []
    for item in matched:
        first, second = (views[i] for i in item.pair)
        error_px = pair_error_px(first, second, item.matches)
        sides = (max(view.view.camera.width_px, view.view.camera.height_px) for view in (first, second))
        if not math.isnan(error_px):
            errors.append(PairError(item.pair, error_px, THRESHOLD_PX * max(sides) / 1024, len(item.matches)))
    return errors


def summary(errors: Sequence[PairError]) -> tuple[float, float]:
    """Median error, and share of bad pairs."""
    if not errors:
        return math.inf, 1.0
    return float(np.median([error.error_px for error in errors])), float(np.mean([error.is_bad for error in errors]))


def summary_with(
    views: Views, matched: Sequence[MatchedPair], change: Callable[[PosedView], PosedView]
) -> tuple[float, float]:
    """Median error, and share of bad pairs, if every view were changed."""
    used = {i for item in matched for i in item.pair}
    return summary(errors_of({i: change(views[i]) for i in used}, matched))
