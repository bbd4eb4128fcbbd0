"""What focal length a photograph itself says it has, next to the one that came with it.

A wrong focal length is the classic mistake of a caller who crops or resizes photographs: the pose is off by the share
that the focal length is, towards what is seen or away from it, and nothing in the pose's own residuals is large, since
most of the error is absorbed by that motion. But not all of it, where points lie at several depths. So the pose is
solved again with one more unknown, s = ln(f / f given), the points where they are:

    min  sum_i rho(|u_i - c - e^s f pi(P X_i)|^2 / sigma_i^2),      rho(q) = l^2 log(1 + q / l^2)    (Cauchy's loss)

by Levenberg-Marquardt over seven unknowns, from the answered pose, with all matches: a wrong focal length leaves right
ones out. The loss begins wide and narrows. What s may be off is told by a sandwich, H^-1 (sum_g b_g b_g^T) H^-1 with
b_g the sum of the gradients of the matches in group g (Liang and Zeger 1986), once with references for groups and once
with parts of the image: what neighbours share does not average out over their number. Where depth hardly varies, or all
is far, s and its error are large together, and nothing is said.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, normalize, normalize_jacobian, rotation_from_vector

from .perturbation import motion_jacobian
from .support import Support


@dataclass(frozen=True)
class FocalOptions:
    """Options of the check.

    Attributes:
        max_log_ratio: tolerated |ln(f / f given)|.
        max_sigmas: a difference is believed beyond so many standard deviations.
        loss_scales_sigma: of the Cauchy loss, from wide, where right matches lie beside a wrong pose, to narrow.
        iterations: steps with each of them.
        max_matches: more are thinned evenly.
        min_matches: fewer with a weight of a half at the end say nothing.
        grid: the image is split into so many parts along each side.
    """

    max_log_ratio: float = 0.05
    max_sigmas: float = 4.0
    loss_scales_sigma: tuple[float, ...] = (15.0, 5.0, 1.4)
    iterations: int = 4
    max_matches: int = 400
    min_matches: int = 20
    grid: int = 4

    def __post_init__(self) -> None:
        counts = (self.iterations, self.max_matches, self.min_matches, self.grid)
        if not min(self.max_log_ratio, self.max_sigmas, *self.loss_scales_sigma, *counts) > 0:
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True)
class Focal:
    """What a photograph says of its focal length.

    Attributes:
        log_ratio: ln of what it says over what it was given.
        sigma: standard deviation of that.
        match_count: matches that say so.
        given_px: focal length it came with, along x.
    """

    log_ratio: float
    sigma: float
    match_count: int
    given_px: float

    @property
    def told_px(self) -> float:
        """Focal length that the photograph says."""
        return self.given_px * math.exp(self.log_ratio)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Matches; row i is one of N.

    Attributes:
        camera: with the focal length given.
        x_in_world: (N, 3).
        pixels: (N, 2).
        sigma_px: (N,).
    """

    camera: Camera
    x_in_world: Array
    pixels: Array
    sigma_px: Array

    def residuals(self, rotation: Array, translation: Array, log_ratio: float) -> tuple[Array, Array, Array]:
        """Points in the camera (N, 3), centred pixels (N, 2) and residuals (N, 2) in sigma, NaN behind the camera."""
        x_in_camera = self.x_in_world @ rotation.T + translation
        focal = np.array([self.camera.focal_x_px, self.camera.focal_y_px]) * math.exp(log_ratio)
        centred = normalize(x_in_camera) * focal
        principal = (self.camera.principal_x_px, self.camera.principal_y_px)
        return x_in_camera, centred, (centred + principal - self.pixels) / self.sigma_px[:, None]

    def jacobian(self, x_in_camera: Array, centred: Array, log_ratio: float) -> Array:
        """(N, 2, 7) of the residuals by a left perturbation (v, w) of camera_from_world, and by s."""
        focal = np.array([self.camera.focal_x_px, self.camera.focal_y_px]) * math.exp(log_ratio)
        by_point = normalize_jacobian(x_in_camera) * focal[:, None]
        by_pose = by_point @ motion_jacobian(x_in_camera)
        return np.concatenate([by_pose, centred[:, :, None]], axis=2) / self.sigma_px[:, None, None]


def focal_of(support: Support, options: FocalOptions) -> Focal | None:
    """What a support's photograph says of its focal length; None where its matches are too few to say anything.

    Raises:
        ValueError: there is no estimate.
    """
    if support.estimate is None:
        raise ValueError("without an estimate there is nothing to begin with")
    matches, structure = support.matches, support.structure
    taken = np.arange(len(matches))[:: -(-len(matches) // options.max_matches)]
    point, keypoint = matches.point[taken], matches.keypoint[taken]
    features = support.query.features
    seen_by = np.zeros((len(structure.x_in_world), len(support.references)), bool)
    seen_by[structure.tracks.point, structure.tracks.view] = True
    problem = _Problem(
        support.query.camera,
        structure.x_in_world[point],
        features.keypoints[keypoint].astype(np.float64),
        np.asarray(structure.noise.sigma_px(features.sizes_px[keypoint].astype(np.float64))),
    )
    return solve_focal(problem, seen_by[point], support.estimate.world_from_camera, options)


def solve_focal(
    problem: _Problem, seen_by: NDArray[np.bool_], world_from_camera: RigidTransform, options: FocalOptions
) -> Focal | None:
    camera_from_world = world_from_camera.inverse()
    x = camera_from_world.apply(problem.x_in_world)
    ok = x[:, 2] > 0
    problem = _Problem(problem.camera, problem.x_in_world[ok], problem.pixels[ok], problem.sigma_px[ok])
    seen_by = seen_by[ok]
    R, t, s = camera_from_world.rotation, camera_from_world.translation, 0.0
    if len(problem.pixels) < options.min_matches:
        return None
    def cost(r, l2):
        c = l2 * np.log1p((r**2).sum(1) / l2)
        return float(c.sum())
    for scale in options.loss_scales_sigma:
        l2 = scale**2
        damping = 1e-4
        xc, cen, r = problem.residuals(R, t, s)
        c0 = cost(r, l2)
        for _ in range(options.iterations):
            J = problem.jacobian(xc, cen, s).reshape(-1, 7)
            w = np.repeat(1 / (1 + (r**2).sum(1) / l2), 2)
            H = (J * w[:, None]).T @ J
            g = J.T @ (w * r.ravel())
            while True:
                step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
                T = rotation_from_vector(step[3:6])
                R2, t2, s2 = T @ R, T @ t + step[:3], s + float(np.clip(step[6], -0.5, 0.5))
                xc2, cen2, r2 = problem.residuals(R2, t2, s2)
                c2 = cost(r2, l2)
                if c2 <= c0 or damping > 1e3:
                    break
                damping *= 10
            if not c2 <= c0:
                break
            done = c0 - c2 < 1e-4 * c0
            R, t, s, xc, cen, r, c0 = R2, t2, s2, xc2, cen2, r2, c2
            damping *= 0.1
            if done:
                break
    q = (r**2).sum(1)
    w = 1 / (1 + q / l2)
    n = int((w > 0.3).sum())
    J = problem.jacobian(xc, cen, s)
    Jw = J * w[:, None, None]
    H = np.einsum("nia,nib->ab", Jw, J)
    b = np.einsum("nia,ni->na", Jw, r)
    Hi = np.linalg.pinv(H, hermitian=True)
    row = b @ Hi[6]  # per-match influence on s
    share = seen_by / np.maximum(1, seen_by.sum(1, keepdims=True))
    by_ref = row @ share
    K = max(2, int((share.sum(0) > 0).sum()))
    v_ref = float((by_ref**2).sum()) * K / (K - 1)
    size = np.array([problem.camera.width_px, problem.camera.height_px])
    cell = np.clip((problem.pixels / size * options.grid).astype(int), 0, options.grid - 1)
    by_cell = np.bincount(cell[:, 0] * options.grid + cell[:, 1], row, minlength=options.grid**2)
    v_cell = float((by_cell**2).sum())
    v_ind = float(Hi[6, 6]) * max(1.0, float(np.median(q[w > 0.3]) / (2 * math.log(2))) if n else 1.0)
    f = Focal(s, math.sqrt(v_ref + v_cell + v_ind), n, problem.camera.focal_x_px)
    object.__setattr__(f, "parts", (math.sqrt(v_ref), math.sqrt(v_cell), math.sqrt(v_ind), c0))
    return f
