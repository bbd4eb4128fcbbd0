"""The pose from two-view matches and 2D-3D matches, adjusted over both.

A two-view match becomes a point that its reference and the query observe. Eliminating the point from the adjustment
(see `bundle`) leaves its epipolar residual, with the noise of both keypoints and of the reference's pose; so `adjust`
treats both kinds of match alike, and its covariance covers both.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..bundle.adjust import adjust_pose
from ..bundle.estimate import PosedSupport, PoseEstimate, PoseStage, TwoViewSupport
from ..bundle.pose_problem import AdjustInput, AdjustOptions
from ..bundle.priors import IntrinsicsSigma
from ..features.limits import EPIPOLAR_PX
from ..features.tracks import Tracks
from ..features.views import PosedView, View
from ..pairs.correspond import Correspondences
from ..structure.match import MatchOptions, match_points, vote
from ..structure.model import PointMatches, Structure
from ..structure.structure import StructureOptions, triangulated_structure
from .relative import Evidence, RelativePoseOptions, find_pose, score
from .two_view_matches import MIN_TWO_VIEW, TwoViewMatches

ROUNDS = 3
"""Rounds of choosing inliers and adjusting."""


@dataclass(frozen=True)
class TwoViewOptions:
    """Options of the stages that find the points and matches, and of the adjustment."""

    structure: StructureOptions = field(default_factory=StructureOptions)
    match: MatchOptions = field(default_factory=MatchOptions)
    adjust: AdjustOptions = field(default_factory=AdjustOptions)


def solve_two_view(
    query: View,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    origin: Array,
    options: TwoViewOptions,
    intrinsics: IntrinsicsSigma | None = None,
) -> PosedSupport | None:
    """Finds the pose that most matches of both kinds support, with these matches; None if there is none.

    There are two or more references, and matches between all photographs; for `origin` (3,) of their world see
    `Support`. `intrinsics` are standard deviations of those of the query; None for the defaults.
    """
    structure = triangulated_structure(references, correspondences, options.structure)
    matches = vote(structure, [len(it.view.features) for it in references], correspondences)
    two_view = TwoViewMatches.of(query, references, correspondences.query_matches)
    evidence = Evidence(query, references, two_view, structure.x_in_world[matches.point], matches.keypoint)
    pose = find_pose(evidence, RelativePoseOptions())
    if pose is None:
        return None
    searched = match_points(query, references, structure, correspondences, pose, options.match)
    problem = _Problem(evidence, structure, searched, options.adjust, intrinsics)
    best = problem.at(pose)
    for _ in range(ROUNDS):
        adjusted = problem.adjusted(best)
        if adjusted is None or (best.estimate is not None and adjusted.score <= best.score):
            break
        best = adjusted
    if best.estimate is None or best.inlier_count < MIN_TWO_VIEW:
        return None
    return PosedSupport(
        query,
        tuple(references),
        structure,
        searched,
        origin,
        tuple(correspondences.query_matches),
        intrinsics,
        correspondences.reference_error_px,
        estimate=best.estimate,
        two_view=best.support,
    )


@dataclass(frozen=True, eq=False)
class _Solution:
    """A pose with the inliers of both kinds.

    Attributes:
        world_from_query: the pose.
        score: see `pose`.
        errors_px, inliers: (M,) reprojection errors of the 2D-3D matches, and which are inliers.
        support: the two-view matches that are no inliers through a point.
        parallax_deg: (T,) their parallaxes.
        estimate: the estimate after an adjustment; None before.
    """

    world_from_query: RigidTransform
    score: float
    errors_px: Array
    inliers: NDArray[np.bool_]
    support: TwoViewSupport
    parallax_deg: Array
    estimate: PoseEstimate | None = None

    @property
    def inlier_count(self) -> int:
        return int(self.inliers.sum() + self.support.inliers.sum())


@dataclass(frozen=True, eq=False)
class _Problem:
    evidence: Evidence
    structure: Structure
    matches: PointMatches
    adjust: AdjustOptions
    intrinsics: IntrinsicsSigma | None

    def at(self, pose: RigidTransform, estimate: PoseEstimate | None = None) -> _Solution:
        """Finds the inliers of a pose."""
        evidence, matches, query = self.evidence, self.matches, self.evidence.query
        errors_px = matches.seen(query, self.structure.x_in_world).errors_px(pose)
        inliers = errors_px < self.adjust.inlier_px
        # A keypoint with a point gives its equations there.
        rest = evidence.two_view[~np.isin(evidence.two_view.keypoint, matches.keypoint[inliers])]
        points, parallax_deg = rest.triangulated(query, evidence.references, pose, self.structure.noise)
        sampson_px = rest.sampson_px(pose)
        agreeing = (sampson_px < EPIPOLAR_PX) & np.isfinite(points).all(axis=1)
        support = TwoViewSupport(rest.reference, rest.keypoint, rest.reference_keypoint, points, sampson_px, agreeing)
        value = score(evidence, pose)
        return _Solution(pose, value, errors_px, inliers, support, parallax_deg, estimate)

    def adjusted(self, start: _Solution) -> _Solution | None:
        """Adjusts over the inliers of both kinds; None if that fails."""
        # Points with a smaller parallax have no depth.
        used = start.support.inliers & (start.parallax_deg >= StructureOptions.min_parallax_deg)
        support, rows = start.support, np.arange(used.sum(), dtype=np.intp)
        single = Tracks(rows, support.reference[used], support.reference_keypoint[used])
        structure = self.structure.and_last(support.x_in_world[used], single)
        matches = self.matches.and_last(rows + len(self.structure.x_in_world), support.keypoint[used])
        errors_px = np.concatenate([start.errors_px, start.support.errors_px[used]])
        inliers = np.concatenate([start.inliers, np.ones(len(rows), bool)])
        before = PoseEstimate(start.world_from_query, PoseStage.REFINED, inliers, errors_px, np.eye(6))
        query, references = self.evidence.query, self.evidence.references
        estimate = adjust_pose(AdjustInput(query, references, structure, matches, self.adjust, self.intrinsics), before)
        if not estimate.is_adjusted:
            return None
        found = self.at(estimate.world_from_camera)
        kept = replace(estimate, inliers=found.inliers, errors_px=found.errors_px)
        return replace(found, estimate=kept)
