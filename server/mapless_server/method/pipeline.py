"""A query between the parts of the method, and the part that works on many queries at a time: coarse and scale.

A network reconstructs several queries in one go, so what `localize` does for one query up to its metric scale is done
here for a batch, on the device where the network's output lies on one.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

from mapless.geometry import Array

from .adjust import AdjustOptions
from .answer import Answer, Localization, shifted
from .coarse import Bucket, Outcome, Reconstructor, Request, reconstruct_one
from .coarse.geometric import GeometricReconstructor
from .context import StageContext
from .correspond import Correspondences, Matcher
from .match import PAPER_MATCH, MatchOptions
from .options import LocalizeOptions, Variant
from .pnp import PnpOptions
from .priors.known import NO_PRIORS, Priors
from .reconstruction import Reconstruction
from .rejection import Rejection, RejectionReason
from .results import MetricScale, PointMatches, PoseStage, Structure, Support
from .scale import estimate_scale
from .scale_equations import ScaleOptions
from .structure import PAPER_STRUCTURE, StructureOptions
from .trust.gate import GateOptions
from .trust.judge import JudgeOptions
from .views import PosedView, View

T = TypeVar("T")


@dataclass(frozen=True)
class StageOptions:
    """Options of the stages after the coarse one, the same for all queries; the defaults are the best we know.

    Attributes:
        weak_inliers: an answer of `Variant.BEST` with fewer inliers is computed again from wide correspondences (see
            `correspond`), and replaced if that finds more. Above a hundred they do not help any more.
        max_radius_ratio: but not if the wide answer claims a radius this many times as large. On photographs where it
            was the better one it claimed at most 1.7 times as much; where repeated floor tiles had given it inliers,
            and centimetres of error, 40 to 80 times.
        pnp: of the pose solver.
        gate: what is no pose at all.
        adjust: of the final adjustment.
        judge: of what is accepted.
    """

    weak_inliers: int = 100
    max_radius_ratio: float = 3.0
    pnp: PnpOptions = field(default_factory=PnpOptions)
    gate: GateOptions = field(default_factory=GateOptions)
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
        """Options of the matching stage; what similarity is enough depends on the features."""
        return MatchOptions(min_similarity=guided_similarity) if variant is Variant.BEST else PAPER_MATCH


@dataclass(frozen=True, eq=False)
class Pipeline:
    """What the method runs on, shared by all queries.

    Attributes:
        reconstructor: the coarse backend.
        matcher: keeps matches between references.
        options: of the stages.
    """

    reconstructor: Reconstructor = field(default_factory=GeometricReconstructor)
    matcher: Matcher = field(default_factory=Matcher)
    options: StageOptions = field(default_factory=StageOptions)


@dataclass(frozen=True, eq=False)
class Prepared:
    """A query whose features are matched: all that is known of it before the coarse stage.

    Attributes:
        query: the photograph.
        references: the most similar first, in a world whose origin is the first one's camera centre. World coordinates
            may be millions of metres (UTM, ECEF), too long for the digits of differences of squares.
        origin: (3,) where that is in the caller's world, metres.
        pipeline: what to run on.
        options: of the request.
        correspondences: between all photographs.
        bucket: prepared queries of the same bucket may be reconstructed together.
        context: cancels the computation and times its stages.
        priors: on the query's pose, in the same world.
    """

    query: View
    references: tuple[PosedView, ...]
    origin: Array
    pipeline: Pipeline
    options: LocalizeOptions
    correspondences: Correspondences
    bucket: Bucket
    context: StageContext
    priors: Priors = NO_PRIORS

    @property
    def structure_options(self) -> StructureOptions:
        """Options of the structure stage for this variant."""
        return self.pipeline.options.structure(self.options.variant)

    @property
    def match_options(self) -> MatchOptions:
        """Options of the matching stage for this variant and these features."""
        similarity = self.pipeline.matcher.options.guided_similarity
        return self.pipeline.options.match(self.options.variant, similarity)

    def can_improve(self, answer: Answer) -> bool:
        """Whether wide correspondences could give a better answer than this one."""
        if self.options.variant is not Variant.BEST or len(self.references) < 2:
            return False
        if isinstance(answer.outcome, Rejection):
            return answer.outcome.reason not in (RejectionReason.DEGENERATE_REFERENCES, RejectionReason.AMBIGUOUS)
        return answer.outcome.inlier_count < self.pipeline.options.weak_inliers


@dataclass(frozen=True, eq=False)
class Coarse:
    """A query reconstructed together with its references.

    Attributes:
        prepared: the query.
        reconstruction: up to scale, or why there is none.
        scale: and with it the initial pose, in the world of `prepared`. Or why there is none: then wide correspondences
            are still to be tried.
        structure, matches: where they came with the scale, as they do from a device.
    """

    prepared: Prepared
    reconstruction: Outcome
    scale: MetricScale | Rejection
    structure: Structure | None = None
    matches: PointMatches | None = None

    def answer(self, outcome: Localization | Rejection, support: Support | None = None) -> Answer:
        """The answer to the caller, of an outcome in the world of `prepared`."""
        prepared, scale = self.prepared, None if isinstance(self.scale, Rejection) else self.scale
        matches = tuple(len(m) for m in prepared.correspondences.query_matches)
        inliers = support.inliers_by_reference() if support else (0,) * len(prepared.references)
        seconds = dict(prepared.context.stage_seconds)
        return shifted(Answer(outcome, scale, seconds, matches, inliers, support), prepared.origin)


def reconstruct(batch: Sequence[Prepared]) -> list[Coarse | Answer | Exception]:
    """The coarse stage of many queries in one go, then the metric scale of each.

    A reconstruction that stays on a device is worked on there as far as it can be, and the device has nothing more to
    do for these queries when this returns.

    Args:
        batch: queries of one reconstructor. Those of one bucket are reconstructed together.

    Returns:
        For each query, in their order, what is known of it; or its answer, if no more was asked for or nothing more
        can be done; or the exception that is its own, unchanged: what its check raised, or what was raised while it
        alone was computed, such as a torch.OutOfMemoryError when it was alone.

    Raises:
        ValueError: several reconstructors.
        Exception: of the batch as a whole; its halves show which query caused it.
    """
    if len({id(prepared.pipeline.reconstructor) for prepared in batch}) > 1:
        raise ValueError("one batch has one reconstructor")
    outcomes: list[Any] = _each(lambda prepared: prepared.context.check(), batch)
    wanted = [prepared for prepared, outcome in zip(batch, outcomes, strict=True) if outcome is None]
    start_s = time.perf_counter()
    requests = [Request(it.query, it.references, it.correspondences, it.priors) for it in wanted]
    made = iter(batch[0].pipeline.reconstructor.reconstruct_many(requests) if requests else [])
    outcomes = [next(made) if outcome is None else outcome for outcome in outcomes]
    spent_s = time.perf_counter() - start_s
    for prepared in batch:
        prepared.context.add("coarse", spent_s)
    # All are launched before the first is waited for, so that a device does not wait for the host in between.
    launched = _each(_launch_scale, batch, outcomes)
    return _each(lambda finish: _answered_if_final(finish()), launched)


def coarse_answer(coarse: Coarse) -> Answer | None:
    """What can be answered when there is no time to refine: the pose of `Variant.COARSE`; None if there is none yet."""
    if isinstance(coarse.scale, Rejection):
        return None
    return coarse.answer(Localization(coarse.scale.world_from_query, None, PoseStage.COARSE, 0, 0, 0.0))


def with_wide_correspondences(coarse: Coarse) -> Coarse:
    """The same query with wide correspondences among the references, and a reconstruction from them if it uses any."""
    prepared, reconstruction = coarse.prepared, coarse.reconstruction
    query, references, pipeline, context = prepared.query, prepared.references, prepared.pipeline, prepared.context
    with context.stage("correspond"):
        known = prepared.correspondences.query_matches
        correspondences = pipeline.matcher.correspond(query, references, True, context.check, known)
    with context.stage("coarse"):
        if pipeline.reconstructor.uses_correspondences:
            reconstruction = reconstruct_one(
                pipeline.reconstructor, query, references, correspondences, prepared.priors
            )
    return _launch_scale(replace(prepared, correspondences=correspondences), reconstruction)()


def _each(work: Callable[..., T], *columns: Sequence[Any]) -> list[T | Exception]:
    """The work's result in each row; an exception that stands in the row, or is raised there, is the row's alone."""
    results: list[T | Exception] = []
    for row in zip(*columns, strict=True):
        failures = [value for value in row if isinstance(value, Exception)]
        try:
            results.append(failures[0] if failures else work(*row))
        except Exception as error:
            results.append(error)
    return results


def _launch_scale(prepared: Prepared, reconstruction: Outcome) -> Callable[[], Coarse]:
    """The metric scale, computed where the reconstruction lies; only what is returned waits for a device."""
    references, correspondences, context = prepared.references, prepared.correspondences, prepared.context
    options = ScaleOptions(prepared.options.scale_strategy)
    coarse = partial(Coarse, prepared, reconstruction)
    if isinstance(reconstruction, Rejection):
        return partial(coarse, reconstruction)
    if isinstance(reconstruction, Reconstruction):
        with context.stage("scale"):
            return partial(coarse, estimate_scale(reconstruction, references, correspondences, options))
    from .on_device import launch_on_device
    from .on_device.compute import Options

    is_coarse = prepared.options.variant is Variant.COARSE
    further = (None, None) if is_coarse else (prepared.structure_options, prepared.match_options)
    context.check()
    start_s = time.perf_counter()
    launched = launch_on_device(reconstruction, prepared.query, references, correspondences, Options(options, *further))

    def wait() -> Coarse:
        found = launched()
        context.add("refine", time.perf_counter() - start_s)  # waiting for the whole batch is each query's
        return coarse(found) if isinstance(found, Rejection) else coarse(found.scale, found.structure, found.matches)

    return wait


def _answered_if_final(coarse: Coarse) -> Coarse | Answer:
    """The answer, if refining would not change it."""
    if isinstance(coarse.scale, Rejection):
        answer = coarse.answer(coarse.scale)
        return coarse if coarse.prepared.can_improve(answer) else answer
    if coarse.prepared.options.variant is Variant.COARSE:
        return coarse.answer(Localization(coarse.scale.world_from_query, None, PoseStage.INITIAL, 0, 0, 0.0))
    return coarse
