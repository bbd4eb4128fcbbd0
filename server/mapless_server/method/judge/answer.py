"""The answer of the method to one query."""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from mapless.geometry import Array, RigidTransform

from ..bundle.estimate import NO_DEPTH, DepthCheck, PoseEstimate, PoseStage, Support, TwoViewSupport
from ..bundle.priors import PriorCheck
from ..rejection import IntrinsicsCheck, Rejection
from ..structure.model import MetricScale, ScaleSource


@dataclass(frozen=True, eq=False)
class Localization:
    """The pose of a query.

    Attributes:
        world_from_camera: metric.
        covariance: (6, 6), order x y z rx ry rz, fixed world axes, metres and radians; None for a pose without
            refinement.
        pose_stage: the stage that gave the pose.
        inlier_count: number of 2D-3D matches that are inliers; of two-view matches too, if the pose rests on them.
        match_count: number of all these matches.
        reprojection_error_px: median of the inliers' errors, pixels of the processed image.
        prior_checks: comparison of the pose with each prior.
        trust: 0 to 1, share of right answers whose score is at most as high (see `judge`); None for a pose without
            refinement.
        scale_source: the basis of its lengths.
        intrinsics_checks: evidence of the matches about each parameter of the intrinsics; empty for a pose without an
            adjustment.
    """

    world_from_camera: RigidTransform
    covariance: Array | None
    pose_stage: PoseStage
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    prior_checks: tuple[PriorCheck, ...] = ()
    trust: float | None = None
    scale_source: ScaleSource = ScaleSource.REFERENCES
    intrinsics_checks: tuple[IntrinsicsCheck, ...] = ()

    @classmethod
    def of(
        cls,
        estimate: PoseEstimate,
        trust: float,
        two_view: TwoViewSupport | None = None,
        intrinsics_checks: tuple[IntrinsicsCheck, ...] = (),
    ) -> "Localization":
        """Makes the localization of an accepted estimate, with the two-view matches that it rests on, if any."""
        errors_px, inliers = estimate.errors_px, estimate.inliers
        if two_view is not None:
            errors_px = np.concatenate([errors_px, two_view.errors_px])
            inliers = np.concatenate([inliers, two_view.inliers])
        return cls(
            estimate.world_from_camera,
            estimate.covariance,
            estimate.stage,
            int(inliers.sum()),
            len(inliers),
            float(np.median(errors_px[inliers])),
            estimate.prior_checks,
            trust,
            intrinsics_checks=intrinsics_checks,
        )


@dataclass(frozen=True, eq=False)
class Answer:
    """The answer to one query.

    Attributes:
        outcome: the pose, or the reason for a rejection.
        scale: the metric scale; None if that stage was not reached.
        stage_seconds: time of each stage that ran, in order.
        reference_match_counts: per reference, feature matches with the query.
        reference_inlier_counts: per reference, inliers on points that it observes.
        support: structure, matches and estimate; None if those stages were not reached.
        stationary_count: keypoints of the query whose matches were left out, because they are fixed to the camera.
        depth_check: how the photograph's depth compares with the pose; without counts where there is none.
    """

    outcome: Localization | Rejection
    scale: MetricScale | None = None
    stage_seconds: dict[str, float] = field(default_factory=dict)
    reference_match_counts: tuple[int, ...] = ()
    reference_inlier_counts: tuple[int, ...] = ()
    support: Support | None = None
    stationary_count: int = 0
    depth_check: DepthCheck = NO_DEPTH

    @property
    def is_finite(self) -> bool:
        """Whether its pose, covariance, error and scale are numbers."""
        numbers = [] if self.scale is None else [self.scale.metres_per_unit, self.scale.deviation]
        if isinstance(self.outcome, Localization):
            outcome = self.outcome
            covariance = [] if outcome.covariance is None else outcome.covariance.ravel().tolist()
            numbers += [*outcome.world_from_camera.matrix().ravel(), *covariance, outcome.reprojection_error_px]
        return all(map(math.isfinite, numbers))


def shifted(answer: Answer, offset: Array) -> Answer:
    """Returns the answer in a world whose coordinates are larger by `offset` (3,)."""
    outcome, scale = answer.outcome, answer.scale
    if isinstance(outcome, Localization):
        outcome = replace(outcome, world_from_camera=outcome.world_from_camera.shifted(offset))
    else:
        moved = [replace(it, world_from_camera=it.world_from_camera.shifted(offset)) for it in outcome.hypotheses]
        imprecise = outcome.imprecise
        if imprecise is not None:
            imprecise = replace(imprecise, world_from_camera=imprecise.world_from_camera.shifted(offset))
        outcome = replace(outcome, hypotheses=tuple(moved), imprecise=imprecise)
    if scale:
        world_from_local = replace(scale.world_from_local, translation=scale.world_from_local.translation + offset)
        scale = replace(
            scale, world_from_local=world_from_local, world_from_query=scale.world_from_query.shifted(offset)
        )
    return replace(answer, outcome=outcome, scale=scale)
