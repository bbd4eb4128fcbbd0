"""Refinement of a pose from 2D-3D matches with fixed points, and from priors.

    min  sum_i rho(|u_i - pi(P, X_i)|^2 / sigma^2) + w sum_k r_k^T C_k^-1 r_k,    rho(s) = c^2 log(1 + s / c^2)

(Cauchy's loss) over the pose alone, six unknowns, by Levenberg-Marquardt. PoseLib's refinement has no priors.
"""

from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform

from ..optimize import MinimizeOptions, cauchy_cost, cauchy_weight, damped_step, minimize
from ..options import check_bounds
from ..perturbation import moved, pose_jacobian, world_jacobian
from .known import NO_PRIORS, Priors


@dataclass(frozen=True)
class PoseOnlyOptions:
    """Options of the refinement.

    Attributes:
        sigma_px: standard deviation of a right match.
        loss_scale_sigma: scale of the Cauchy loss, in standard deviations.
        prior_weight: w, factor by which the matches have less information than if their errors were independent.
        iterations: largest number of steps.
        min_decrease: stop when a step lowers the cost by a smaller share.
    """

    sigma_px: float = 1.0
    loss_scale_sigma: float = 1.4
    prior_weight: float = 4.0
    iterations: int = 10
    min_decrease: float = 1e-4

    def __post_init__(self) -> None:
        check_bounds(self, "sigma_px loss_scale_sigma prior_weight iterations min_decrease", above=0)


def refine_pose(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    world_from_camera: RigidTransform,
    priors: Priors,
    options: PoseOnlyOptions,
) -> RigidTransform:
    """Minimizes the cost, starting from a pose; all priors are used.

    The camera is a pinhole camera; points (N, 3) in the world are seen at the pixels (N, 2), and those behind the
    camera at the start are not used.
    """
    in_front = world_from_camera.inverse().apply(x_in_world)[:, 2] > 0
    problem = _Problem(camera, x_in_world[in_front], pixels[in_front], priors, options)
    return minimize(problem, world_from_camera, MinimizeOptions(options.iterations, options.min_decrease))


def information(
    camera: Camera, x_in_world: Array, pixels: Array, world_from_camera: RigidTransform, options: PoseOnlyOptions
) -> Array:
    """Information (6, 6) of the matches alone: the inverse covariance of the pose error if they were independent."""
    in_front = world_from_camera.inverse().apply(x_in_world)[:, 2] > 0
    problem = _Problem(camera, x_in_world[in_front], pixels[in_front], NO_PRIORS, options)
    return problem.linearize(world_from_camera)[1]


class _Problem:
    """The cost and its derivatives by the pose error; see `optimize.Problem`."""

    def __init__(
        self, camera: Camera, x_in_world: Array, pixels: Array, priors: Priors, options: PoseOnlyOptions
    ) -> None:
        self.camera, self.x_in_world, self.pixels = camera, x_in_world, pixels
        self.priors, self.options = priors, options

    def residuals(self, pose: RigidTransform) -> tuple[Array, Array]:
        """Points in the camera frame (N, 3), and reprojection errors (N, 2) in standard deviations."""
        x_in_camera = (self.x_in_world - pose.translation) @ pose.rotation
        return x_in_camera, (self.camera.project(x_in_camera) - self.pixels) / self.options.sigma_px

    def cost(self, pose: RigidTransform) -> float:
        """Cost at a pose; NaN if a point is behind the camera, so that the step is rejected."""
        _, residual = self.residuals(pose)
        matched = cauchy_cost((residual**2).sum(axis=1), self.options.loss_scale_sigma)
        return matched + self.options.prior_weight * self.priors.cost(pose)

    def linearize(self, pose: RigidTransform) -> tuple[Array, Array]:
        x_in_camera, residual = self.residuals(pose)
        weight = cauchy_weight((residual**2).sum(axis=1), self.options.loss_scale_sigma)
        jacobian = pose_jacobian(self.camera, x_in_camera) / self.options.sigma_px
        weighted, to_camera = weight * jacobian, np.linalg.inv(world_jacobian(pose))
        by_pose = weighted[0] @ residual[:, 0] + weighted[1] @ residual[:, 1]
        hessian = weighted[0] @ jacobian[0].T + weighted[1] @ jacobian[1].T
        gradient, information = self.priors.gradient_and_information(pose)
        w = self.options.prior_weight
        return to_camera.T @ by_pose + w * gradient, to_camera.T @ hessian @ to_camera + w * information

    def step(self, pose: RigidTransform, equations: tuple[Array, Array], damping: float) -> RigidTransform | None:
        gradient, hessian = equations
        error = damped_step(hessian, gradient, damping)
        return None if error is None else moved(pose, error)
