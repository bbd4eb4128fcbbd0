"""The depth that a sensor measured with the query, compared with its pose, and the pose improved by it.

An inlier's point is at depth z in front of the estimated camera, and the sensor says d. With an error e of the pose (a
shift and a rotation about fixed world axes), errors n of the sensor and of the point, and the factor exp(g) that all
depths of the photograph share,

    ln d - ln z = g - J e + n,    J = [-a, a x (x - c)] / z,

for the viewing direction a, the camera's centre c and the point x. The factor has a prior, the sensor's own; what
remains of e is a linear estimate with the pose's covariance C (Kalman), whose covariance is (C^-1 + H)^-1, with H the
information of the depths. They are robust: Cauchy's loss, at the most probable factor without the prior. Neighbours
share errors, so they count as of `REGIONS` regions (see `structure.kept_depth`).

It is evidence, too. At a wrong pose a factor agrees with its prior by chance, and depths with one another where they
differ by more than their errors: the chances multiply. But a photograph may come with another one's depth, or in
another unit: of a hundred one, say. So depths that disagree speak against a pose by that, and no more. Depths of which
less fit than of right ones, as of a mirrored image, move nothing.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from ..bundle.estimate import DepthCheck, PosedSupport, PoseEstimate, Support, with_information
from ..bundle.pose_problem import DRIFT_INFLATION, USUAL_DRIFT
from ..bundle.priors import LIKELY_PROBABILITY, conflict_threshold
from ..features.tracks import Tracks
from ..features.views import PosedView
from ..optim.optimize import cauchy_weight, moved, normal_sigma, solve_columns, symmetric_products
from ..structure.depth_mistakes import FITTING_SHARE
from ..structure.kept_depth import AGREEING_SIGMA, REGIONS
from ..structure.model import Structure
from ..structure.structure import observe
from .depth_problem import ITERATIONS, MIN_INLIERS
from .pnp import LN_10


@dataclass(frozen=True, eq=False)
class DepthComparison:
    """Depths of a query, compared with its pose.

    Attributes:
        keypoint_count: the query's keypoints with a depth.
        log_ratio: (n,) ln d - ln z.
        variance: (n,) its variance, without that of the factor.
        jacobian: (n, 6) J.
        spread: standard deviation of ln z over the inliers, robust.
        prior_variance: variance of the factor, of the sensor and of what holds the points.
        point_count: inliers on points at the query's own depths, which are not compared.
    """

    keypoint_count: int
    log_ratio: Array
    variance: Array
    jacobian: Array
    spread: float
    prior_variance: float
    point_count: int = 0

    def __len__(self) -> int:
        return len(self.log_ratio)

    def expected(self, covariance: Array) -> Array:
        """Variance (n,) of the log ratios about their common factor, at a pose of this covariance (6, 6)."""
        turned = self.jacobian - self.jacobian.mean(axis=0)
        return np.asarray(self.variance + np.einsum("ni,ij,nj->n", turned, covariance, turned))

    def factor(self, covariance: Array) -> tuple[float, Array]:
        """The most probable logarithm of the factor without its prior, and the weights (n,) of the depths there."""
        value, expected = float(np.median(self.log_ratio)), self.expected(covariance)
        for _ in range(ITERATIONS):
            squared = (self.log_ratio - value) ** 2 / expected
            weight = cauchy_weight(squared, 2.0) / self.variance
            value = float(weight @ self.log_ratio / weight.sum())
        return value, weight

    @property
    def is_used(self) -> bool:
        """Whether points are at the query's own depths."""
        return self.point_count > 0

    def check(self, covariance: Array) -> DepthCheck:
        """How the depths compare with a pose of this covariance (6, 6)."""
        if len(self) < MIN_INLIERS:
            return DepthCheck(self.keypoint_count, len(self), used=self.is_used, point_count=self.point_count)
        factor, weight = self.factor(covariance)
        mean = weight @ self.jacobian / weight.sum()
        agrees = (self.log_ratio - factor) ** 2 < AGREEING_SIGMA**2 * self.expected(covariance)
        expected = self.prior_variance + 1 / weight.sum() + float(mean @ covariance @ mean)
        conflict = bool(2 * agrees.sum() < len(self) or factor**2 > conflict_threshold(1) * expected)
        sigma = math.sqrt(1 / weight.sum())
        return DepthCheck(
            self.keypoint_count,
            len(self),
            int(agrees.sum()),
            math.exp(factor),
            sigma,
            conflict,
            self.is_used,
            point_count=self.point_count,
        )

    def log10_chance(self, check: DepthCheck) -> float:
        """log10 of the chance that a wrong pose's depths agree so; above 0 where they disagree."""
        if not check.factor:
            return 0.0
        if check.conflict:
            return -math.log10(LIKELY_PROBABILITY)
        of_factor = 2 * math.sqrt(conflict_threshold(1) * self.prior_variance) / LN_10
        of_depth = 2 * AGREEING_SIGMA * float(np.median(np.sqrt(self.variance))) / max(self.spread, 1e-9)
        agreeing = (2 * check.agreeing_count - len(self)) / REGIONS
        return min(0.0, math.log10(of_factor)) + max(0.0, agreeing) * min(0.0, math.log10(of_depth))

    def gradient_and_information(self, covariance: Array) -> tuple[Array, Array]:
        """J^T W r (6,) and J^T W J (6, 6) at a pose of this covariance (6, 6), the factor eliminated with its prior."""
        _, weight = self.factor(covariance)
        weighted = self.jacobian.T * weight
        total = float(weight.sum()) + 1 / self.prior_variance
        shared = weighted.sum(axis=1)
        gradient = weighted @ self.log_ratio - shared * float(weight @ self.log_ratio) / total
        return gradient, weighted @ self.jacobian - np.outer(shared, shared) / total


def compare_depths(support: PosedSupport) -> DepthComparison | None:
    """The query's depths at the inliers of a support's estimate; None if it has none.

    Points that are at the query's own depths have no other one, and do not count.
    """
    depths, estimate, structure = support.query.depths, support.estimate, support.structure
    if depths is None:
        return None
    point, keypoint = support.matches.point[estimate.inliers], support.matches.keypoint[estimate.inliers]
    point_count = int(at_own_depth(support)[point].sum())
    known = np.isfinite(depths.depth[keypoint])
    point, keypoint = point[known], keypoint[known]
    pose, x_in_world = estimate.world_from_camera, structure.x_in_world[point]
    axis, offset = pose.rotation[:, 2], x_in_world - pose.translation
    z = offset @ axis
    of_points = _variances(structure, support.references, point, axis) / z**2
    usable = np.isfinite(of_points) & (z > 0)
    z, offset, keypoint, of_points = z[usable], offset[usable], keypoint[usable], of_points[usable]
    jacobian = np.concatenate([np.broadcast_to(-axis, (len(z), 3)), np.cross(axis, offset)], axis=1) / z[:, None]
    shared = depths.common_sigma**2 * len(z) / REGIONS
    log_z = np.log(z)
    median = float(np.median(log_z)) if len(z) else 0.0
    return DepthComparison(
        int(np.isfinite(depths.depth).sum()),
        np.log(depths.depth[keypoint].astype(np.float64)) - log_z,
        depths.relative_sigma[keypoint].astype(np.float64) ** 2 + of_points + shared,
        jacobian,
        float(normal_sigma(log_z - median)) if len(z) else 0.0,
        depths.common_sigma**2 + _held(support, point[usable], math.exp(median)),
        point_count,
    )


def at_own_depth(support: Support) -> NDArray[np.bool_]:
    """Mask (P,) of the points at the photograph's own depth: one reference observes them, and has no depth there."""
    structure = support.structure
    if support.query.depths is None or structure.planes is None:  # then points are triangulated, or a network's
        return np.zeros(len(structure.x_in_world), bool)
    return ~structure.triangulated & ~(structure.planes.information > 0)


def checked(support: PosedSupport) -> PosedSupport:
    """The support with the depth check of its estimate; unchanged without depth of the query."""
    comparison = compare_depths(support)
    return support if comparison is None else replace(support, estimate=_checked(support.estimate, comparison))


def _checked(estimate: PoseEstimate, comparison: DepthComparison) -> PoseEstimate:
    check = comparison.check(estimate.covariance)
    return replace(estimate, depth_check=check, depth_log10_chance=comparison.log10_chance(check))


def improved(support: PosedSupport) -> PosedSupport:
    """As `checked`, with the pose improved by depths that do not contradict it and know more of it than its matches."""
    comparison = compare_depths(support)
    if comparison is None:
        return support
    return replace(support, estimate=_improved(_checked(support.estimate, comparison), comparison))


def contradicted(support: PosedSupport, excess: float) -> PosedSupport:
    """The support of a pose by depths, with a conflict if their errors exceed those stated as no right depth's do."""
    check, chance = support.estimate.depth_check, support.estimate.depth_log10_chance
    if check is None or check.factor or excess <= AGREEING_SIGMA:
        return support
    chance -= math.log10(LIKELY_PROBABILITY)
    estimate = replace(support.estimate, depth_check=replace(check, conflict=True), depth_log10_chance=chance)
    return replace(support, estimate=estimate)


def _improved(estimate: PoseEstimate, comparison: DepthComparison) -> PoseEstimate:
    check = estimate.depth_check
    if check is None or not check.factor or check.conflict:
        return estimate
    if check.agreeing_count < FITTING_SHARE * check.compared_count:
        return estimate
    gradient, information = comparison.gradient_and_information(estimate.covariance)
    gain = float(np.abs(np.linalg.eigvals(information @ estimate.covariance)).max())
    if not gain >= 1:
        return estimate
    better = with_information(estimate, information)
    return replace(
        better,
        world_from_camera=moved(estimate.world_from_camera, better.covariance @ gradient),
        without_priors=estimate.without_priors or estimate,
        depth_check=replace(check, used=True),
    )


def _variances(structure: Structure, references: Sequence[PosedView], point: NDArray[np.intp], axis: Array) -> Array:
    """Variances (n,) along an axis (3,) of points, by their indices; NaN where a point is not determined."""
    is_used = np.zeros(len(structure.x_in_world), bool)
    is_used[point] = True
    rows = (np.cumsum(is_used) - 1)[point]
    tracks: Tracks = structure.tracks.select(is_used)
    if not len(point):
        return np.empty(0)
    _, by_point = observe(tracks, references, structure.noise).linearized(structure.x_in_world[is_used])
    information = tracks.sum_columns(symmetric_products(by_point, by_point))
    if structure.planes is not None:
        normal = structure.planes[is_used].normal.T
        information = information + symmetric_products(
            (normal * structure.planes.information[is_used])[None], normal[None]
        )
    # A keypoint alone determines no depth; the adjugate of its rounded information may.
    alone = np.bincount(tracks.point) < 2
    if structure.planes is not None:
        alone &= ~(structure.planes.information[is_used] > 0)
    solved = solve_columns(information, np.broadcast_to(axis[:, None], (3, information.shape[1])))
    return np.asarray(np.where(alone, np.nan, axis @ solved)[rows], np.float64)


def _held(support: PosedSupport, point: NDArray[np.intp], depth: float) -> float:
    """Variance of the logarithm of the factor by what the points have in common: the references' depths and poses."""
    structure, references = support.structure, support.references
    focal_px = float(np.median([it.view.camera.focal_x_px for it in references]))
    share = DRIFT_INFLATION * USUAL_DRIFT * structure.noise.level_px / focal_px
    stated = [it.provenance.accuracy.position_68_m for it in references if it.provenance.accuracy is not None]
    of_depths = (
        0.0
        if structure.planes is None
        else float(np.median(np.linalg.norm(structure.planes.common[point], axis=1)))
        if len(point)
        else 0.0
    )
    return share**2 + (max(stated, default=0.0) / depth) ** 2 + (of_depths / depth) ** 2
