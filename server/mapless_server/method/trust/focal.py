"""What focal length a photograph itself says it has, next to the one that came with it.

A wrong focal length is the classic mistake of whoever crops or resizes photographs. The pose is then off towards what
is seen, or away from it, and its own residuals tell little of that: the motion absorbs most of the error. But not all
where points lie at several depths. So the pose is solved again with one more unknown, s = ln(f / f given), the points
where they are (see `resection`), from the answered pose and with all its matches: a wrong focal length makes outliers
of right ones, and the loss begins wide and narrows to find them again. How far off s may be is estimated by a sandwich,
H^-1 (sum_g b_g b_g^T) H^-1, b_g the gradients of the matches in group g (Liang and Zeger 1986), once with references
for groups and once with parts of the image: what neighbours share does not average out over their number. Where depth
hardly varies, or all is far away, it is large, and nothing is said.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from ..optimize import MinimizeOptions, minimize, solve_step
from ..options import check_bounds
from ..resection import Fit, Resection
from ..results import Support


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
        check_bounds(self, "iterations max_matches min_agreeing grid", above=0)
        check_bounds(self, "max_log_ratio max_sigmas first_loss_sigma first_share max_step min_decrease", above=0)
        check_bounds(self, "loss_scales_sigma", above=0)
        if not self.loss_scales_sigma:
            raise ValueError("FocalOptions.loss_scales_sigma must be at least one number, is ()")


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
    def estimated_px(self) -> float:
        """Focal length along x that the photograph says."""
        return self.given_px * math.exp(self.log_ratio)

    def is_wrong(self, options: FocalOptions) -> bool:
        """Whether the focal length that came with the photograph is not its own."""
        is_told = self.agreeing >= max(options.min_agreeing, self.agreeing_before)
        return is_told and abs(self.log_ratio) > max(options.max_log_ratio, options.max_sigmas * self.sigma)


def wrong_focal(support: Support, options: FocalOptions) -> Focal | None:
    """What a support's photograph says of its focal length, where that contradicts the one that came with it.

    Raises:
        ValueError: there is no estimate.
    """
    problem, start, seen_by = problem_of(support, options)
    if len(problem.pixels) < options.min_agreeing:
        return None
    first = solve_step(*problem.linearize(start))
    if first is None or abs(first[6]) < options.first_share * options.max_log_ratio:
        return None
    found = focal_of(problem, start, seen_by, options)
    return found if found is not None and found.is_wrong(options) else None


def focal_of(problem: Resection, start: Fit, seen_by: NDArray[np.bool_], options: FocalOptions) -> Focal | None:
    """What a photograph says of its focal length; None where it says nothing at all (singular equations).

    Args:
        problem: of matches that are in front of the camera.
        start: at the answered pose.
        seen_by: (N, K) which references observe each point.
        options: see there.
    """
    fit, steps = start, MinimizeOptions(options.iterations, options.min_decrease, raised_by=100.0)
    for loss_scale in options.loss_scales_sigma:
        problem = replace(problem, loss_scale_sigma=loss_scale)
        fit = minimize(problem, fit, steps)
    sigma, limit = _sigma(problem, fit, seen_by, options.grid), (3 * loss_scale) ** 2
    if sigma is None:
        return None
    agreeing, before = (int((it.squared < limit).sum()) for it in (fit, start))
    return Focal(fit.log_ratio, sigma, agreeing, before, problem.camera.focal_x_px)


def problem_of(support: Support, options: FocalOptions) -> tuple[Resection, Fit, NDArray[np.bool_]]:
    """Evenly thinned, without points behind the camera, with the first loss; the answered pose; which references see.

    Raises:
        ValueError: there is no estimate.
    """
    if support.estimate is None:
        raise ValueError("without an estimate there is nothing to begin with")
    matches, structure, features = support.matches, support.structure, support.query.features
    camera_from_world = support.estimate.world_from_camera.inverse()
    taken = np.arange(len(matches))[:: max(1, -(-len(matches) // options.max_matches))]
    taken = taken[camera_from_world.apply(structure.x_in_world[matches.point[taken]])[:, 2] > 0]
    point, keypoint = matches.point[taken], matches.keypoint[taken]
    seen_by = np.zeros((len(structure.x_in_world), len(support.references)), bool)
    seen_by[structure.tracks.point, structure.tracks.view] = True
    problem = Resection(
        support.query.camera,
        structure.x_in_world[point],
        features.keypoints[keypoint].astype(np.float64),
        np.asarray(structure.noise.sigma_px(features.sizes_px[keypoint].astype(np.float64))),
        options.first_loss_sigma,
        max_log_step=options.max_step,
    )
    return problem, problem.at(camera_from_world), seen_by[point]


def _sigma(problem: Resection, fit: Fit, seen_by: NDArray[np.bool_], grid: int) -> float | None:
    """Standard deviation of s at an optimum: of independent matches, of references and of parts of the image."""
    hessian, gradient = problem.equations(fit)
    column = solve_step(hessian, np.eye(7)[6])
    if column is None or not column[6] < 0:
        return None
    shift = gradient @ column  # (N,), how far each match alone moves s
    shares = seen_by / np.maximum(1, seen_by.sum(axis=1, keepdims=True))
    size_px = np.array([problem.camera.width_px, problem.camera.height_px])
    cell = np.clip((problem.pixels / size_px * grid).astype(int), 0, grid - 1) @ [grid, 1]
    by_cell = np.zeros(grid**2)
    np.add.at(by_cell, cell, shift)
    return math.sqrt(-float(column[6]) + _scatter(shift @ shares) + _scatter(by_cell))


def _scatter(shifts: Array) -> float:
    """Variance of a sum of independent shifts (G,) whose mean is zero, of which those at zero are not there."""
    count = max(2, int((shifts != 0).sum()))
    return float((shifts**2).sum()) * count / (count - 1)
