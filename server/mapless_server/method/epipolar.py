"""How well matches of two photographs agree with the poses and cameras that are said to be theirs.

The measure is the Sampson distance from the epipolar constraint, x_first' F x_second = 0: to first order how far both
keypoints together must be moved to satisfy it, in pixels. Whether a match is right must not be asked of the poses that
it shall judge, so matches are filtered by a fundamental matrix of their own.

Scale cannot be seen in it: poses in feet satisfy it like poses in metres. Nor can what changes no relative pose, such
as another choice of the world's axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import poselib

from mapless.geometry import Array

from .correspond import fundamental_matrix, mutual_matches
from .options import check_bounds
from .views import Matches, PosedView, View


@dataclass(frozen=True)
class EpipolarOptions:
    """Options of finding matches that belong together.

    Attributes:
        ratio: Lowe's; strict, since few right matches serve better than many of which some are wrong.
        fundamental_px: greatest distance from the fundamental matrix's lines; keypoints are good to about a pixel.
        min_matches: fewer that agree prove nothing: any eight satisfy some fundamental matrix.
    """

    ratio: float = 0.8
    fundamental_px: float = 1.5
    min_matches: int = 24

    def __post_init__(self) -> None:
        check_bounds(self, "ratio", above=0, at_most=1)
        check_bounds(self, "fundamental_px", above=0)
        check_bounds(self, "min_matches", at_least=8)


def consistent_matches(first: View, second: View, options: EpipolarOptions | None = None) -> Matches:
    """Matches that one fundamental matrix explains, without looking at poses; none if too few agree."""
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
    """Sampson distances (M,) of matches, pixels; NaN if both stand at one place, where there is no such line."""
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
    """Median Sampson distance of matches, pixels; NaN if there are none, or both stand at one place."""
    return float(np.median(sampson_px(first, second, matches))) if len(matches) else float("nan")
