"""What is asked of the method, and what it says."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

import numpy as np

from mapless.geometry import Array, RigidTransform

from .adjust import AdjustOptions
from .match import PAPER_MATCH, MatchOptions
from .options import check_bounds
from .pnp import PnpOptions, PoseEstimate, PoseStage
from .priors.known import PriorCheck
from .rejection import Rejection
from .scale import MetricScale
from .scale_equations import ScaleStrategy
from .structure import PAPER_STRUCTURE, StructureOptions
from .support import Support
from .trust.gate import GateOptions
from .trust.judge import JudgeOptions
from .uncertainty.accuracy import accuracy_from_covariance


class Variant(str, Enum):
    """Forms of the method; all but `BEST` are the paper's."""

    COARSE = "coarse"
    """The reconstruction's own pose at metric scale."""
    NO_STRUCTURE = "no_structure"
    """PnP on predicted points."""
    FULL = "full"
    """The paper's method."""
    BEST = "best"
    """Tracks over all references, keypoints weighted by their noise, a final adjustment of everything."""


@dataclass(frozen=True)
class LocalizeOptions:
    """Options of the method; the defaults are the best we know.

    Attributes:
        variant: decides the options of structure and matching.
        scale_strategy: how the metric scale is found.
        weak_inliers: an answer of `Variant.BEST` with fewer inliers is computed again from wide correspondences (see
            `correspond`), and replaced if that finds more. Above a hundred they do not help any more.
        max_radius_ratio: but not if the wide answer claims a radius this many times as large. On photographs where it
            was the better one it claimed at most 1.7 times as much; where repeated floor tiles had given it inliers,
            and centimetres of error, 40 to 80 times.
        pnp: of the pose solver.
        gate: what is no pose at all.
        adjust: of the final adjustment.
        judge: of what is accepted.
        coverage: share of right answers to accept; more, and more wrong ones are accepted too (see `judge`).
    """

    variant: Variant = Variant.BEST
    scale_strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE
    weak_inliers: int = 100
    max_radius_ratio: float = 3.0
    pnp: PnpOptions = field(default_factory=PnpOptions)
    gate: GateOptions = field(default_factory=GateOptions)
    adjust: AdjustOptions = field(default_factory=AdjustOptions)
    judge: JudgeOptions = field(default_factory=JudgeOptions)
    coverage: float = 0.99

    def __post_init__(self) -> None:
        check_bounds(self, "coverage", above=0, at_most=1)

    @property
    def structure(self) -> StructureOptions:
        """Options of the structure stage."""
        if self.variant is Variant.BEST:
            return StructureOptions()
        return replace(PAPER_STRUCTURE, optimize=self.variant is Variant.FULL)

    def match(self, guided_similarity: float) -> MatchOptions:
        """Options of the matching stage; what similarity is enough depends on the features."""
        return MatchOptions(min_similarity=guided_similarity) if self.variant is Variant.BEST else PAPER_MATCH


@dataclass(frozen=True, eq=False)
class Localization:
    """Where the query was taken.

    Attributes:
        world_from_camera: metric.
        covariance: (6, 6), order x y z rx ry rz, fixed world axes, metres and radians; None for a pose that was never
            to be refined (`Variant.COARSE`) or could not be in time (`PoseStage.COARSE`).
        pose_stage: whether the refined or the initial pose is answered.
        inlier_count: 2D-3D matches that agree with it.
        match_count: 2D-3D matches tried.
        reprojection_error_px: median of the inliers, pixels of the processed image.
        prior_checks: how the pose compares with each prior.
        trust: 0 to 1, share of right answers that look at most as good (see `judge`); None for a pose that nothing has
            checked, like its covariance.
    """

    world_from_camera: RigidTransform
    covariance: Array | None
    pose_stage: PoseStage
    inlier_count: int
    match_count: int
    reprojection_error_px: float
    prior_checks: tuple[PriorCheck, ...] = ()
    trust: float | None = None

    @classmethod
    def of(cls, estimate: PoseEstimate, match_count: int, trust: float) -> Localization:
        """The answer that an accepted estimate is."""
        return cls(
            estimate.world_from_camera,
            estimate.covariance,
            estimate.stage,
            int(estimate.inliers.sum()),
            match_count,
            float(np.median(estimate.errors_px[estimate.inliers])),
            estimate.prior_checks,
            trust,
        )


@dataclass(frozen=True, eq=False)
class Answer:
    """What the method says of one query.

    Attributes:
        outcome: the pose, or why there is none.
        scale: None if that stage was not reached.
        stage_seconds: time of each stage that ran, in order.
        reference_match_counts: per reference, feature matches with the query.
        reference_inlier_counts: per reference, inliers on points that it observes.
        support: what the pose rests on, or would have; None where it did not come so far.
    """

    outcome: Localization | Rejection
    scale: MetricScale | None = None
    stage_seconds: dict[str, float] = field(default_factory=dict)
    reference_match_counts: tuple[int, ...] = ()
    reference_inlier_counts: tuple[int, ...] = ()
    support: Support | None = None


def shifted(answer: Answer, offset: Array) -> Answer:
    """The answer in a world in which everything lies `offset` (3,) further."""
    outcome, scale = answer.outcome, answer.scale
    if isinstance(outcome, Localization):
        outcome = replace(outcome, world_from_camera=outcome.world_from_camera.shifted(offset))
    elif outcome.hypotheses:
        moved = [replace(it, world_from_camera=it.world_from_camera.shifted(offset)) for it in outcome.hypotheses]
        outcome = replace(outcome, hypotheses=tuple(moved))
    if scale:
        world_from_local = replace(scale.world_from_local, translation=scale.world_from_local.translation + offset)
        scale = replace(
            scale, world_from_local=world_from_local, world_from_query=scale.world_from_query.shifted(offset)
        )
    return replace(answer, outcome=outcome, scale=scale)


def is_better(wide: Answer, strict: Answer, options: LocalizeOptions) -> bool:
    """Whether the answer from wide correspondences is to be given."""
    if isinstance(wide.outcome, Rejection) or isinstance(strict.outcome, Rejection):
        return isinstance(wide.outcome, Localization)
    if wide.outcome.inlier_count <= strict.outcome.inlier_count:
        return False
    return _claimed_radius_m(wide) <= options.max_radius_ratio * _claimed_radius_m(strict)


def _claimed_radius_m(answer: Answer) -> float:
    """Within which the position lies in 68 % of cases, by its covariance; infinite where there is none."""
    if isinstance(answer.outcome, Rejection) or answer.outcome.covariance is None:
        return math.inf
    return accuracy_from_covariance(answer.outcome.covariance).position_68_m
