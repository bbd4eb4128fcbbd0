"""Where a photograph was taken and with what focal length, from points that it shows: four explanations to compare.

Points known from other references, seen in this one, are explained by the given pose and focal length; or by another
pose; or by another focal length; or by another of both. Each explanation is a robust least-squares fit,

    min  sum_m c^2 log(1 + |r_m|^2 / (sigma_m^2 c^2))     (Cauchy, which forgets wrong matches),

over a left perturbation of camera_from_world (6), the logarithm of the focal length (1), or both. A match's sigma has
two parts, the keypoint's own and what the point's uncertainty looks like in this image: where few references
triangulate a point, it is uncertain along their rays.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, normalize, normalize_jacobian, rotation_from_vector
from mapless_server.method.uncertainty.perturbation import motion_jacobian


class Freedom(Enum):
    """What an explanation may change; the value says which of x y z rx ry rz focal."""

    NOTHING = ()
    POSE = (0, 1, 2, 3, 4, 5)
    FOCAL = (6,)
    BOTH = (0, 1, 2, 3, 4, 5, 6)


@dataclass(frozen=True)
class ResectionOptions:
    """Options of a fit.

    Attributes:
        loss_scale_sigma: residual at which the loss turns; as of the method's own final adjustment, a little wider,
            because the neighbours' poses are not adjusted here.
        iterations: at most so many Levenberg-Marquardt steps; from a pose that is off by metres it takes about 20.
        min_decrease: stop when a step lowers the cost by a smaller share.
        inlier_sigma: largest residual of an inlier.
    """

    loss_scale_sigma: float = 2.0
    iterations: int = 30
    min_decrease: float = 1e-6
    inlier_sigma: float = 4.0

    def __post_init__(self) -> None:
        if not min(self.loss_scale_sigma, self.iterations, self.min_decrease, self.inlier_sigma) > 0:
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True, eq=False)
class Sighting:
    """Points that a photograph shows.

    Attributes:
        pixel: (M, 2) where it shows them.
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
class Explanation:
    """One fit.

    Attributes:
        camera: as given, but for the focal length where that was free.
        world_from_camera: as given, or as fitted.
        cost: the robust sum; infinite where a fit was impossible.
        inliers: (M,) which matches it explains.
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
        """How many matches it explains."""
        return int(self.inliers.sum())


def explain(
    sighting: Sighting,
    camera: Camera,
    starts: tuple[RigidTransform, ...],
    freedom: Freedom,
    options: ResectionOptions,
) -> Explanation:
    """The best fit of those begun at each start; where the pose is not free, the first start is the pose."""
    candidates = [
        _minimize(sighting, camera, start, freedom, options) for start in (starts if 0 in freedom.value else starts[:1])
    ]
    return min(candidates, key=lambda candidate: candidate.cost)


def _minimize(
    sighting: Sighting, camera: Camera, start: RigidTransform, freedom: Freedom, options: ResectionOptions
) -> Explanation:
    camera_from_world = start.inverse()
    sigma_px = _sigma_px(sighting, camera, camera_from_world)
    residual, jacobian = _linearize(sighting, camera, camera_from_world, sigma_px)
    cost, free, damping = _cost(residual, options), list(freedom.value), 1e-3
    for _ in range(options.iterations if free else 0):
        weight = _weight(residual, options)
        reduced = jacobian[:, :, free]
        hessian = np.einsum("m,mia,mib->ab", weight, reduced, reduced)
        gradient = np.einsum("m,mia,mi->a", weight, reduced, np.nan_to_num(residual))
        step = np.zeros(7)
        step[free] = -np.linalg.lstsq(hessian + damping * np.diag(hessian.diagonal() + 1e-12), gradient, rcond=None)[0]
        moved_camera, moved = _moved(camera, camera_from_world, step)
        candidate = _linearize(sighting, moved_camera, moved, sigma_px)
        candidate_cost = _cost(candidate[0], options)
        if not candidate_cost < cost:
            damping *= 10
            if damping > 1e6:
                break
            continue
        converged = cost - candidate_cost < options.min_decrease * cost
        camera, camera_from_world, cost, (residual, jacobian) = moved_camera, moved, candidate_cost, candidate
        damping *= 0.1
        if converged:
            break
    # Weighed by what points look like from where it ended, so that explanations from different starts can be compared.
    sigma_px = _sigma_px(sighting, camera, camera_from_world)
    residual, jacobian = _linearize(sighting, camera, camera_from_world, sigma_px)
    information = np.einsum("m,mia,mib->ab", _weight(residual, options), jacobian, jacobian)
    length = np.linalg.norm(residual, axis=1)
    return Explanation(
        camera,
        camera_from_world.inverse(),
        _cost(residual, options),
        length < options.inlier_sigma,
        length * sigma_px,
        information,
    )


def _moved(camera: Camera, camera_from_world: RigidTransform, step: Array) -> tuple[Camera, RigidTransform]:
    turn = rotation_from_vector(step[3:6])
    pose = RigidTransform(turn @ camera_from_world.rotation, turn @ camera_from_world.translation + step[:3])
    return with_focal(camera, float(np.exp(np.clip(step[6], -0.5, 0.5)))), pose


def with_focal(camera: Camera, ratio: float) -> Camera:
    """The camera with both focal lengths `ratio` times as long."""
    return replace(camera, focal_x_px=camera.focal_x_px * ratio, focal_y_px=camera.focal_y_px * ratio)


def _sigma_px(sighting: Sighting, camera: Camera, camera_from_world: RigidTransform) -> Array:
    """(M,) of each match's residual, the larger axis of the projected point's ellipse added to the keypoint's noise."""
    x_in_camera = camera_from_world.apply(sighting.x_in_world)
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    jacobian = normalize_jacobian(x_in_camera) * focal[:, None] @ camera_from_world.rotation
    projected = jacobian @ sighting.point_covariance @ np.swapaxes(jacobian, 1, 2)
    half_trace = (projected[:, 0, 0] + projected[:, 1, 1]) / 2
    half_difference = (projected[:, 0, 0] - projected[:, 1, 1]) / 2
    largest = half_trace + np.hypot(half_difference, projected[:, 0, 1])
    return np.asarray(np.sqrt(sighting.keypoint_sigma_px**2 + np.nan_to_num(largest)))


def _linearize(
    sighting: Sighting, camera: Camera, camera_from_world: RigidTransform, sigma_px: Array
) -> tuple[Array, Array]:
    """Residuals (M, 2) in standard deviations and their derivatives (M, 2, 7); zero derivatives behind the camera."""
    x_in_camera = camera_from_world.apply(sighting.x_in_world)
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    ideal = normalize(x_in_camera)
    projected = ideal * focal + (camera.principal_x_px, camera.principal_y_px)
    by_pose = (normalize_jacobian(x_in_camera) * focal[:, None]) @ motion_jacobian(x_in_camera)
    jacobian = np.concatenate([by_pose, (ideal * focal)[:, :, None]], axis=2) / sigma_px[:, None, None]
    return (projected - sighting.pixel) / sigma_px[:, None], np.nan_to_num(jacobian)


_BEHIND_SIGMA = 1e3
"""A point behind the camera counts as an error so large."""


def _cost(residual: Array, options: ResectionOptions) -> float:
    squared = np.nan_to_num((residual**2).sum(axis=1), nan=_BEHIND_SIGMA**2)
    scale = options.loss_scale_sigma**2
    return float(scale * np.log1p(squared / scale).sum())


def _weight(residual: Array, options: ResectionOptions) -> Array:
    squared = np.nan_to_num((residual**2).sum(axis=1), nan=_BEHIND_SIGMA**2)
    return np.asarray(1 / (1 + squared / options.loss_scale_sigma**2))
