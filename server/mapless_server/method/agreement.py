"""Whether two references agree with their poses, by matches that the poses took no part in.

References are matched along the epipolar lines of their poses, so what remains of the matches says nothing of these: a
pair with wrong poses has few matches, like one that shows nothing in common. The evidence is taken before: matches that
are distinct by their descriptors, and that one fundamental matrix, estimated from them alone, explains. If there are
enough, the poses must satisfy them: their distance from the epipolar lines of the poses is the error of the pair. A
repeated pattern gives such matches, too, but then a good part of the others satisfies poses that are right. Where the
poses place most points behind the cameras, no distance is small enough: the epipolar lines of a camera that moves
ahead, and of the same one moving back, are the same.

The error does not depend on the unit of length, nor on the choice of the world's axes.
"""

from collections.abc import Callable

import numpy as np
import poselib
from numpy.typing import NDArray

from mapless.geometry import Array

from .nearest import fundamental_matrix, sampson_px
from .views import Matches, PosedView

MIN_MATCHES = 24
"""Fewer say nothing: any eight matches satisfy some fundamental matrix."""

FUNDAMENTAL_PX = 1.5
"""Largest distance from the epipolar lines of the estimated matrix; keypoints are accurate to about a pixel."""

MAX_ERROR_PX = 3.0
"""Largest median error of a pair that agrees, pixels of an image whose longer side is 1024."""

STATIONARY_PX = 50.0
"""The same for two references at one place, where only the rotation is compared: a camera turned by hand or on a tripod
does not turn about its centre, and what is near moves by some per cent of the image."""

MAJORITY = 0.5
"""Of distinct matches that satisfy the poses: then no matrix need be estimated, because it would be that of the poses.
Also of the points with a parallax, that must be in front of both cameras."""

AMBIGUOUS_SHARE = 0.25
"""Matches that satisfy the poses, as a share of those that contradict them, from which the pair says nothing."""

_RANSAC = {"max_epipolar_error": FUNDAMENTAL_PX, "max_iterations": 300, "min_iterations": 30, "seed": 0}
_MOST_MATCHES = 150
LARGEST_ERROR_PX = _SIDE_PX = 1024.0


ReferenceErrors = Callable[[int, int], float | None]
"""Returns the error of a pair of a query's references, by their indices; None if it is not known."""


def thinned(matches: Matches) -> Matches:
    """As many of the matches, evenly, as the error of a pair is computed from."""
    return matches[:: -(-len(matches) // _MOST_MATCHES) or 1]


def pair_error_px(first: PosedView, second: PosedView, matches: Matches) -> float | None:
    """Error of a pair: median distance of consistent matches from satisfying the poses; None if they do not show it.

    Args:
        first: a reference.
        second: another one.
        matches: (M, 2) distinct matches of both, that have not been filtered by the poses.

    Returns:
        The median Sampson distance, pixels of an image whose longer side is 1024; the largest possible if most points
        are behind the cameras. For references at one place, the distance after the rotation, relative to
        `STATIONARY_PX`.
    """
    if len(matches) < MIN_MATCHES:
        return None
    matches = thinned(matches)
    per_px = _SIDE_PX / max(max(it.view.camera.width_px, it.view.camera.height_px) for it in (first, second))
    fundamental = fundamental_matrix(first, second)
    x_first, x_second = (
        it.view.features.keypoints[matches[:, side]].astype(np.float64) for side, it in enumerate((first, second))
    )
    if not fundamental.any():
        errors_px = _rotation_errors_px(first, second, x_first, x_second)
        scale = per_px * MAX_ERROR_PX / STATIONARY_PX
    else:
        errors_px, scale = sampson_px(fundamental, x_first, x_second), per_px
    agreeing: NDArray[np.bool_] = errors_px * scale <= MAX_ERROR_PX
    consistent = agreeing
    if agreeing.sum() < max(MIN_MATCHES, MAJORITY * len(matches)):
        _, info = poselib.estimate_fundamental(x_first, x_second, _RANSAC, {})
        consistent = np.asarray(info["inliers"], bool)
        if consistent.sum() < MIN_MATCHES:
            return None
        is_satisfied = float(np.median(errors_px[consistent])) * scale <= MAX_ERROR_PX
        if not is_satisfied and agreeing.sum() > AMBIGUOUS_SHARE * consistent.sum():
            return None
    error_px = scale * float(np.median(errors_px[consistent]))
    if error_px <= MAX_ERROR_PX and fundamental.any():
        in_both = consistent & agreeing
        if _are_behind(first, second, x_first[in_both], x_second[in_both]):
            return LARGEST_ERROR_PX
    return min(error_px, LARGEST_ERROR_PX)


def _rotation_errors_px(first: PosedView, second: PosedView, x_first: Array, x_second: Array) -> Array:
    """Distances (M,) of pixels of the second camera, turned into the first, from those of the first; inf behind it."""
    camera = first.view.camera
    rays = (
        second.view.camera.rays(x_second) @ (first.world_from_camera.rotation.T @ second.world_from_camera.rotation).T
    )
    errors_px = np.linalg.norm(camera.project(rays) - x_first, axis=1)
    return np.asarray(np.where(np.isfinite(errors_px), errors_px, np.inf))


def _are_behind(first: PosedView, second: PosedView, x_first: Array, x_second: Array) -> bool:
    """Whether most points with a parallax are behind a camera."""
    rays = [
        it.view.camera.rays(x) @ it.world_from_camera.rotation.T for it, x in ((first, x_first), (second, x_second))
    ]
    one, other = (it / np.linalg.norm(it, axis=1, keepdims=True) for it in rays)
    baseline = second.world_from_camera.translation - first.world_from_camera.translation
    cosine = (one * other).sum(axis=1)
    along, along_other = one @ baseline, other @ baseline
    # Depths along both rays, times the squared sine of the angle between them.
    depth, depth_other = along - cosine * along_other, cosine * along - along_other
    sine = np.linalg.norm(np.cross(one, other), axis=1)
    focal_px = min(it.view.camera.focal_x_px for it in (first, second))
    is_known = sine > 3 * MAX_ERROR_PX / focal_px
    is_behind = is_known & ((depth < 0) | (depth_other < 0))
    return bool(is_behind.sum() > MAJORITY * is_known.sum())
