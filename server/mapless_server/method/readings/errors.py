"""How far matched pairs of photographs are from satisfying their poses and cameras.

The measure is the Sampson distance from the epipolar constraint, x_first' F x_second = 0: to first order, how far both
keypoints together must be moved to satisfy it, in pixels. Photographs from one place have no F; there it is the
distance between a keypoint and the one that the rotation predicts, divided by sqrt(2) for the same reason. The matches
are filtered by a fundamental matrix estimated from them alone, not by the poses that they are used to check.

A camera that is turned around, or that moves the other way, satisfies the same constraint with all points behind it.
So a pair whose points lie behind a camera does not satisfy its poses, however small its distance.

The measure does not depend on scale: poses in feet satisfy it like poses in metres. Nor does it depend on the choice of
world axes, which changes no relative pose.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import poselib
from numpy.typing import NDArray

from mapless.geometry import Array

from ..nearest import mutual_matches
from ..views import Features, Matches, PosedView, View

Pair = tuple[int, int]
"""Indices of two photographs."""

RATIO = 0.8
"""Lowe's ratio; strict, since few right matches are better here than many with some wrong ones."""
FUNDAMENTAL_PX = 1.5
"""Largest distance from the epipolar lines; keypoints are accurate to about a pixel."""
MIN_MATCHES = 24
"""Fewer inliers are no evidence: any eight matches satisfy some fundamental matrix."""


def distinct_matches(first: View, second: View) -> Matches:
    """Matches of descriptors that nothing else in the other view resembles."""
    return mutual_matches(first.features, second.features, RATIO)


def consistent_matches(first: View, second: View) -> Matches:
    """Inlier matches of one fundamental matrix, without use of poses; none if there are too few."""
    return consistent(first, second, distinct_matches(first, second))


def consistent(first: View, second: View, matches: Matches) -> Matches:
    """Those of the matches (M, 2) that satisfy one fundamental matrix, estimated from them; none if they are few."""
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


THRESHOLD_PX = 3.0
"""Of an image whose longer side is 1024 pixels. Good poses give 0.1 (surveyed) to 0.8 px (motion capture, a rolling
shutter); a phone's tracking up to two. Wrong conventions give tens."""
SAME_PLACE = 1e-6
"""Cameras that are nearer than this are at one place; in the unit of the poses."""
PARALLAX_PX = 4.0
"""Rays that intersect at a smaller angle, in pixels of the image, may do so behind a camera because of noise."""
MIN_BEFORE = 8
"""Points that say whether they lie before the cameras."""
BEHIND_SHARE = 0.5
"""Of these points, above which the cameras face or move the other way. It is a few per cent for good poses."""


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
        """Whether its points lie behind the cameras."""
        return self.behind_share > BEHIND_SHARE

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
        self.counts = [len(it) for it in kept]
        used = {i: [np.zeros(0, np.intp)] for i in sorted({i for pair in self.pairs for i in pair})}
        for pair, matches in zip(self.pairs, kept, strict=True):
            for side, i in enumerate(pair):
                used[i].append(matches[:, side].astype(np.intp))
        rows = {i: np.unique(np.concatenate(its)) for i, its in used.items()}
        self.views: dict[int, PosedView] = {i: _with_rows(views[i], its) for i, its in rows.items()}
        self._position = {i: position for position, i in enumerate(self.views)}
        starts = np.concatenate([[0], np.cumsum([len(it) for it in rows.values()])])
        self._ends = np.array([[self._position[i] for i in pair] for pair in self.pairs], np.intp).reshape(-1, 2)
        width = max(self.counts, default=0)
        self._rows = np.zeros((2, len(self.pairs), width), np.intp)
        self._is_match = np.arange(width) < np.array(self.counts, np.intp)[:, None]
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
        distances_px, behind, thresholds_px = self._measured(views, seconds)
        errors_px = _medians(np.abs(distances_px))
        return [
            PairError(pair, float(error), float(threshold), count, float(share))
            for pair, error, threshold, count, share in zip(
                self.pairs, errors_px, thresholds_px, self.counts, behind, strict=True
            )
        ]

    def distances_px(self, views: Views, seconds: Views) -> Array:
        """Signed distances (N,) of all matches of all pairs."""
        return np.asarray(self._measured(views, seconds)[0][self._is_match])

    def _measured(self, views: Views | None, seconds: Views | None) -> tuple[Array, Array, Array]:
        """Signed distances (P, M), shares behind the cameras and thresholds (P,)."""
        views = self.views if views is None else views
        sides_views = (views, views if seconds is None else seconds)
        ordered = [its[i] for its in sides_views for i in self._position]
        keypoints = [[its[i].view.features.keypoints for i in self._position] for its in sides_views]
        pixels = np.stack([np.concatenate(its)[rows] for its, rows in zip(keypoints, self._rows, strict=True)])
        x = np.where(self._is_match[..., None], pixels.astype(np.float64), np.nan)
        ends = self._ends + np.array([0, len(self._position)])
        sides = np.array([max(it.view.camera.width_px, it.view.camera.height_px) for it in ordered])
        return *_measured(ordered, ends, x), THRESHOLD_PX * sides[ends].max(axis=1) / 1024


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


def _measured(views: Sequence[PosedView], ends: NDArray[np.intp], x: Array) -> tuple[Array, Array]:
    """Signed distances (P, M) of pixels x (2, P, M, 2) of pairs (P, 2) of views; shares (P,) behind the cameras."""
    rotations = np.array([view.world_from_camera.rotation for view in views])[ends]
    centres = np.array([view.world_from_camera.translation for view in views])[ends]
    cameras = np.array(
        [
            (it.focal_x_px, it.focal_y_px, it.principal_x_px, it.principal_y_px)
            for it in (view.view.camera for view in views)
        ]
    )[ends]
    focal, principal = cameras[:, :, None, :2], cameras[:, :, None, 2:]
    ideal = np.stack([(x[side] - principal[:, side]) / focal[:, side] for side in (0, 1)])
    rays = np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)
    # The difference first: world coordinates may be millions of metres.
    baseline = np.einsum("pji,pj->pi", rotations[:, 0], centres[:, 1] - centres[:, 0])
    turned = np.swapaxes(rotations[:, 0], 1, 2) @ rotations[:, 1]  # first_from_second
    essential = _cross_matrices(baseline) @ turned
    lines_first, lines_second = rays[1] @ np.swapaxes(essential, 1, 2), rays[0] @ essential
    constraint = (rays[0] * lines_first).sum(axis=-1)
    slope = np.hypot(
        np.hypot(*np.moveaxis(lines_first[..., :2] / focal[:, 0], -1, 0)),
        np.hypot(*np.moveaxis(lines_second[..., :2] / focal[:, 1], -1, 0)),
    )
    with np.errstate(invalid="ignore", divide="ignore"):
        distance_px = constraint / slope
    for row in np.flatnonzero(np.linalg.norm(baseline, axis=1) < SAME_PLACE):
        predicted = rays[0][row] @ turned[row]
        depth = np.where(predicted[:, 2:] > 0, predicted[:, 2:], np.nan)
        moved = predicted[:, :2] / depth * focal[row, 1] + principal[row, 1] - x[1, row]
        moved_px = np.nan_to_num(np.linalg.norm(moved, axis=-1) / math.sqrt(2), nan=np.inf)
        distance_px[row] = np.where(np.isfinite(x[1, row, :, 0]), moved_px, np.nan)
    second = rays[1] @ np.swapaxes(turned, 1, 2)
    return distance_px, _behind(rays[0], second, baseline, PARALLAX_PX / focal[:, 0].min(axis=-1))


def _cross_matrices(vectors: Array) -> Array:
    """The matrices (P, 3, 3) of the cross products with vectors (P, 3)."""
    matrices = np.zeros((len(vectors), 3, 3))
    for row, column, axis, sign in ((0, 1, 2, -1), (0, 2, 1, 1), (1, 2, 0, -1)):
        matrices[:, row, column] = sign * vectors[:, axis]
        matrices[:, column, row] = -sign * vectors[:, axis]
    return matrices


def _behind(first: Array, second: Array, baseline: Array, least: Array) -> Array:
    """Share (P,) of points behind a camera, of rays (P, M, 3) with an angle of at least `least` (P, 1).

    The depths are those of `scale.triangulate_depths`, times |r_i x r_j|^2, with the products of vectors written out:
    (b x r_j) (r_i x r_j) = (b r_i) (r_j r_j) - (b r_j) (r_i r_j).
    """
    along_first, along_second = (np.einsum("pmi,pi->pm", it, baseline) for it in (first, second))
    between = np.einsum("pmi,pmi->pm", first, second)
    square_first, square_second = ((it**2).sum(axis=-1) for it in (first, second))
    squared = np.maximum(square_first * square_second - between**2, 0.0)
    with np.errstate(invalid="ignore"):
        usable = np.arctan2(np.sqrt(squared), between) >= least
        behind_first = along_first * square_second < along_second * between
        behind_second = along_first * between < along_second * square_first
    count = usable.sum(axis=1)
    behind = (usable & (behind_first | behind_second)).sum(axis=1)
    return np.where(count >= MIN_BEFORE, behind / np.maximum(count, 1), np.nan)


def sampson_px(first: PosedView, second: PosedView, matches: Matches) -> Array:
    """Sampson distances (M,) of matches, pixels; at one place, those from what the rotation predicts."""
    x = np.stack(
        [view.view.features.keypoints[matches[:, side]][None] for side, view in enumerate((first, second))]
    ).astype(np.float64)
    return np.asarray(np.abs(_measured([first, second], np.array([[0, 1]]), x)[0][0]))


def pair_error_px(first: PosedView, second: PosedView, matches: Matches) -> float:
    """Median distance of matches, pixels; NaN without matches."""
    return float(np.median(sampson_px(first, second, matches))) if len(matches) else float("nan")


def errors_of(views: Views, matched: Sequence[MatchedPair]) -> list[PairError]:
    """Errors of the pairs that have matches."""
    return PairSample(views, [item for item in matched if len(item.matches)]).measure()


def summary(errors: Sequence[PairError]) -> tuple[float, float]:
    """Median error, and share of bad pairs."""
    if not errors:
        return math.inf, 1.0
    return float(np.median([error.error_px for error in errors])), float(np.mean([error.is_bad for error in errors]))
