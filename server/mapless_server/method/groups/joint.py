"""Joint adjustment of a group: poses of its photographs, their points, and the references.

What `adjust` minimizes for one photograph, summed over those of a group,

    min  sum_f sum_obs rho(|r_o|^2 / sigma_o^2) + xi^T C^-1 xi + (cost of the group's parameters),

where the references xi are common to the photographs that use them, and C is that of `pose_problem`, relative to the
place of the last photograph. Each photograph has its own points, which are eliminated; the rest is a dense system of
the references and the group's parameters, whose cost is zero for a rig and that of the tracked steps for a sequence
(see `drift`). Soft priors that agree with the photographs add their terms.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Generic

from mapless.geometry import Array

from ..bundle.priors import PriorCheck, Priors
from ..optim.optimize import MinimizeOptions, covariance_in_world, minimize
from ..structure.model import PointMatches
from .images import MatchedImage, PosedImage
from .problem import ADJUST, GroupProblem, GroupState, S

STEPS = MinimizeOptions(15, ADJUST.min_decrease)
"""Steps of an adjustment; drift needs more than one photograph's pose."""


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
    matched_images: Sequence[MatchedImage], state: S, priors: Mapping[int, Priors] | None = None
) -> JointEstimate[S]:
    """Alternates guided searches from the current poses with adjustments; then uses the priors that agree."""
    for _ in range(2):  # the second search starts from better poses
        poses = [state.camera_from_world(it.image).inverse() for it in matched_images]
        matches = [it.matches_at(pose) for it, pose in zip(matched_images, poses, strict=True)]
        estimate = adjust_jointly(matched_images, matches, state)
        state = estimate.state.relaxed()
    return _with_priors(matched_images, estimate, priors) if priors else estimate


def _with_priors(
    matched_images: Sequence[MatchedImage], estimate: JointEstimate[S], priors: Mapping[int, Priors]
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
        estimate = adjust_jointly(matched_images, matches, estimate.state, used)
    return replace(estimate, prior_checks=checks)


def adjust_jointly(
    matched_images: Sequence[MatchedImage],
    matches: Sequence[PointMatches],
    state: S,
    priors: Mapping[int, Priors] | None = None,
) -> JointEstimate[S]:
    """Refines the poses of a group, of the photographs that have matches; the initial poses if no match is used.

    Matches with a too large initial error are not used; all priors, by the photographs' index, are.
    """
    problem = GroupProblem(matched_images, matches, state, priors)
    point = minimize(problem, problem.start, STEPS) if problem.blocks else problem.start
    points = {
        block.source.image: (block.chosen, moved) for block, moved in zip(problem.blocks, point.points, strict=True)
    }
    matched = []
    for source, its_matches in zip(matched_images, matches, strict=True):
        x_in_world = source.structure.x_in_world
        if source.image in points:
            chosen, moved = points[source.image]
            x_in_world = x_in_world.copy()
            x_in_world[chosen] = moved
        matched.append(_matched(source, its_matches, x_in_world, point.state))
    return JointEstimate(point.state, problem.covariance(point), tuple(matched))


def _matched(source: MatchedImage, matches: PointMatches, x_in_world: Array, state: GroupState) -> PosedImage:
    pose = state.camera_from_world(source.image).inverse()
    errors_px = matches.seen(source.query, x_in_world).errors_px(pose)
    return PosedImage(source, pose, matches, errors_px < ADJUST.inlier_px, errors_px)
