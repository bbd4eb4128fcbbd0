"""The method, on one screen.

Five stages, each knowing the result of the one before: coarse > scale > structure > match > pnp; and a sixth of our
own, adjust. Beneath them all lie the correspondences between the photographs' features.

This module knows nothing of grpc, queues or storage.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np

from mapless.geometry import Array, RigidTransform

from ..stopwatch import timed
from .accuracy import accuracy_from_covariance
from .adjust import AdjustOptions, adjust_pose
from .coarse import Reconstruction, Reconstructor
from .coarse.geometric import GeometricReconstructor
from .correspond import Correspondences, Matcher
from .match import PAPER_MATCH, MatchOptions, PointMatches, match_points
from .pnp import PnpOptions, PoseEstimate, PoseStage, solve_pose
from .rejection import Rejection, RejectionReason
from .scale import MetricScale, ScaleOptions, ScaleStrategy, estimate_scale
from .structure import PAPER_STRUCTURE, Structure, StructureOptions, build_structure
from .views import PosedView, View

if TYPE_CHECKING:  # it needs torch
    from .coarse.device import DeviceReconstruction

MIN_FEATURES = 12
"""A photograph with fewer local features is blank, black or blurred."""


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
        adjust: of the final adjustment.
    """

    variant: Variant = Variant.BEST
    scale_strategy: ScaleStrategy = ScaleStrategy.TWO_STAGE
    weak_inliers: int = 100
    max_radius_ratio: float = 3.0
    pnp: PnpOptions = field(default_factory=PnpOptions)
    adjust: AdjustOptions = field(default_factory=AdjustOptions)

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
        covariance: (6, 6), order x y z rx ry rz, fixed world axes, metres and radians; None for `Variant.COARSE`.
        pose_stage: whether the refined or the initial pose is answered.
        inlier_count: 2D-3D matches that agree with it.
        match_count: 2D-3D matches tried.
        reprojection_error_px: median of the inliers, pixels of the processed image.
    """

    world_from_camera: RigidTransform
    covariance: Array | None
    pose_stage: PoseStage
    inlier_count: int
    match_count: int
    reprojection_error_px: float


@dataclass(frozen=True, eq=False)
class Answer:
    """What the method says of one query.

    Attributes:
        outcome: the pose, or why there is none.
        scale: None if that stage was not reached.
        stage_seconds: time of each stage that ran, in order.
        reference_match_counts: per reference, feature matches with the query.
        reference_inlier_counts: per reference, inliers on points that it observes.
    """

    outcome: Localization | Rejection
    scale: MetricScale | None = None
    stage_seconds: dict[str, float] = field(default_factory=dict)
    reference_match_counts: tuple[int, ...] = ()
    reference_inlier_counts: tuple[int, ...] = ()


@dataclass(frozen=True, eq=False)
class Pipeline:
    """What the method runs on, shared by all queries.

    Attributes:
        reconstructor: the coarse backend.
        matcher: remembers matches between references.
    """

    reconstructor: Reconstructor = field(default_factory=GeometricReconstructor)
    matcher: Matcher = field(default_factory=Matcher)


@dataclass(eq=False)
class _Progress:
    """What is known of an answer while its stages run."""

    reference_count: int
    check: Callable[[], None]
    stage_seconds: dict[str, float] = field(default_factory=dict)
    correspondences: Correspondences | None = None
    reconstruction: Reconstruction | DeviceReconstruction | Rejection | None = None
    scale: MetricScale | None = None
    inlier_counts: tuple[int, ...] = ()

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        self.check()
        with timed(self.stage_seconds, name):
            yield

    def answer(self, outcome: Localization | Rejection) -> Answer:
        none = (0,) * self.reference_count
        matches = tuple(len(m) for m in self.correspondences.query_matches) if self.correspondences else none
        return Answer(outcome, self.scale, self.stage_seconds, matches, self.inlier_counts or none)


def localize(
    query: View,
    references: Sequence[PosedView],
    pipeline: Pipeline,
    options: LocalizeOptions,
    check: Callable[[], None] = lambda: None,
) -> Answer:
    """Localizes a query among posed references.

    Args:
        query: the photograph.
        references: the most similar first.
        pipeline: what to run on.
        options: see there.
        check: called between the steps; raises when nobody wants the answer any more.

    Returns:
        The answer; "no pose" is one, with the first stage that could not do its work.
    """
    if not references:
        return Answer(Rejection(RejectionReason.NO_USABLE_REFERENCES, "no references"))
    if len(query.features) < MIN_FEATURES:
        message = f"the photograph has {len(query.features)} local features, {MIN_FEATURES} are needed"
        return Answer(Rejection(RejectionReason.LOW_TEXTURE, message))

    # World coordinates may be millions of metres (UTM, ECEF), too long for the digits of differences of squares.
    origin = references[0].world_from_camera.translation
    nearby = [replace(r, world_from_camera=r.world_from_camera.shifted(-origin)) for r in references]
    first = _Progress(len(references), check)
    answer = _attempt(query, nearby, pipeline, options, first, wide=False)
    if options.variant is Variant.BEST and _is_weak(answer, options) and len(references) > 1:
        kept = None if pipeline.reconstructor.uses_correspondences else first.reconstruction
        second = _Progress(
            len(references), check, dict(answer.stage_seconds), first.correspondences, reconstruction=kept
        )
        wide = _attempt(query, nearby, pipeline, options, second, wide=True)
        better = wide if _is_better(wide, answer, options) else answer
        answer = replace(better, stage_seconds=wide.stage_seconds)
    return _shifted(answer, origin)


def _shifted(answer: Answer, offset: Array) -> Answer:
    """The answer in a world in which everything lies `offset` (3,) further."""
    outcome, scale = answer.outcome, answer.scale
    if isinstance(outcome, Localization):
        outcome = replace(outcome, world_from_camera=outcome.world_from_camera.shifted(offset))
    if scale:
        world_from_local = replace(scale.world_from_local, translation=scale.world_from_local.translation + offset)
        scale = replace(
            scale, world_from_local=world_from_local, world_from_query=scale.world_from_query.shifted(offset)
        )
    return replace(answer, outcome=outcome, scale=scale)


def _is_weak(answer: Answer, options: LocalizeOptions) -> bool:
    """Whether wide correspondences could make the answer better."""
    if isinstance(answer.outcome, Rejection):
        return answer.outcome.reason is not RejectionReason.DEGENERATE_REFERENCES
    return answer.outcome.inlier_count < options.weak_inliers


def _is_better(wide: Answer, strict: Answer, options: LocalizeOptions) -> bool:
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


def _attempt(
    query: View,
    references: Sequence[PosedView],
    pipeline: Pipeline,
    options: LocalizeOptions,
    progress: _Progress,
    wide: bool,
) -> Answer:
    return progress.answer(_stages(query, references, pipeline, options, progress, wide))


def _stages(
    query: View,
    references: Sequence[PosedView],
    pipeline: Pipeline,
    options: LocalizeOptions,
    progress: _Progress,
    wide: bool,
) -> Localization | Rejection:
    with progress.stage("correspond"):
        # The second attempt looks more widely among the references alone.
        query_matches = progress.correspondences.query_matches if progress.correspondences else None
        correspondences = pipeline.matcher.correspond(query, references, wide, progress.check, query_matches)
        progress.correspondences = correspondences
    with progress.stage("coarse"):
        reconstruction = progress.reconstruction or pipeline.reconstructor.reconstruct(
            query, references, correspondences
        )
        progress.reconstruction = reconstruction
    if isinstance(reconstruction, Rejection):
        return reconstruction
    match_options = options.match(pipeline.matcher.options.guided_similarity)
    refined = _refine(reconstruction, query, references, correspondences, options, match_options, progress)
    if isinstance(refined, Rejection):
        return refined
    scale, structure, matches = refined
    progress.scale, initial = scale, scale.world_from_query
    if structure is None or matches is None:
        return Localization(initial, None, PoseStage.INITIAL, 0, 0, 0.0)
    with progress.stage("pnp"):
        estimate = solve_pose(query, structure, matches, initial, options.pnp)
    if isinstance(estimate, Rejection):
        return estimate
    if options.variant is Variant.BEST:
        with progress.stage("adjust"):
            estimate = adjust_pose(query, references, structure, matches, estimate, options.adjust)
    progress.inlier_counts = _inliers_by_reference(structure, matches, estimate, len(references))
    return Localization(
        estimate.world_from_camera,
        estimate.covariance,
        estimate.stage,
        int(estimate.inliers.sum()),
        len(matches),
        float(np.median(estimate.errors_px[estimate.inliers])),
    )


def _refine(
    reconstruction: Reconstruction | DeviceReconstruction,
    query: View,
    references: Sequence[PosedView],
    correspondences: Correspondences,
    options: LocalizeOptions,
    match_options: MatchOptions,
    progress: _Progress,
) -> tuple[MetricScale, Structure | None, PointMatches | None] | Rejection:
    """Scale, structure and matches, computed where the reconstruction lies; of `Variant.COARSE` the scale alone."""
    scale_options = ScaleOptions(options.scale_strategy)
    only_scale = options.variant is Variant.COARSE
    if not isinstance(reconstruction, Reconstruction):
        from .on_device import refine_on_device

        with progress.stage("refine"):
            further = (None, None) if only_scale else (options.structure, match_options)
            refined = refine_on_device(reconstruction, query, references, correspondences, scale_options, *further)
        return refined if isinstance(refined, Rejection) else (refined.scale, refined.structure, refined.matches)
    with progress.stage("scale"):
        scale = estimate_scale(reconstruction, references, correspondences, scale_options)
    if isinstance(scale, Rejection) or only_scale:
        return scale if isinstance(scale, Rejection) else (scale, None, None)
    with progress.stage("structure"):
        structure = build_structure(reconstruction, scale, references, correspondences, options.structure)
    with progress.stage("match"):
        initial = scale.world_from_query
        matches = match_points(query, references, structure, correspondences, initial, match_options)
    return scale, structure, matches


def _inliers_by_reference(
    structure: Structure, matches: PointMatches, estimate: PoseEstimate, reference_count: int
) -> tuple[int, ...]:
    agreeing = np.zeros(len(structure.x_in_world), bool)
    agreeing[matches.point[estimate.inliers]] = True
    seen = structure.tracks.view[agreeing[structure.tracks.point]]
    return tuple(np.bincount(seen, minlength=reference_count).tolist())
