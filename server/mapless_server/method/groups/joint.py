"""Joint adjustment of a group: poses of its photographs, their points, and the references.

What `adjust` minimizes for one photograph, summed over those of a group,

    min  sum_f sum_obs rho(|r_o|^2 / sigma_o^2) + xi^T C^-1 xi + (cost of the group's parameters),

where the references xi are common to the photographs that use them, and C is that of `pose_errors`, relative to the
place of the last photograph. Each photograph has its own points, which are eliminated photograph by photograph; the
rest is a dense system of the references and the group's parameters, whose cost is zero for a rig and that of the
tracked steps for a sequence (see `drift`). Soft priors that agree with the photographs add their terms.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic

import numpy as np

from mapless.geometry import Array, RigidTransform

from ..optimize import MinimizeOptions, minimize
from ..perturbation import reprojection_errors_px
from ..priors.known import PriorCheck, Priors
from ..results import PointMatches
from .images import MatchedImage, PosedImage
from .problem import GroupProblem, GroupState, JointOptions, S

__all__ = ["GroupState", "JointEstimate", "JointOptions", "adjust_in_rounds", "adjust_jointly", "covariance_in_world"]


@dataclass(frozen=True, eq=False)
class JointEstimate(Generic[S]):
    """A group's adjusted poses.

    Attributes:
        state: the poses at the optimum.
        covariance: (N, N) covariance of the state's parameters.
        matched: the posed photographs, in the order of the matched images.
        prior_checks: comparisons with the photographs' priors, by the photographs' index.
    """

    state: S
    covariance: Array
    matched: tuple[PosedImage, ...]
    prior_checks: Mapping[int, tuple[PriorCheck, ...]] = field(default_factory=dict)

    @property
    def inlier_count(self) -> int:
        """Number of inliers of all photographs."""
        return sum(int(it.inliers.sum()) for it in self.matched)


def adjust_in_rounds(
    matched_images: Sequence[MatchedImage],
    state: S,
    options: JointOptions,
    rounds: int,
    priors: Mapping[int, Priors] | None = None,
) -> JointEstimate[S]:
    """Alternates guided searches from the current poses with adjustments; then uses the priors that agree."""
    for _ in range(rounds):
        poses = [state.camera_from_world(it.image).inverse() for it in matched_images]
        matches = [it.matches_at(pose) for it, pose in zip(matched_images, poses, strict=True)]
        estimate = adjust_jointly(matched_images, matches, state, options)
        state = estimate.state.relaxed()
    return _with_priors(matched_images, estimate, priors, options) if priors else estimate


def _with_priors(
    matched_images: Sequence[MatchedImage],
    estimate: JointEstimate[S],
    priors: Mapping[int, Priors],
    options: JointOptions,
) -> JointEstimate[S]:
    """Compares priors with the poses from the photographs alone, and adjusts with the consistent ones."""
    checks, used = {}, {}
    for image, its in priors.items():
        pose, columns = estimate.state.camera_from_world(image).inverse(), estimate.state.jacobian(image)
        covariance = covariance_in_world(columns @ estimate.covariance @ columns.T, pose)
        checks[image] = its.check(pose, covariance)
        if consistent := its.consistent(checks[image]):
            used[image] = consistent
    if used:
        matches = [it.matches for it in estimate.matched]
        estimate = adjust_jointly(matched_images, matches, estimate.state, options, used)
    return replace(estimate, prior_checks=checks)


def adjust_jointly(
    matched_images: Sequence[MatchedImage],
    matches: Sequence[PointMatches],
    state: S,
    options: JointOptions,
    priors: Mapping[int, Priors] | None = None,
) -> JointEstimate[S]:
    """Refines the poses of a group, of the photographs that have matches; the initial poses if no match is used.

    Matches with a too large initial error are not used; all priors, by the photographs' index, are.
    """
    problem = GroupProblem(matched_images, matches, state, options, priors)
    steps = MinimizeOptions(options.iterations, options.adjust.min_decrease)
    point = minimize(problem, problem.start, steps) if problem.blocks else problem.start
    points = {block.image: (problem.chosen[i], point.points[i]) for i, block in enumerate(problem.blocks)}
    matched = []
    for source, its_matches in zip(matched_images, matches, strict=True):
        x_in_world = source.structure.x_in_world
        if source.image in points:
            chosen, moved = points[source.image]
            x_in_world = x_in_world.copy()
            x_in_world[chosen] = moved
        matched.append(_matched(source, its_matches, x_in_world, point.state, options.adjust.inlier_px))
    return JointEstimate(point.state, problem.covariance(point), tuple(matched))


def _matched(
    source: MatchedImage, matches: PointMatches, x_in_world: Array, state: GroupState, inlier_px: float
) -> PosedImage:
    pose = state.camera_from_world(source.image).inverse()
    pixels = source.query.features.keypoints[matches.keypoint].astype(np.float64)
    errors_px = reprojection_errors_px(source.query.camera, pose, x_in_world[matches.point], pixels)
    return PosedImage(source, pose, matches, errors_px < inlier_px, errors_px)


def covariance_in_world(covariance: Array, world_from_body: RigidTransform) -> Array:
    """Covariance (6, 6) of `world_from_body`, order x y z rx ry rz about fixed world axes.

    `covariance` is that of a left perturbation (v, w) of body_from_world; see `perturbation.world_covariance`.
    """
    rotate = np.kron(np.eye(2), world_from_body.rotation)
    turned = rotate @ covariance @ rotate.T
    return np.asarray((turned + turned.T) / 2)
