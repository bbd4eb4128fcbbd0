"""Agreement of matches of two photographs with their given poses and cameras.

The measure is the Sampson distance from the epipolar constraint, x_first' F x_second = 0: to first order, how far both
keypoints together must be moved to satisfy it, in pixels. The matches are filtered by a fundamental matrix estimated
from them alone, not by the poses that they are used to check.

The measure does not depend on scale: poses in feet satisfy it like poses in metres. Nor does it depend on the choice of
world axes, which changes no relative pose.
"""

from __future__ import annotations

import numpy as np
import poselib

from mapless.geometry import Array
from mapless_server.method.correspond import fundamental_matrix, mutual_matches
from mapless_server.method.views import Matches, PosedView, View

RATIO = 0.8
"""Lowe's ratio; strict, since few right matches are better here than many with some wrong ones."""

FUNDAMENTAL_PX = 1.5
"""Largest distance from the epipolar lines; keypoints are accurate to about a pixel."""

MIN_MATCHES = 24
"""Fewer inliers are no evidence: any eight matches satisfy some fundamental matrix."""


def consistent_matches(first: View, second: View) -> Matches:
    """Inlier matches of one fundamental matrix, without use of poses; none if they are too few."""
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
