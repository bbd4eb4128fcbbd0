"""Resection: pose and focal length of a photograph from fixed points.

    min  sum_i rho(|u_i - c - e^s f pi(P X_i)|^2 / sigma_i^2)      (Cauchy's loss)

over a left perturbation (v, w) of camera_from_world P and s, the logarithm of focal length over given focal length.
"""

import math
from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform, normalize, normalize_jacobian
from mapless_server.method.optim.optimize import cauchy_cost, cauchy_weight, damped_step, motion_jacobian, perturbed


@dataclass(frozen=True, eq=False)
class Fit:
    """A resection at one pose and focal length; row i is one of N matches.

    Attributes:
        camera_from_world: the pose.
        log_ratio: s.
        x_in_camera: (N, 3) points.
        focal_px: (2,) focal lengths along x and y.
        centred_px: (N, 2) where the points project, from the principal point.
        residual: (N, 2) in standard deviations; NaN behind the camera.
        squared: (N,) squared lengths of the residuals, the argument of the loss.
    """

    camera_from_world: RigidTransform
    log_ratio: float
    x_in_camera: Array
    focal_px: Array
    centred_px: Array
    residual: Array
    squared: Array


MAX_LOG_STEP = 0.5
"""Largest change of s in one step."""


@dataclass(frozen=True, eq=False)
class Resection:
    """The cost and its derivatives; see `optimize.Problem`.

    Attributes:
        camera: the pinhole camera with the given focal length.
        x_in_world: (N, 3) points.
        pixels: (N, 2) where they are seen.
        sigma_px: (N,) standard deviation of each coordinate.
        loss_scale_sigma: scale of the Cauchy loss, in standard deviations.
        unknowns: those of v, w and s that are free.
        behind_sigma: residual of a point behind the camera; if NaN, no step may move a point there.
        shorten_all: whether a step with a larger change of s than `MAX_LOG_STEP` is shortened as a whole, which keeps
            its direction near the minimum, or in s alone, so that a pose far from the minimum still moves by the full
            step.
    """

    camera: Camera
    x_in_world: Array
    pixels: Array
    sigma_px: Array
    loss_scale_sigma: float
    unknowns: tuple[int, ...] = (0, 1, 2, 3, 4, 5, 6)
    behind_sigma: float = math.nan
    shorten_all: bool = True

    def at(self, camera_from_world: RigidTransform, log_ratio: float = 0.0) -> Fit:
        """Computes the residuals at a pose and focal length."""
        camera, x_in_camera = self.camera, camera_from_world.apply(self.x_in_world)
        focal_px = np.array([camera.focal_x_px, camera.focal_y_px]) * math.exp(log_ratio)
        centred_px = normalize(x_in_camera) * focal_px
        offset_px = np.array([camera.principal_x_px, camera.principal_y_px]) - self.pixels
        residual = (centred_px + offset_px) / self.sigma_px[:, None]
        squared = np.nan_to_num((residual**2).sum(axis=1), nan=self.behind_sigma**2)
        return Fit(camera_from_world, log_ratio, x_in_camera, focal_px, centred_px, residual, squared)

    def cost(self, fit: Fit) -> float:
        """See `optimize.Problem`."""
        return cauchy_cost(fit.squared, self.loss_scale_sigma)

    def linearize(self, fit: Fit) -> tuple[Array, Array]:
        """Hessian (7, 7) and gradient (7,) of half the cost."""
        hessian, gradients = self.equations(fit)
        return hessian, gradients.sum(axis=0)

    def equations(self, fit: Fit) -> tuple[Array, Array]:
        """Hessian (7, 7), and the gradient of each match (N, 7); zero behind the camera."""
        by_point = normalize_jacobian(fit.x_in_camera) * fit.focal_px[:, None]
        by_pose = by_point @ motion_jacobian(fit.x_in_camera)
        by_all = np.concatenate([by_pose, fit.centred_px[:, :, None]], axis=2)
        jacobian = np.nan_to_num(by_all / self.sigma_px[:, None, None])
        weighted = jacobian * cauchy_weight(fit.squared, self.loss_scale_sigma)[:, None, None]
        hessian = weighted.reshape(-1, 7).T @ jacobian.reshape(-1, 7)
        return hessian, np.asarray(np.einsum("nia,ni->na", weighted, np.nan_to_num(fit.residual)))

    def step(self, fit: Fit, equations: tuple[Array, Array], damping: float) -> Fit | None:
        """See `optimize.Problem`."""
        (hessian, gradient), free = equations, list(self.unknowns)
        found = damped_step(hessian[np.ix_(free, free)], gradient[free], damping)
        if found is None:
            return None
        step = np.zeros(7)
        step[free] = found
        step[slice(7) if self.shorten_all else 6] *= min(1.0, MAX_LOG_STEP / max(abs(step[6]), 1e-12))
        return self.at(perturbed(fit.camera_from_world, step[:6]), fit.log_ratio + float(step[6]))
