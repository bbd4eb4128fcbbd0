"""Agreement of matches of two photographs with their given poses and cameras.

The measure is the Sampson distance from the epipolar constraint, x_first' F x_second = 0: to first order, how far both
keypoints together must be moved to satisfy it, in pixels. The matches are filtered by a fundamental matrix estimated
from them alone, not by the poses that they are used to check.

The measure does not depend on scale: poses in feet satisfy it like poses in metres. Nor does it depend on the choice of
world axes, which changes no relative pose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib

from mapless.geometry import Array
from mapless_server.method.correspond import fundamental_matrix, mutual_matches
from mapless_server.method.options import check_bounds
from mapless_server.method.views import Matches, PosedView, View


@dataclass(frozen=True)
class EpipolarOptions:
    """Options of finding consistent matches.

    Attributes:
        ratio: Lowe's ratio; strict, since few right matches are better here than many with some wrong ones.
        fundamental_px: largest distance from the epipolar lines; keypoints are accurate to about a pixel.
        min_matches: fewer inliers are no evidence: any eight matches satisfy some fundamental matrix.
    """

    ratio: float = 0.8
    fundamental_px: float = 1.5
    min_matches: int = 24

    def __post_init__(self) -> None:
        check_bounds(self, "ratio", above=0, at_most=1)
        check_bounds(self, "fundamental_px", above=0)
        check_bounds(self, "min_matches", at_least=8)


def consistent_matches(first: View, second: View, options: EpipolarOptions | None = None) -> Matches:
    """Inlier matches of one fundamental matrix, without use of poses; none if they are too few."""
    options = options or EpipolarOptions()
    matches = mutual_matches(first.features, second.features, options.ratio)
    if len(matches) < options.min_matches:
        return matches[:0]
    _, info = poselib.estimate_fundamental(
        first.features.keypoints[matches[:, 0]].astype(np.float64),
        second.features.keypoints[matches[:, 1]].astype(np.float64),
        {"max_epipolar_error": options.fundamental_px},
        {},
    )
    agreeing = matches[np.asarray(info["inliers"], bool)]
    return agreeing if len(agreeing) >= options.min_matches else matches[:0]


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
