"""Resection: camera pose and focal length from known points in a photograph; four fits to compare.

    min  sum_i rho(|u_i - c - e^s f pi(P X_i)|^2 / sigma_i^2)      (Cauchy's loss)

over a left perturbation (v, w) of camera_from_world P and s, the logarithm of focal length over given focal length.
Points known from other references are matched in this one. They are fitted with the given pose and focal length, with
another pose, with another focal length, and with both changed. The sigma of a match has two parts: the keypoint's own,
and the projection of the point's covariance into this image, since a point that few references triangulate is uncertain
along their rays.
"""

import math
from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, normalize, normalize_jacobian
from mapless_server.method.optim.optimize import (
    MinimizeOptions,
    cauchy_cost,
    cauchy_weight,
    damped_step,
    minimize,
    motion_jacobian,
    perturbed,
)

_BEHIND_SIGMA = 1e3
"""Residual of a point behind the camera."""
_LOSS_SCALE_SIGMA = 2.0
"""Residual at which the loss flattens; a little wider than in the method's own final adjustment, because the poses of
neighbours are not adjusted here."""
_INLIER_SIGMA = 4.0
"""Largest residual of an inlier."""
_MAX_LOG_STEP = 0.5
"""Largest change of s in one step."""
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


@dataclass(frozen=True, eq=False)
class _Estimate:
    """The residuals at a pose and log_ratio s; row i is one of M matches.

    Attributes:
        x_in_camera: (M, 3) points.
        focal_px: (2,) focal lengths along x and y.
        centred_px: (M, 2) where the points project, from the principal point.
        residual: (M, 2) in standard deviations; NaN behind the camera.
        squared: (M,) squared lengths of the residuals, the argument of the loss.
    """

    camera_from_world: RigidTransform
    log_ratio: float
    x_in_camera: Array
    focal_px: Array
    centred_px: Array
    residual: Array
    squared: Array


@dataclass(frozen=True, eq=False)
class _Resection:
    """The cost and its derivatives, see `optimize.Problem`; `sigma_px` (M,) is that of each match's residual."""

    points: ObservedPoints
    camera: Camera
    sigma_px: Array
    free: Free

    @staticmethod
    def seen_from(
        points: ObservedPoints, camera: Camera, camera_from_world: RigidTransform, log_ratio: float, free: Free
    ) -> "_Resection":
        """The problem with the weights of the points as seen from a pose and with a focal length."""
        seen = with_focal(camera, math.exp(log_ratio))
        return _Resection(points, camera, _sigma_px(points, seen, camera_from_world), free)

    def at(self, camera_from_world: RigidTransform, log_ratio: float) -> _Estimate:
        """Computes the residuals at a pose and focal length."""
        camera, x_in_camera = self.camera, camera_from_world.apply(self.points.x_in_world)
        focal_px = np.array([camera.focal_x_px, camera.focal_y_px]) * math.exp(log_ratio)
        centred_px = normalize(x_in_camera) * focal_px
        offset_px = np.array([camera.principal_x_px, camera.principal_y_px]) - self.points.pixel
        residual = (centred_px + offset_px) / self.sigma_px[:, None]
        squared = np.nan_to_num((residual**2).sum(axis=1), nan=_BEHIND_SIGMA**2)
        return _Estimate(camera_from_world, log_ratio, x_in_camera, focal_px, centred_px, residual, squared)

    def cost(self, at: _Estimate) -> float:
        """See `optimize.Problem`."""
        return cauchy_cost(at.squared, _LOSS_SCALE_SIGMA)

    def linearize(self, at: _Estimate) -> tuple[Array, Array]:
        """Hessian (7, 7) and gradient (7,) of half the cost; points behind the camera count nothing."""
        by_point = normalize_jacobian(at.x_in_camera) * at.focal_px[:, None]
        by_pose = by_point @ motion_jacobian(at.x_in_camera)
        by_all = np.concatenate([by_pose, at.centred_px[:, :, None]], axis=2)
        jacobian = np.nan_to_num(by_all / self.sigma_px[:, None, None])
        weighted = jacobian * cauchy_weight(at.squared, _LOSS_SCALE_SIGMA)[:, None, None]
        hessian = weighted.reshape(-1, 7).T @ jacobian.reshape(-1, 7)
        return hessian, np.einsum("nia,ni->na", weighted, np.nan_to_num(at.residual)).sum(axis=0)

    def step(self, at: _Estimate, equations: tuple[Array, Array], damping: float) -> _Estimate | None:
        """See `optimize.Problem`; a long step of s is shortened alone, so that a pose far off moves by the full one."""
        (hessian, gradient), free = equations, list(self.free.value)
        found = damped_step(hessian[np.ix_(free, free)], gradient[free], damping)
        if found is None:
            return None
        step = np.zeros(7)
        step[free] = found
        step[6] *= min(1.0, _MAX_LOG_STEP / max(abs(step[6]), 1e-12))
        return self.at(perturbed(at.camera_from_world, step[:6]), at.log_ratio + float(step[6]))


def fit_camera(points: ObservedPoints, camera: Camera, starts: tuple[RigidTransform, ...], free: Free) -> CameraFit:
    """Fits from each start and returns the best fit; if the pose is not free, it is the first start."""
    if free in (Free.NOTHING, Free.FOCAL):
        starts = starts[:1]
    return min((_fit(points, camera, start, free) for start in starts), key=lambda fit: fit.cost)


def _fit(points: ObservedPoints, camera: Camera, start: RigidTransform, free: Free) -> CameraFit:
    """Fits from one start, with weights of the points as seen from there, and again from where that leads."""
    pose, log_ratio = start.inverse(), 0.0
    problem = _Resection.seen_from(points, camera, pose, log_ratio, free)
    best = _fit_at(problem, pose, log_ratio)
    for _ in range(_ROUNDS if free.value else 0):
        found = minimize(problem, problem.at(pose, log_ratio), _STEPS)
        pose, log_ratio = found.camera_from_world, found.log_ratio
        # With weights as seen from there, so that costs are comparable.
        problem = _Resection.seen_from(points, camera, pose, log_ratio, free)
        fit = _fit_at(problem, pose, log_ratio)
        if not fit.cost < best.cost:
            break
        best = fit
    return best


def _fit_at(problem: _Resection, camera_from_world: RigidTransform, log_ratio: float) -> CameraFit:
    at = problem.at(camera_from_world, log_ratio)
    length = np.linalg.norm(at.residual, axis=1)
    return CameraFit(
        with_focal(problem.camera, math.exp(log_ratio)),
        camera_from_world.inverse(),
        problem.cost(at),
        length < _INLIER_SIGMA,
        length * problem.sigma_px,
        problem.linearize(at)[0],
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
