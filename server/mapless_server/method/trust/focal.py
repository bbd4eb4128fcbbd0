"""What focal length a photograph itself says it has, next to the one that came with it.

A wrong focal length is the classic mistake of whoever crops or resizes photographs. The pose is then off towards what
is seen, or away from it, and its own residuals tell little of that: the motion absorbs most of the error. But not all
where points lie at several depths. So the pose is solved again with one more unknown, s = ln(f / f given), the points
where they are,

    min  sum_i rho(|u_i - c - e^s f pi(P X_i)|^2 / sigma_i^2),      rho(q) = l^2 log(1 + q / l^2)    (Cauchy's loss)

by Levenberg-Marquardt from the answered pose, with all its matches: a wrong focal length makes outliers of right ones,
and the loss begins wide and narrows to find them again. How far off s may be is told by a sandwich,
H^-1 (sum_g b_g b_g^T) H^-1, b_g the gradients of the matches in group g (Liang and Zeger 1986), once with references
for groups and once with parts of the image: what neighbours share does not average out over their number. Where depth
hardly varies, or all is far away, it is large, and nothing is said.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, normalize, normalize_jacobian, rotation_from_vector

from ..support import Support
from ..uncertainty.perturbation import motion_jacobian


@dataclass(frozen=True)
class FocalOptions:
    """Options of the check.

    Attributes:
        max_log_ratio: |ln(f / f given)| up to which a focal length is never doubted. Of 298 photographs with the true
            one none said more than 0.02.
        max_sigmas: a larger one is believed beyond so many standard deviations, which do not know how far the points
            are off: those of some photographs are too small. Wrong focal lengths of 7 % to 70 % stood beyond seven.
        first_loss_sigma: loss scale of the one step that decides whether to look closer, which most photographs end at.
        first_share: of `max_log_ratio`, up to which that step of s decides not to: 13 of the 298 were looked at closer.
        loss_scales_sigma: of the closer look, from wide, where right matches lie beside a wrong pose, to narrow.
        iterations: steps with each of them.
        max_step: of s at once.
        min_decrease: a step that lowers the cost by a smaller share is the last with this loss.
        max_matches: more are thinned evenly.
        min_agreeing: fewer matches within three times the last loss scale say nothing.
        grid: the image is split into so many parts along each side.
    """

    max_log_ratio: float = 0.04
    max_sigmas: float = 6.0
    first_loss_sigma: float = 10.0
    first_share: float = 0.25
    loss_scales_sigma: tuple[float, ...] = (40.0, 10.0, 3.0, 1.4)
    iterations: int = 8
    max_step: float = 0.5
    min_decrease: float = 1e-3
    max_matches: int = 400
    min_agreeing: int = 20
    grid: int = 4

    def __post_init__(self) -> None:
        counts = (self.iterations, self.max_matches, self.min_agreeing, self.grid)
        shares = (
            self.max_log_ratio,
            self.max_sigmas,
            self.first_loss_sigma,
            self.first_share,
            self.max_step,
            self.min_decrease,
        )
        if not self.loss_scales_sigma or not min(*counts, *shares, *self.loss_scales_sigma) > 0:
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True)
class Focal:
    """What a photograph says of its focal length.

    Attributes:
        log_ratio: s, ln of what it says over what came with it.
        sigma: standard deviation of s.
        agreeing: matches that agree with it, of those looked at, within three times the last loss scale.
        agreeing_before: matches that agree with the answered pose and the given focal length as well.
        given_px: focal length that came with it, along x.
    """

    log_ratio: float
    sigma: float
    agreeing: int
    agreeing_before: int
    given_px: float

    @property
    def told_px(self) -> float:
        """Focal length along x that the photograph says."""
        return self.given_px * math.exp(self.log_ratio)

    def is_wrong(self, options: FocalOptions) -> bool:
        """Whether the focal length that came with the photograph is not its own."""
        is_told = self.agreeing >= max(options.min_agreeing, self.agreeing_before)
        return is_told and abs(self.log_ratio) > max(options.max_log_ratio, options.max_sigmas * self.sigma)


@dataclass(frozen=True, eq=False)
class FocalProblem:
    """Matches of a photograph with points that stay where they are; row i is one of N.

    Attributes:
        camera: with the focal length given.
        x_in_world: (N, 3) points.
        pixels: (N, 2) where they are seen.
        sigma_px: (N,) standard deviation of each coordinate.
        seen_by: (N, K) which references observe the point.
    """

    camera: Camera
    x_in_world: Array
    pixels: Array
    sigma_px: Array
    seen_by: NDArray[np.bool_]

    def at(self, state: _State) -> _Rows:
        """Residuals and what their derivatives need."""
        x_in_camera = self.x_in_world @ state.rotation.T + state.translation
        focal = np.array([self.camera.focal_x_px, self.camera.focal_y_px]) * math.exp(state.log_ratio)
        centred = normalize(x_in_camera) * focal
        offset = np.array([self.camera.principal_x_px, self.camera.principal_y_px]) - self.pixels
        return _Rows(x_in_camera, focal, centred, (centred + offset) / self.sigma_px[:, None], self.sigma_px)


@dataclass(frozen=True, eq=False)
class _State:
    """camera_from_world and s."""

    rotation: Array
    translation: Array
    log_ratio: float

    def moved(self, step: Array) -> _State:
        """After a left perturbation (v, w) of camera_from_world and a step of s, (7,)."""
        turn = rotation_from_vector(step[3:6])
        return _State(turn @ self.rotation, turn @ self.translation + step[:3], self.log_ratio + float(step[6]))


@dataclass(frozen=True, eq=False)
class _Rows:
    """A problem at a state.

    Attributes:
        x_in_camera: (N, 3) points.
        focal_px: (2,) along x and y.
        centred_px: (N, 2) where the points project, from the principal point.
        residual: (N, 2) in standard deviations; NaN behind the camera.
        sigma_px: (N,) these.
    """

    x_in_camera: Array
    focal_px: Array
    centred_px: Array
    residual: Array
    sigma_px: Array

    @property
    def squared(self) -> Array:
        """(N,) squared lengths of the residuals."""
        return np.asarray(np.einsum("na,na->n", self.residual, self.residual))

    def cost(self, loss_scale: float) -> float:
        """NaN for a point behind the camera, which is no decrease."""
        return loss_scale**2 * float(np.log1p(self.squared / loss_scale**2).sum())

    def jacobian(self) -> Array:
        """(N, 2, 7) of the residuals, by a left perturbation (v, w) of camera_from_world and by s."""
        by_point = normalize_jacobian(self.x_in_camera) * (self.focal_px / self.sigma_px[:, None])[:, :, None]
        by_focal = self.centred_px / self.sigma_px[:, None]
        return np.concatenate([by_point @ motion_jacobian(self.x_in_camera), by_focal[:, :, None]], axis=2)

    def equations(self, loss_scale: float) -> tuple[Array, Array]:
        """Hessian (7, 7) of half the cost, and its gradient match by match (N, 7)."""
        jacobian, weight = self.jacobian(), 1 / (1 + self.squared / loss_scale**2)
        weighted = jacobian * weight[:, None, None]
        hessian = weighted.reshape(-1, 7).T @ jacobian.reshape(-1, 7)
        return hessian, np.asarray(np.einsum("nia,ni->na", weighted, self.residual))


def wrong_focal(support: Support, options: FocalOptions) -> Focal | None:
    """What a support's photograph says of its focal length, where that contradicts the one that came with it.

    Raises:
        ValueError: there is no estimate.
    """
    problem, start = _problem_of(support, options)
    if len(problem.pixels) < options.min_agreeing:
        return None
    hessian, gradient = problem.at(start).equations(options.first_loss_sigma)
    first = _solved(hessian, gradient.sum(axis=0), 0.0)
    if first is None or abs(first[6]) < options.first_share * options.max_log_ratio:
        return None
    told = focal_of(problem, start, options)
    return told if told is not None and told.is_wrong(options) else None


def focal_of(problem: FocalProblem, start: _State, options: FocalOptions) -> Focal | None:
    """What a photograph says of its focal length; None where it says nothing at all (singular equations)."""
    state = start
    for loss_scale in options.loss_scales_sigma:
        state = _minimize(problem, state, loss_scale, options)
    narrow = options.loss_scales_sigma[-1]
    rows, limit = problem.at(state), (3 * narrow) ** 2
    sigma = _sigma(problem, rows, narrow, options.grid)
    if sigma is None:
        return None
    before = int((problem.at(start).squared < limit).sum())
    return Focal(state.log_ratio, sigma, int((rows.squared < limit).sum()), before, problem.camera.focal_x_px)


def _problem_of(support: Support, options: FocalOptions) -> tuple[FocalProblem, _State]:
    """Evenly thinned, without points behind the camera; and the answered pose."""
    if support.estimate is None:
        raise ValueError("without an estimate there is nothing to begin with")
    matches, structure, features = support.matches, support.structure, support.query.features
    camera_from_world = support.estimate.world_from_camera.inverse()
    start = _State(camera_from_world.rotation, camera_from_world.translation, 0.0)
    taken = np.arange(len(matches))[:: max(1, -(-len(matches) // options.max_matches))]
    taken = taken[camera_from_world.apply(structure.x_in_world[matches.point[taken]])[:, 2] > 0]
    point, keypoint = matches.point[taken], matches.keypoint[taken]
    seen_by = np.zeros((len(structure.x_in_world), len(support.references)), bool)
    seen_by[structure.tracks.point, structure.tracks.view] = True
    sigma_px = np.asarray(structure.noise.sigma_px(features.sizes_px[keypoint].astype(np.float64)))
    pixels = features.keypoints[keypoint].astype(np.float64)
    problem = FocalProblem(support.query.camera, structure.x_in_world[point], pixels, sigma_px, seen_by[point])
    return problem, start


def _minimize(problem: FocalProblem, state: _State, loss_scale: float, options: FocalOptions) -> _State:
    rows, damping = problem.at(state), 1e-4
    cost = rows.cost(loss_scale)
    hessian, gradient = rows.equations(loss_scale)
    for _ in range(options.iterations):
        step = _solved(hessian, gradient.sum(axis=0), damping)
        if step is None:
            break
        candidate = state.moved(step * min(1.0, options.max_step / max(abs(step[6]), 1e-12)))
        candidate_rows = problem.at(candidate)
        candidate_cost = candidate_rows.cost(loss_scale)
        if not candidate_cost < cost:
            damping *= 100
            continue
        converged = cost - candidate_cost < options.min_decrease * cost
        state, rows, cost, damping = candidate, candidate_rows, candidate_cost, damping * 0.1
        if converged:
            break
        hessian, gradient = rows.equations(loss_scale)
    return state


def _solved(hessian: Array, gradient: Array, damping: float) -> Array | None:
    """The step (7,); None where nothing determines it."""
    try:
        step = -np.linalg.solve(hessian + damping * np.diag(np.diag(hessian)), gradient)
    except np.linalg.LinAlgError:
        return None
    return np.asarray(step, np.float64) if np.isfinite(step).all() else None


def _sigma(problem: FocalProblem, rows: _Rows, loss_scale: float, grid: int) -> float | None:
    """Standard deviation of s at an optimum: of independent matches, of references and of parts of the image."""
    hessian, gradient = rows.equations(loss_scale)
    column = _solved(hessian, np.eye(7)[6], 0.0)
    if column is None or not column[6] < 0:
        return None
    pull = gradient @ column  # (N,), how far each match alone moves s
    shares = problem.seen_by / np.maximum(1, problem.seen_by.sum(axis=1, keepdims=True))
    size_px = np.array([problem.camera.width_px, problem.camera.height_px])
    cell = np.clip((problem.pixels / size_px * grid).astype(int), 0, grid - 1) @ [grid, 1]
    by_cell = np.zeros(grid**2)
    np.add.at(by_cell, cell, pull)
    return math.sqrt(-float(column[6]) + _scatter(pull @ shares) + _scatter(by_cell))


def _scatter(pulls: Array) -> float:
    """Variance of a sum of independent pulls (G,) whose mean is zero, of which those at zero are not there."""
    count = max(2, int((pulls != 0).sum()))
    return float((pulls**2).sum()) * count / (count - 1)
