"""Camera pose and focal length from known points in a photograph: four fits to compare.

Points known from other references are matched in this one. They are fitted with the given pose and focal length, with
another pose, with another focal length, and with both changed. Each is a robust fit (see `camera_fit`). The
sigma of a match has two parts: the keypoint's own, and the projection of the point's covariance into this image, since
a point that few references triangulate is uncertain along their rays.
"""

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, normalize_jacobian
from mapless_server.method.optim.optimize import MinimizeOptions, minimize
from mapless_server.scenes.audit.camera_fit import Resection

_BEHIND_SIGMA = 1e3
"""Residual of a point behind the camera."""
_LOSS_SCALE_SIGMA = 2.0
"""Residual at which the loss flattens; a little wider than in the method's own final adjustment, because the poses of
neighbours are not adjusted here."""
_INLIER_SIGMA = 4.0
"""Largest residual of an inlier."""
_STEPS, _ROUNDS = MinimizeOptions(5, 1e-6, damping=1e-3), 6
"""From a pose that is off by metres about 20 steps are needed. After every few the points' uncertainty is projected
anew: with that of the start, some fits ended metres away from a right pose, where nothing agreed any better."""


class Free(Enum):
    """The parameters that a fit may change; the value lists the indices into x y z rx ry rz focal."""

    NOTHING = ()
    POSE = (0, 1, 2, 3, 4, 5)
    FOCAL = (6,)
    BOTH = (0, 1, 2, 3, 4, 5, 6)


@dataclass(frozen=True, eq=False)
class ObservedPoints:
    """Known points matched in a photograph.

    Attributes:
        pixel: (M, 2) their positions in the image.
        x_in_world: (M, 3) metres.
        point_covariance: (M, 3, 3) of the points, square metres, world axes.
        keypoint_sigma_px: (M,) of each coordinate of the pixels.
    """

    pixel: Array
    x_in_world: Array
    point_covariance: Array
    keypoint_sigma_px: Array

    def __len__(self) -> int:
        return len(self.pixel)


@dataclass(frozen=True, eq=False)
class CameraFit:
    """A fitted camera.

    Attributes:
        camera: the given camera, with the fitted focal length if that was free.
        world_from_camera: the fitted pose; the given one if it was not free.
        cost: the robust sum; infinite where a fit was impossible.
        inliers: (M,) which matches agree with it.
        error_px: (M,) reprojection errors; NaN for points behind the camera.
        information: (7, 7) J^T W J of camera_from_world's left perturbation and the logarithm of the focal length.
    """

    camera: Camera
    world_from_camera: RigidTransform
    cost: float
    inliers: NDArray[np.bool_]
    error_px: Array
    information: Array

    @property
    def inlier_count(self) -> int:
        """Number of matches that agree with it."""
        return int(self.inliers.sum())


def fit_camera(points: ObservedPoints, camera: Camera, starts: tuple[RigidTransform, ...], free: Free) -> CameraFit:
    """Fits from each start and returns the best fit; if the pose is not free, it is the first start."""
    if free in (Free.NOTHING, Free.FOCAL):
        starts = starts[:1]
    return min((_fit(points, camera, start, free) for start in starts), key=lambda fit: fit.cost)


def _fit(points: ObservedPoints, camera: Camera, start: RigidTransform, free: Free) -> CameraFit:
    """Fits from one start, with weights of the points as seen from there, and again from where that leads."""
    pose, log_ratio = start.inverse(), 0.0
    best = _fit_at(points, camera, pose, log_ratio, free)
    for _ in range(_ROUNDS if free.value else 0):
        problem = _problem(points, camera, pose, log_ratio, free)
        fit = minimize(problem, problem.at(pose, log_ratio), _STEPS)
        pose, log_ratio = fit.camera_from_world, fit.log_ratio
        found = _fit_at(points, camera, pose, log_ratio, free)
        if not found.cost < best.cost:
            break
        best = found
    return best


def _fit_at(points: ObservedPoints, camera: Camera, pose: RigidTransform, log_ratio: float, free: Free) -> CameraFit:
    """A camera_from_world and a focal length as a fit, its weights as seen from there, so that costs are comparable."""
    problem = _problem(points, camera, pose, log_ratio, free)
    fit = problem.at(pose, log_ratio)
    length = np.linalg.norm(fit.residual, axis=1)
    return CameraFit(
        with_focal(camera, math.exp(log_ratio)),
        pose.inverse(),
        problem.cost(fit),
        length < _INLIER_SIGMA,
        length * problem.sigma_px,
        problem.linearize(fit)[0],
    )


def _problem(points: ObservedPoints, camera: Camera, pose: RigidTransform, log_ratio: float, free: Free) -> Resection:
    return Resection(
        camera,
        points.x_in_world,
        points.pixel,
        _sigma_px(points, with_focal(camera, math.exp(log_ratio)), pose),
        _LOSS_SCALE_SIGMA,
        free.value,
        behind_sigma=_BEHIND_SIGMA,
        shorten_all=False,
    )


def with_focal(camera: Camera, ratio: float) -> Camera:
    """Returns the camera with both focal lengths multiplied by `ratio`."""
    return replace(camera, focal_x_px=camera.focal_x_px * ratio, focal_y_px=camera.focal_y_px * ratio)


def _sigma_px(points: ObservedPoints, camera: Camera, camera_from_world: RigidTransform) -> Array:
    """Standard deviation (M,) of each match's residual: keypoint noise plus the larger axis of the point's ellipse."""
    x_in_camera = camera_from_world.apply(points.x_in_world)
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    jacobian = normalize_jacobian(x_in_camera) * focal[:, None] @ camera_from_world.rotation
    projected = jacobian @ points.point_covariance @ np.swapaxes(jacobian, 1, 2)
    half_trace = (projected[:, 0, 0] + projected[:, 1, 1]) / 2
    half_difference = (projected[:, 0, 0] - projected[:, 1, 1]) / 2
    largest = half_trace + np.hypot(half_difference, projected[:, 0, 1])
    return np.asarray(np.sqrt(points.keypoint_sigma_px**2 + np.nan_to_num(largest)))
