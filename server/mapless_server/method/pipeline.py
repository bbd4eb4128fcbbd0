"""A query between the parts of the method, and the part that computes batches: coarse and scale.

A network reconstructs several queries together, so the stages up to the metric scale are computed here for a batch.
"""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from mapless.geometry import Array

from .bundle.estimate import NO_DEPTH, DepthCheck, PosedSupport, PoseStage, Support
from .bundle.pose_problem import AdjustOptions
from .bundle.priors import NO_PRIORS, Priors
from .coarse import Outcome, Reconstructor, Request, Triangulation, reconstruct_one
from .coarse.geometric import GeometricReconstructor, point_maps
from .coarse.scale import depth_scale, estimate_scale, known_scale, network_scale
from .features.views import KeypointDepths, Matches, PosedView, Reconstruction, View
from .judge.answer import Answer, Localization, shifted
from .judge.judge import JudgeOptions
from .options import LocalizeOptions, StageContext, Variant
from .pairs.correspond import Correspondences, Matcher
from .pairs.pair import Matching
from .pose.pnp import PnpOptions
from .rejection import Rejection, RejectionReason
from .structure.kept_depth import with_kept_depths
from .structure.match import PAPER_MATCH, MatchOptions, match_points, vote
from .structure.model import MetricScale, PointMatches, Structure
from .structure.structure import PAPER_STRUCTURE, StructureOptions, build_structure, triangulated_structure

T = TypeVar("T")


MIN_FEATURES = 12
"""A photograph with fewer local features is blank, black or blurred."""


@dataclass(frozen=True)
class StageOptions:
    """Options of the stages after the coarse one, the same for all queries; the defaults are the best measured.

    Attributes:
        pnp: options of the pose solver.
        adjust: options of the final adjustment.
        judge: options of the judge.
    """

    pnp: PnpOptions = field(default_factory=PnpOptions)
    adjust: AdjustOptions = field(default_factory=AdjustOptions)
    judge: JudgeOptions = field(default_factory=JudgeOptions)

    @staticmethod
    def structure(variant: Variant) -> StructureOptions:
        """Options of the structure stage."""
        if variant is Variant.BEST:
            return StructureOptions()
        return replace(PAPER_STRUCTURE, optimize=variant is Variant.FULL)

    @staticmethod
    def match(variant: Variant, guided_similarity: float) -> MatchOptions:
        """Options of the matching stage; the least similarity depends on the features."""
        return MatchOptions(min_similarity=guided_similarity) if variant is Variant.BEST else PAPER_MATCH


@dataclass(frozen=True, eq=False)
class Pipeline:
    """Backend, matcher and options, shared by all queries.

    Attributes:
        reconstructor: the coarse backend.
        matcher: matches views, and caches matches between references.
        options: options of the stages.
    """

    reconstructor: Reconstructor = field(default_factory=GeometricReconstructor)
    matcher: Matcher = field(default_factory=Matcher)
    options: StageOptions = field(default_factory=StageOptions)

    def with_trust(self, quantiles: tuple[float, ...]) -> "Pipeline":
        """The pipeline of a scene whose right answers have these quantiles of trust; empty for the usual ones."""
        if not quantiles:
            return self
        options = replace(self.options, judge=self.options.judge.with_trust(quantiles))
        return replace(self, options=options)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A query whose features are matched; the input of the coarse stage.

    Attributes:
        query: the photograph.
        references: the most similar first, in a world whose origin is the first one's camera centre. World coordinates
            may be millions of metres (UTM, ECEF), too large for differences of squares in double precision.
        references_in_world: the same references in the caller's world, in which their pairs are matched: many queries
            use these matches, so they must not depend on a query's origin, not even in the last digit.
        origin: (3,) origin of this world in the caller's world, metres.
        pipeline: backend, matcher and options.
        options: options of the request.
        correspondences: matches between all photographs.
        bucket: prepared queries of the same bucket may be reconstructed together.
        context: cancels the computation and times its stages.
        priors: priors on the query's pose, in the world of `references`.
        is_metric: whether the unit of the references' poses is the metre.
        implausible_depths: the query's depths, if they cannot be metres and are not used; else None.
    """

    query: View
    references: tuple[PosedView, ...]
    references_in_world: tuple[PosedView, ...]
    origin: Array
    pipeline: Pipeline
    options: LocalizeOptions
    correspondences: Correspondences
    bucket: str
    context: StageContext
    priors: Priors = NO_PRIORS
    is_metric: bool = True
    implausible_depths: KeypointDepths | None = None

    @property
    def unit(self) -> str:
        """The unit of length of the references' poses, in messages for a person."""
        return "m" if self.is_metric else "units"

    @property
    def has_depth(self) -> bool:
        """Whether the query, or a reference, has depth."""
        return self.query.depths is not None or any(it.depths is not None for it in self.references)

    @property
    def structure_options(self) -> StructureOptions:
        """Options of the structure stage for this variant."""
        return self.pipeline.options.structure(self.options.variant)

    @property
    def match_options(self) -> MatchOptions:
        """Options of the matching stage for this variant and these features."""
        similarity = self.pipeline.matcher.options.guided_similarity
        return self.pipeline.options.match(self.options.variant, similarity)


@dataclass(frozen=True, eq=False)
class Coarse:
    """A query reconstructed together with its references.

    Attributes:
        prepared: the query.
        reconstruction: up to scale, or a rejection.
        scale: the metric scale with the initial pose, in the world of `prepared`; or a rejection.
    """

    prepared: Prepared
    reconstruction: Outcome
    scale: MetricScale | Rejection

    @property
    def rejected_alone(self) -> Rejection | None:
        """Why the photograph gives no initial pose without its priors; None if it does, or if that is not known."""
        return self.reconstruction.without_priors if isinstance(self.reconstruction, Triangulation) else None

    def answer(self, outcome: Localization | Rejection, support: Support | None = None) -> Answer:
        """Makes the answer in the caller's world from an outcome in the world of `prepared`."""
        prepared, scale = self.prepared, None if isinstance(self.scale, Rejection) else self.scale
        matches = tuple(len(m) for m in prepared.correspondences.query_matches)
        inliers = support.inliers_by_reference() if support else (0,) * len(prepared.references)
        seconds = dict(prepared.context.stage_seconds)
        stationary_count = prepared.correspondences.stationary_count
        check = _depth_check(prepared, support)
        made = Answer(outcome, scale, seconds, matches, inliers, support, stationary_count, check)
        return shifted(made, prepared.origin)


def _depth_check(prepared: Prepared, support: Support | None) -> DepthCheck:
    """How the query's depth compares with the pose of a support, if it has one; without counts without depth."""
    refused = prepared.implausible_depths
    depths = prepared.query.depths if refused is None else refused
    if depths is None:
        return NO_DEPTH
    check = support.estimate.depth_check if isinstance(support, PosedSupport) else None
    check = check or DepthCheck(int(np.isfinite(depths.depth).sum()), conflict=refused is not None)
    return replace(check, median=0.0 if np.isnan(depths.median) else depths.median)


def prepare(
    query: View,
    references: Sequence[PosedView],
    pipeline: Pipeline,
    options: LocalizeOptions,
    context: StageContext,
    query_matches: Sequence[Matches] | None = None,
    priors: Priors = NO_PRIORS,
    is_metric: bool = True,
) -> Prepared | Rejection:
    """Matches the query with its references, and these with one another; a rejection if that is impossible.

    `query_matches` with each reference, if given, are used unchanged: the references were chosen by them.
    `is_metric` is whether the unit of the references' poses is the metre. Raises ValueError if a view lacks input of
    the coarse backend.
    """
    if not references:
        return Rejection(RejectionReason.NO_USABLE_REFERENCES, "no references")
    if len(query.features) < MIN_FEATURES:
        message = f"the photograph has {len(query.features)} local features, {MIN_FEATURES} are needed"
        return Rejection(RejectionReason.LOW_TEXTURE, message)
    origin = references[0].world_from_camera.translation
    nearby = tuple(replace(r, world_from_camera=r.world_from_camera.shifted(-origin)) for r in references)
    bucket = pipeline.reconstructor.bucket(query, nearby)
    implausible = None
    if query.photograph is not None and query.photograph.read_depth is not None:
        with context.stage("depth"):
            query = query.with_depths()
            depths = query.depths
            if is_metric and depths is not None and not depths.is_plausible:
                query, implausible = replace(query, depths=None), depths
    with context.stage("correspond"):
        correspondences = pipeline.matcher.correspond(
            query, references, check=context.check, query_matches=query_matches
        )
    return Prepared(
        query=query,
        references=nearby,
        references_in_world=tuple(references),
        origin=origin,
        pipeline=pipeline,
        options=options,
        correspondences=correspondences,
        bucket=bucket,
        context=context,
        priors=priors.shifted(-origin),
        is_metric=is_metric,
        implausible_depths=implausible,
    )


def reconstruct(batch: Sequence[Prepared]) -> list[Coarse | Exception]:
    """Computes the coarse stage of a batch of queries of one reconstructor, then the metric scale of each.

    Those of one bucket are reconstructed together.

    Returns for each query, in order, its reconstruction and scale, or its own exception, unchanged: raised by its
    check, or while it alone was computed, such as a torch.OutOfMemoryError for a batch of one. ValueError for several
    reconstructors; any other exception is of the batch as a whole, and splitting it shows which query caused it.
    """
    if len({id(prepared.pipeline.reconstructor) for prepared in batch}) > 1:
        raise ValueError("batch must have queries of one reconstructor only")
    stopped = [_tried(it.context.check) for it in batch]
    wanted = [it for it, error in zip(batch, stopped, strict=True) if error is None]
    start_s = time.perf_counter()
    requests = [Request(it.query, it.references, it.correspondences, it.priors, it.is_metric) for it in wanted]
    made = iter(batch[0].pipeline.reconstructor.reconstruct_many(requests) if requests else [])
    outcomes = [next(made) if error is None else error for error in stopped]
    spent_s = time.perf_counter() - start_s
    for prepared in batch:
        prepared.context.add("coarse", spent_s)
    return [
        outcome if isinstance(outcome, Exception) else _tried(partial(_scaled, prepared, outcome))
        for prepared, outcome in zip(batch, outcomes, strict=True)
    ]


def coarse_answer(coarse: Coarse) -> Answer | None:
    """The answer if there is no time to refine: the pose of `Variant.COARSE`; None if there is no pose yet."""
    if isinstance(coarse.scale, Rejection):
        return None
    return coarse.answer(unverified(coarse.scale, PoseStage.COARSE))


def wide_correspondences(prepared: Prepared) -> Correspondences:
    """The query's matches, and wide ones among its references."""
    matcher, known = prepared.pipeline.matcher, prepared.correspondences.query_matches
    check = prepared.context.check
    return matcher.correspond(prepared.query, prepared.references_in_world, Matching.WIDE, check, known)


def with_wide_correspondences(coarse: Coarse) -> Coarse:
    """The query with wide correspondences among the references, reconstructed again if the backend uses them."""
    prepared, reconstruction = coarse.prepared, coarse.reconstruction
    query, references, pipeline, context = prepared.query, prepared.references, prepared.pipeline, prepared.context
    with context.stage("correspond"):
        correspondences = wide_correspondences(prepared)
        # What was left out is not among the known matches any more.
        correspondences = replace(correspondences, stationary_count=prepared.correspondences.stationary_count)
    with context.stage("coarse"):
        if pipeline.reconstructor.uses_correspondences:
            reconstruction = reconstruct_one(
                pipeline.reconstructor, query, references, correspondences, prepared.priors
            )
    return _scaled(replace(prepared, correspondences=correspondences), reconstruction)


def _tried(work: Callable[[], T]) -> T | Exception:
    """The result of `work`, or what it raises: an error of one query does not fail the others."""
    try:
        return work()
    except Exception as error:
        return error


def _scaled(prepared: Prepared, reconstruction: Outcome) -> Coarse:
    """The metric scale of a reconstruction."""
    if isinstance(reconstruction, Rejection):
        return Coarse(prepared, reconstruction, reconstruction)
    references, strategy = prepared.references, prepared.options.scale_strategy
    with prepared.context.stage("scale"):
        if isinstance(reconstruction, Triangulation):
            if prepared.options.variant in (Variant.BEST, Variant.COARSE):
                structure, pose = reconstruction.structure, reconstruction.world_from_query
                if len(references) == 1:
                    return Coarse(prepared, reconstruction, depth_scale(references[0], pose))
                return Coarse(prepared, reconstruction, known_scale(structure, pose, references, strategy))
            reconstruction = point_maps(reconstruction, prepared.query, references)
        if len(references) == 1 and reconstruction.metre_sigma is not None:
            return Coarse(prepared, reconstruction, network_scale(reconstruction, references[0]))
        scale = estimate_scale(reconstruction, references, prepared.correspondences, strategy)
        return Coarse(prepared, reconstruction, scale)


def unverified(scale: MetricScale, stage: PoseStage = PoseStage.INITIAL) -> Localization:
    """The localization with the initial pose, which nothing has checked."""
    return Localization(scale.world_from_query, None, stage, 0, 0, 0.0, scale_source=scale.source)


def structure_and_matches(coarse: Coarse, scale: MetricScale) -> tuple[Structure, PointMatches]:
    """The structure, which the coarse stage may have triangulated, and the query's matches with it."""
    prepared, reconstruction = coarse.prepared, coarse.reconstruction
    references, correspondences = prepared.references, prepared.correspondences
    with prepared.context.stage("structure"):
        if isinstance(reconstruction, Triangulation):
            structure = reconstruction.structure
        else:
            assert isinstance(reconstruction, Reconstruction)
            structure = build_structure(reconstruction, scale, references, correspondences, prepared.structure_options)
            if prepared.options.variant is Variant.BEST and any(it.depths is not None for it in references):
                structure = with_kept_depths(structure, references, correspondences)
    return structure, matches_of(coarse, scale, structure)


def matches_of(coarse: Coarse, scale: MetricScale, structure: Structure) -> PointMatches:
    """The query's matches with a structure."""
    prepared, correspondences = coarse.prepared, coarse.prepared.correspondences
    with prepared.context.stage("match"):
        initial, options = scale.world_from_query, prepared.match_options
        prior_pose = prepared.priors.pose.world_from_camera if prepared.priors.pose else None
        given = prepared.query, prepared.references, structure, correspondences
        return match_points(*given, initial, options, prior_pose)


def tracked_support(prepared: Prepared) -> Support | None:
    """Support of a photograph that could not be posed alone, from wide correspondences; None without matches.

    Without a reconstruction, the references' tracks and poses are enough to triangulate points, and the photograph's
    matches with the references lead to them through the tracks.
    """
    query, references = prepared.query, prepared.references
    if len(references) < 2:
        return None
    correspondences = wide_correspondences(prepared)
    prepared.context.check()
    structure = triangulated_structure(references, correspondences, StructureOptions())
    matches = vote(structure, [len(r.view.features) for r in references], correspondences)
    query_matches = tuple(correspondences.query_matches)
    sigma = prepared.options.intrinsics
    error_px = correspondences.reference_error_px
    support = Support(query, references, structure, matches, prepared.origin, query_matches, sigma, error_px)
    return support if len(matches) else None
