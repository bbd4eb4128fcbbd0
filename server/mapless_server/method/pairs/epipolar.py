"""Two photographs with poses: the epipolar lines that their matches must lie on, and how far these are from them.

The measure is the Sampson distance from the epipolar constraint, x_first' F x_second = 0: to first order, how far both
keypoints together must be moved to satisfy it, in pixels. Photographs from one place have no F; there it is the
distance between a keypoint and the one that the rotation predicts, divided by sqrt(2) for the same reason.

A camera that is turned around, or that moves the other way, satisfies the same constraint with all points behind it.
So it is also asked how many of the points lie behind a camera. The measure depends neither on the unit of length nor on
the choice of the world's axes.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from mapless.geometry import Array

from ..features.limits import INLIER_PX
from ..features.views import Matches, PosedView, View
from ..optim.optimize import cross_matrices

FUNDAMENTAL_PX = 1.5
"""Largest distance from the epipolar lines of an estimated matrix; keypoints are accurate to about a pixel."""
MIN_MATCHES = 24
"""Fewer inliers of it are no evidence: any eight matches satisfy some fundamental matrix. Evidence: scene-agreement."""
SAME_PLACE = 1e-6
"""Cameras that are nearer than this are at one place; in the unit of the poses."""
MIN_BEFORE = 8
"""Fewer points do not say whether they lie in front of the cameras."""

MIN_PARALLAX_DEG = 1.0
"""Rays of a smaller angle determine no depth: an error of a pixel changes it by several per cent."""

QUICK_ITERATIONS = 30, 300
"""Least and most, of an estimate for pairs of references that a query uses: a millisecond."""


def epipolar_distance_px(first: PosedView, second: PosedView, matches: Matches) -> Array:
    """Distance (M,) of matches from the epipolar lines of the known poses, the larger of both images.

    The distance is 0 without a baseline, where there is no epipolar line.
    """
    fundamental = fundamental_matrix(first, second)
    x_first = _homogeneous(first.view.features.keypoints[matches[:, 0]])
    x_second = _homogeneous(second.view.features.keypoints[matches[:, 1]])
    in_first = (x_first * _lines(x_second @ fundamental.T)).sum(axis=1)
    in_second = (x_second * _lines(x_first @ fundamental)).sum(axis=1)
    return np.asarray(np.maximum(np.abs(in_first), np.abs(in_second)))


def epipolar_distances_px(first: PosedView, second: PosedView) -> NDArray[np.float32]:
    """The same distances (N, M) for every keypoint of the first view with every keypoint of the second."""
    fundamental = fundamental_matrix(first, second)
    x_first, x_second = (_homogeneous(v.view.features.keypoints) for v in (first, second))
    in_first = x_first.astype(np.float32) @ _lines(x_second @ fundamental.T).T.astype(np.float32)
    in_second = _lines(x_first @ fundamental).astype(np.float32) @ x_second.T.astype(np.float32)
    # In place: with 2,000 keypoints each of these matrices has 16 MB, in every thread that matches.
    for distances in (in_first, in_second):
        np.abs(distances, out=distances)
    return np.maximum(in_first, in_second, out=in_first)


def fundamental_matrix(first: PosedView, second: PosedView) -> Array:
    """F (3, 3) of the known poses, x_first^T F x_second = 0 in homogeneous pixels; a zero matrix without a baseline."""
    baseline, _, essential = _relative([first, second], np.array([[0, 1]]))
    if np.linalg.norm(baseline) < SAME_PLACE:
        return np.zeros((3, 3))
    k_first_inv, k_second_inv = (np.linalg.inv(v.view.camera.matrix()) for v in (first, second))
    return np.asarray(k_first_inv.T @ essential[0] @ k_second_inv)


def fundamental_inliers(
    first: View, second: View, matches: Matches, iterations: tuple[int, int] | None = None
) -> NDArray[np.bool_]:
    """Returns whether each match (M,) satisfies one fundamental matrix, estimated from them; none if they are too few.

    `iterations` are the least and the most; None for as many as a thorough estimate takes.
    """
    if len(matches) < MIN_MATCHES:
        return np.zeros(len(matches), bool)
    x_first = first.features.pixels(matches[:, 0])
    x_second = second.features.pixels(matches[:, 1])
    options = {"max_epipolar_error": FUNDAMENTAL_PX}
    if iterations is not None:
        options |= {"min_iterations": iterations[0], "max_iterations": iterations[1]}
    _, info = poselib.estimate_fundamental(x_first, x_second, options, {})
    inliers: NDArray[np.bool_] = np.asarray(info["inliers"], bool)
    return inliers if inliers.sum() >= MIN_MATCHES else np.zeros(len(matches), bool)


def sampson_px(first: PosedView, second: PosedView, matches: Matches) -> Array:
    """Sampson distances (M,) of matches (M, 2), pixels; at one place, those from what the rotation predicts."""
    return np.asarray(np.abs(PosedMatches.of_pair(first, second, matches).distances_px()[0]))


@dataclass(frozen=True, eq=False)
class PosedMatches:
    """Matches of P pairs of photographs with poses, M or fewer of each pair.

    Attributes:
        pixels: (2, P, M, 2) in the first and the second photograph of each pair; NaN where a pair has fewer.
        rays: (2, P, M, 3) of these, of depth 1, in either camera.
        focal, principal: (P, 2, 1, 2) of both cameras, pixels.
        baseline: (P, 3) from the first to the second camera, in the first.
        turned: (P, 3, 3) rotations from the second camera to the first.
        essential: (P, 3, 3).
    """

    pixels: Array
    rays: Array
    focal: Array
    principal: Array
    baseline: Array
    turned: Array
    essential: Array

    @staticmethod
    def of(views: Sequence[PosedView], ends: NDArray[np.intp], pixels: Array) -> "PosedMatches":
        """Takes the pairs (P, 2) of views, by their indices."""
        pinholes = [view.view.camera for view in views]
        cameras = np.array([(it.focal_x_px, it.focal_y_px, it.principal_x_px, it.principal_y_px) for it in pinholes])
        focal, principal = cameras[ends][:, :, None, :2], cameras[ends][:, :, None, 2:]
        rays = np.ones((*pixels.shape[:3], 3))
        for side in (0, 1):
            rays[side, ..., :2] = (pixels[side] - principal[:, side]) / focal[:, side]
        baseline, turned, essential = _relative(views, ends)
        return PosedMatches(pixels, rays, focal, principal, baseline, turned, essential)

    @staticmethod
    def of_pair(first: PosedView, second: PosedView, matches: Matches) -> "PosedMatches":
        """Takes the matches (M, 2) of one pair."""
        x = [view.view.features.keypoints[matches[:, side]][None] for side, view in enumerate((first, second))]
        return PosedMatches.of([first, second], np.array([[0, 1]]), np.stack(x).astype(np.float64))

    @property
    def are_at_one_place(self) -> NDArray[np.bool_]:
        """Whether each pair (P,) has no baseline, so that only its rotation can be compared."""
        return np.asarray(np.linalg.norm(self.baseline, axis=1) < SAME_PLACE)

    def distances_px(self) -> Array:
        """Signed Sampson distances (P, M), pixels; at one place, the distances from what the rotation predicts."""
        rays, focal = self.rays, self.focal
        lines_first, lines_second = rays[1] @ np.swapaxes(self.essential, 1, 2), rays[0] @ self.essential
        constraint = np.einsum("pmi,pmi->pm", rays[0], lines_first)
        slopes = [
            ((lines[..., :2] / focal[:, side]) ** 2).sum(axis=-1)
            for side, lines in enumerate((lines_first, lines_second))
        ]
        with np.errstate(invalid="ignore", divide="ignore"):
            distance_px = constraint / np.sqrt(slopes[0] + slopes[1])
        for row in np.flatnonzero(self.are_at_one_place).tolist():
            distance_px[row] = self._turned_distances_px(row)
        return np.asarray(distance_px)

    def _turned_distances_px(self, row: int) -> Array:
        predicted = self.rays[0][row] @ self.turned[row]
        depth = np.where(predicted[:, 2:] > 0, predicted[:, 2:], np.nan)
        x = self.pixels[1, row]
        moved = predicted[:, :2] / depth * self.focal[row, 1] + self.principal[row, 1] - x
        moved_px = np.nan_to_num(np.linalg.norm(moved, axis=-1) / math.sqrt(2), nan=np.inf)
        return np.where(np.isfinite(x[:, 0]), moved_px, np.nan)

    def behind_shares(self) -> Array:
        """Shares (P,) of points behind a camera; NaN if too few have a parallax.

        Rays that intersect at a smaller angle than `INLIER_PX` may do so behind a camera because of noise.
        """
        second = self.rays[1] @ np.swapaxes(self.turned, 1, 2)
        return _behind(self.rays[0], second, self.baseline, INLIER_PX / self.focal[:, 0].min(axis=-1))


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


def _relative(views: Sequence[PosedView], ends: NDArray[np.intp]) -> tuple[Array, Array, Array]:
    """Baselines (P, 3) in the first camera, its rotations from the second, and essential matrices (P, 3, 3)."""
    rotations = np.array([view.world_from_camera.rotation for view in views])[ends]
    centres = np.array([view.world_from_camera.translation for view in views])[ends]
    # The difference first: world coordinates may be millions of metres.
    baseline = np.einsum("pji,pj->pi", rotations[:, 0], centres[:, 1] - centres[:, 0])
    turned = np.swapaxes(rotations[:, 0], 1, 2) @ rotations[:, 1]
    return baseline, turned, cross_matrices(baseline) @ turned


def _lines(lines: Array) -> Array:
    """Scales lines (N, 3) so that the product with a homogeneous pixel is a distance in pixels."""
    return np.asarray(lines / np.maximum(np.linalg.norm(lines[:, :2], axis=1, keepdims=True), 1e-12))


def _homogeneous(pixels: NDArray[np.float32]) -> Array:
    return np.concatenate([pixels.astype(np.float64), np.ones((len(pixels), 1))], axis=1)


def triangulate_depths(centre: Array, ray: Array) -> tuple[Array, Array]:
    """Depths at which the two rays of each match are nearest to one another.

    They solve z_i r_i - z_j r_j = C_j - C_i in the least squares sense:

        z_i = (C_j - C_i) x r_j . n / |n|^2,   z_j = (C_j - C_i) x r_i . n / |n|^2,   n = r_i x r_j.

    Args:
        centre: (M, 2, 3) camera centres C_i and C_j in the world, metres.
        ray: (M, 2, 3) viewing rays r_i and r_j in world axes, of depth 1 in their camera.

    Returns:
        depth_m: (M, 2) in either camera; negative behind it, NaN for parallel rays.
        parallax_deg: (M,) angle between the rays, 0 to 180.
    """
    baseline = centre[:, 1] - centre[:, 0]
    normal = np.cross(ray[:, 0], ray[:, 1])
    squared = (normal**2).sum(axis=1)
    # (b x r) n = r (n x b) for either camera, with the other camera's ray r.
    turned = np.cross(normal, baseline)
    depth_m = np.einsum("mvi,mi->mv", ray[:, ::-1], turned) / np.where(squared > 0, squared, np.nan)[:, None]
    parallax = np.arctan2(np.sqrt(squared), (ray[:, 0] * ray[:, 1]).sum(axis=1))
    return depth_m, np.degrees(parallax)
