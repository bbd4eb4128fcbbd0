"""Check of a photograph's focal length against its matches.

Cropped or resized photographs often come with a wrong focal length. The pose is then off along the viewing direction,
with small residuals: the motion absorbs most of the error, but not all of it if points lie at several depths. So the
pose is estimated again with one more unknown, s = ln(f / f given), and fixed points (see `resection`), from the
answered pose and with all its matches: a wrong focal length turns inliers into outliers, and the loss starts wide and
narrows to recover them. The variance of s is estimated by a sandwich, H^-1 (sum_g b_g b_g^T) H^-1, b_g the gradients of
the matches in group g (Liang and Zeger 1986), once with references as groups and once with parts of the image, because
errors that neighbours share do not average out. If depth hardly varies, or all points are far away, it is large, and
the focal length is not judged.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from mapless.geometry import Array

from ..optimize import MinimizeOptions, minimize, solve_step
from ..options import check_bounds
from ..resection import Fit, Resection
from ..results import Support

LEAST_FREEDOM = 0.5
"""Degrees of freedom of Student's distribution where one reference has nearly all matches."""


@dataclass(frozen=True)
class FocalOptions:
    """Options of the check.

    Attributes:
        max_log_ratio: |ln(f / f given)| up to which a focal length is accepted. Of 298 photographs with the true one
            none had more than 0.02.
        false_alarm: probability that a right focal length is rejected, by Student's distribution: the standard
            deviation is estimated from as many groups as references support the pose. Of 1747 photographs with the
            true one, many with few references, none was rejected; of 120 with one wrong by 7 % to 25 %, two were
            accepted.
        error_inflation: factor on the standard deviation, which leaves out errors of the points.
        first_loss_sigma: loss scale of a first step, after which most photographs are accepted.
        first_share: of `max_log_ratio`, up to which s after that step is accepted: 13 of the 298 were above.
        first_agreeing: least share of matches that agree with the answered pose for that; where fewer do, the step is
            that of the others. Of 629 answers, most of them weak, the full estimation names one more, a wrong one.
        loss_scales_sigma: of the full estimation, from wide, so that matches of a wrong pose are used, to narrow.
        iterations: steps with each of them.
        max_step: largest change of s in one step.
        min_decrease: a step that lowers the cost by a smaller share is the last with this loss.
        max_matches: evenly thinned.
        min_agreeing: fewer matches within three times the last loss scale give no result.
        grid: the image is split into so many parts along each side.
    """

    max_log_ratio: float = 0.04
    false_alarm: float = 0.01
    error_inflation: float = 2.0
    first_loss_sigma: float = 10.0
    first_share: float = 0.25
    first_agreeing: float = 0.25
    loss_scales_sigma: tuple[float, ...] = (40.0, 10.0, 3.0, 1.4)
    iterations: int = 8
    max_step: float = 0.5
    min_decrease: float = 1e-3
    max_matches: int = 400
    min_agreeing: int = 20
    grid: int = 4

    def __post_init__(self) -> None:
        check_bounds(self, "iterations max_matches min_agreeing grid", above=0)
        check_bounds(self, "max_log_ratio error_inflation first_loss_sigma first_share max_step min_decrease", above=0)
        check_bounds(self, "loss_scales_sigma", above=0)
        check_bounds(self, "false_alarm", above=0, below=1)
        check_bounds(self, "first_agreeing", at_least=0, at_most=1)
        if not self.loss_scales_sigma:
            raise ValueError("FocalOptions.loss_scales_sigma must be at least one number, is ()")


@dataclass(frozen=True)
class Focal:
    """A focal length estimated from a photograph's matches.

    Attributes:
        log_ratio: s, ln of the estimated over the given focal length.
        sigma: standard deviation of s.
        agreeing: matches within three times the last loss scale.
        agreeing_before: the same for the answered pose and the given focal length.
        given_px: given focal length along x.
        reference_count: effective number of references that support the pose.
    """

    log_ratio: float
    sigma: float
    agreeing: int
    agreeing_before: int
    given_px: float
    reference_count: float

    @property
    def estimated_px(self) -> float:
        """Estimated focal length along x."""
        return self.given_px * math.exp(self.log_ratio)

    def is_wrong(self, options: FocalOptions) -> bool:
        """Whether the given focal length is significantly wrong."""
        is_supported = self.agreeing >= max(options.min_agreeing, self.agreeing_before)
        quantile = float(stdtrit(max(LEAST_FREEDOM, self.reference_count - 1), 1 - options.false_alarm / 2))
        largest = max(options.max_log_ratio, quantile * options.error_inflation * self.sigma)
        return is_supported and abs(self.log_ratio) > largest


def wrong_focal(support: Support, options: FocalOptions) -> Focal | None:
    """The focal length estimated from a support, if it contradicts the given one; else None.

    Raises:
        ValueError: there is no estimate.
    """
    problem, start, seen_by = problem_of(support, options)
    if len(problem.pixels) < options.min_agreeing:
        return None
    first = solve_step(*problem.linearize(start))
    if first is None:
        return None
    agreeing = (start.squared < (3 * options.loss_scales_sigma[-1]) ** 2).mean()
    if agreeing >= options.first_agreeing and abs(first[6]) < options.first_share * options.max_log_ratio:
        return None
    found = focal_of(problem, start, seen_by, options)
    return found if found is not None and found.is_wrong(options) else None


def focal_of(problem: Resection, start: Fit, seen_by: NDArray[np.bool_], options: FocalOptions) -> Focal | None:
    """Estimates the focal length; None if the equations are singular.

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
    by_reference = seen_by[fit.squared < limit].sum(axis=0).astype(float)
    effective = float(by_reference.sum() ** 2 / max(1.0, (by_reference**2).sum()))
    return Focal(fit.log_ratio, sigma, agreeing, before, problem.camera.focal_x_px, effective)


def problem_of(support: Support, options: FocalOptions) -> tuple[Resection, Fit, NDArray[np.bool_]]:
    """The problem, evenly thinned, without points behind the camera; its start; which references observe each point.

    Raises:
        ValueError: there is no estimate.
    """
    if support.estimate is None:
        raise ValueError("support.estimate must not be None")
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
    """Standard deviation of s at an optimum: from independent matches, references and parts of the image."""
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
    """Variance of a sum of independent shifts (G,) of mean zero; zeros are empty groups."""
    count = max(2, int((shifts != 0).sum()))
    return float((shifts**2).sum()) * count / (count - 1)
