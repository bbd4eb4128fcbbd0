"""The method, on one screen.

Five stages, each knowing the result of the one before: coarse > scale > structure > match > pnp; and a sixth of our
own, adjust. Beneath them all lie the correspondences between the photographs' features.

    prepare > reconstruct > refine
    (each    (many queries  (each
     query)   in one go)     query)

`localize` is the three in order, for one query; whoever has many calls them itself, and may do without the last.

This module knows nothing of grpc, queues or storage.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np

from mapless.geometry import Array

from .adjust import adjust_pose
from .answer import Answer, Localization, LocalizeOptions, Variant, is_better, shifted
from .coarse import Bucket, Outcome, Reconstructor, Request, reconstruct_one
from .coarse.geometric import GeometricReconstructor
from .correspond import Correspondences, Matcher
from .match import MatchOptions, PointMatches, match_points
from .pnp import PoseStage, solve_pose
from .pose_covariance import pose_covariance
from .priors.known import NO_PRIORS, Priors
from .reconstruction import Reconstruction
from .rejection import Rejection, RejectionReason
from .scale import MetricScale, estimate_scale
from .scale_equations import ScaleOptions
from .stopwatch import timed
from .structure import Structure, build_structure
from .support import Support
from .trust.gate import doubts
from .trust.judge import judge
from .views import Matches, PosedView, View

__all__ = [
    "MIN_FEATURES",
    "Answer",
    "Coarse",
    "Localization",
    "LocalizeOptions",
    "Pipeline",
    "Prepared",
    "Variant",
    "coarse_answer",
    "localize",
    "prepare",
    "reconstruct",
    "refine",
]

T = TypeVar("T")

MIN_FEATURES = 12
"""A photograph with fewer local features is blank, black or blurred."""


@dataclass(frozen=True, eq=False)
class Pipeline:
    """What the method runs on, shared by all queries.

    Attributes:
        reconstructor: the coarse backend.
        matcher: remembers matches between references.
    """

    reconstructor: Reconstructor = field(default_factory=GeometricReconstructor)
    matcher: Matcher = field(default_factory=Matcher)


Check = Callable[[], None]
"""Called between steps; raises when nobody wants the answer any more."""


def _somebody_waits() -> None:
    """A `Check` that never raises."""


@dataclass(frozen=True, eq=False)
class Prepared:
    """A query whose features are matched: all that can be known of it before the coarse stage.

    Attributes:
        query: the photograph.
        references: the most similar first, in a world in which the first one stands at the origin. World coordinates
            may be millions of metres (UTM, ECEF), too long for the digits of differences of squares.
        origin: (3,) where that is in the caller's world, metres.
        pipeline: what to run on.
        options: of the method.
        correspondences: between all photographs.
        bucket: prepared queries of the same bucket may be reconstructed together.
        stage_seconds: time of each stage so far.
        priors: what is known of the query's pose, in the same world.
    """

    query: View
    references: tuple[PosedView, ...]
    origin: Array
    pipeline: Pipeline
    options: LocalizeOptions
    correspondences: Correspondences
    bucket: Bucket
    stage_seconds: dict[str, float]
    priors: Priors = NO_PRIORS


@dataclass(frozen=True, eq=False)
class Coarse:
    """A query reconstructed together with its references.

    Attributes:
        prepared: the query.
        reconstruction: up to scale, or why there is none.
        scale: and with it the initial pose, in the world of `prepared`. Or why there is none: then `refine` has wider
            correspondences yet to try.
        structure, matches: where they came with the scale, as they do from a device.
        stage_seconds: time of each stage so far.
    """

    prepared: Prepared
    reconstruction: Outcome
    scale: MetricScale | Rejection
    structure: Structure | None = None
    matches: PointMatches | None = None
    stage_seconds: dict[str, float] = field(default_factory=dict)

    def answer(
        self,
        outcome: Localization | Rejection,
        stage_seconds: dict[str, float],
        support: Support | None = None,
    ) -> Answer:
        """What `outcome`, in the world of `prepared`, is to the caller."""
        prepared, scale = self.prepared, None if isinstance(self.scale, Rejection) else self.scale
        matches = tuple(len(m) for m in prepared.correspondences.query_matches)
        inliers = support.inliers_by_reference() if support else (0,) * len(prepared.references)
        return shifted(Answer(outcome, scale, stage_seconds, matches, inliers, support), prepared.origin)


def localize(
    query: View,
    references: Sequence[PosedView],
    pipeline: Pipeline,
    options: LocalizeOptions,
    check: Check = _somebody_waits,
    priors: Priors = NO_PRIORS,
) -> Answer:
    """Localizes a query among posed references.

    Args:
        query: the photograph.
        references: the most similar first.
        pipeline: what to run on.
        options: see there.
        check: called between the steps.
        priors: what is known of the query's pose, in the references' world.

    Returns:
        The answer; "no pose" is one, with the first stage that could not do its work.
    """
    prepared = prepare(query, references, pipeline, options, check, priors=priors)
    if isinstance(prepared, Answer):
        return prepared
    (coarse,) = reconstruct([prepared], [check])
    if isinstance(coarse, Exception):
        raise coarse
    return coarse if isinstance(coarse, Answer) else refine(coarse, check)


def prepare(
    query: View,
    references: Sequence[PosedView],
    pipeline: Pipeline,
    options: LocalizeOptions,
    check: Check = _somebody_waits,
    query_matches: Sequence[Matches] | None = None,
    priors: Priors = NO_PRIORS,
) -> Prepared | Answer:
    """The first of the three parts, with the arguments of `localize`; an answer if there is nothing to go on with.

    `query_matches` with each reference are taken as they are, where the references were chosen by them.

    Raises:
        ValueError: a view lacks what the coarse backend looks at.
    """
    if not references:
        return Answer(Rejection(RejectionReason.NO_USABLE_REFERENCES, "no references"))
    if len(query.features) < MIN_FEATURES:
        message = f"the photograph has {len(query.features)} local features, {MIN_FEATURES} are needed"
        return Answer(Rejection(RejectionReason.LOW_TEXTURE, message))

    origin = references[0].world_from_camera.translation
    nearby = tuple(replace(r, world_from_camera=r.world_from_camera.shifted(-origin)) for r in references)
    bucket = pipeline.reconstructor.bucket(query, nearby)
    stage_seconds: dict[str, float] = {}
    with _stage("correspond", stage_seconds, check):
        correspondences = pipeline.matcher.correspond(query, nearby, False, check, query_matches)
    known = priors.shifted(-origin)
    return Prepared(query, nearby, origin, pipeline, options, correspondences, bucket, stage_seconds, known)


def reconstruct(batch: Sequence[Prepared], checks: Sequence[Check] = ()) -> list[Coarse | Answer | Exception]:
    """The second part: the coarse stage of many queries in one go, then the metric scale of each.

    A reconstruction that stays on a device is worked on there as far as it can be, and the device has nothing more to
    do for these queries when this returns.

    Args:
        batch: queries of one reconstructor. Those of one bucket are reconstructed together.
        checks: one for each query, or none at all.

    Returns:
        For each query, in their order, what is known of it; or its answer, if no more was asked for or nothing more
        can be done; or the exception that is its own, unchanged: what its check raised, or what was raised while it
        alone was computed, such as a torch.OutOfMemoryError when it was alone.

    Raises:
        ValueError: several reconstructors.
        Exception: of the batch as a whole; its halves tell whose fault it was.
    """
    if len({id(prepared.pipeline.reconstructor) for prepared in batch}) > 1:
        raise ValueError("one batch has one reconstructor")
    checks = checks or [_somebody_waits] * len(batch)
    seconds: dict[str, float] = {}
    outcomes: list[Any] = _each(lambda check: check(), checks)
    wanted = [i for i, outcome in enumerate(outcomes) if outcome is None]
    with timed(seconds, "coarse"):
        requests = [Request(p.query, p.references, p.correspondences, p.priors) for p in (batch[i] for i in wanted)]
        made = batch[0].pipeline.reconstructor.reconstruct_many(requests) if requests else []
    for i, outcome in zip(wanted, made, strict=True):
        outcomes[i] = outcome
    # All are launched before the first is waited for, so that a device does not wait for the host in between.
    launched = _each(_launch_scale, batch, outcomes, [p.stage_seconds | seconds for p in batch], checks)
    return _each(lambda finish: _settled(finish()), launched)


def refine(coarse: Coarse, check: Check = _somebody_waits) -> Answer:
    """The third part: structure, matches and pose; and where that gives little, all again more widely.

    Where all that is not enough for a pose to be believed, its agreement with gravity or heading may be.
    """
    answer = _refined(coarse, check, counts_agreement=False)
    priors, outcome = coarse.prepared.priors, answer.outcome
    if not (isinstance(outcome, Rejection) and outcome.reason is RejectionReason.GATE and priors.tells_directions):
        return answer
    return _refined(replace(coarse, stage_seconds=answer.stage_seconds), check, counts_agreement=True)


def _refined(coarse: Coarse, check: Check, counts_agreement: bool) -> Answer:
    """Strictly, and if that gives little more widely; `counts_agreement` as in `_pose`."""
    prepared, options = coarse.prepared, coarse.prepared.options
    answer = _pose(coarse, check, counts_agreement)
    if not _may_be_better(answer, prepared):
        return answer
    wide = _pose(_look_wider(coarse, answer.stage_seconds, check), check, counts_agreement)
    better = wide if is_better(wide, answer, options) else answer
    return replace(better, stage_seconds=wide.stage_seconds)


def coarse_answer(coarse: Coarse) -> Answer | None:
    """What can be answered when there is no time to refine: the pose of `Variant.COARSE`; None if there is none yet."""
    if isinstance(coarse.scale, Rejection):
        return None
    outcome = Localization(coarse.scale.world_from_query, None, PoseStage.COARSE, 0, 0, 0.0)
    return coarse.answer(outcome, dict(coarse.stage_seconds))


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


@contextmanager
def _stage(name: str, stage_seconds: dict[str, float], check: Check) -> Iterator[None]:
    check()
    with timed(stage_seconds, name):
        yield


def _launch_scale(
    prepared: Prepared, reconstruction: Outcome, stage_seconds: dict[str, float], check: Check
) -> Callable[[], Coarse]:
    """The metric scale, computed where the reconstruction lies; only what is returned waits for a device."""
    query, references, correspondences = prepared.query, prepared.references, prepared.correspondences
    options, scale_options = prepared.options, ScaleOptions(prepared.options.scale_strategy)
    known = partial(Coarse, prepared, reconstruction, stage_seconds=stage_seconds)
    if isinstance(reconstruction, Rejection):
        return partial(known, reconstruction)
    if isinstance(reconstruction, Reconstruction):
        with _stage("scale", stage_seconds, check):
            return partial(known, estimate_scale(reconstruction, references, correspondences, scale_options))
    from .on_device import launch_on_device
    from .on_device.compute import Options

    further = (None, None) if options.variant is Variant.COARSE else (options.structure, _match_options(prepared))
    check()
    start_s = time.perf_counter()
    refined = launch_on_device(reconstruction, query, references, correspondences, Options(scale_options, *further))

    def wait() -> Coarse:
        found = refined()
        # Waiting for the whole batch is each query's.
        stage_seconds["refine"] = stage_seconds.get("refine", 0.0) + time.perf_counter() - start_s
        return known(found) if isinstance(found, Rejection) else known(found.scale, found.structure, found.matches)

    return wait


def _match_options(prepared: Prepared) -> MatchOptions:
    return prepared.options.match(prepared.pipeline.matcher.options.guided_similarity)


def _settled(coarse: Coarse) -> Coarse | Answer:
    """The answer, if refining would not change it."""
    scale, seconds = coarse.scale, coarse.stage_seconds
    if isinstance(scale, Rejection):
        answer = coarse.answer(scale, seconds)
        return coarse if _may_be_better(answer, coarse.prepared) else answer
    if coarse.prepared.options.variant is Variant.COARSE:
        return coarse.answer(Localization(scale.world_from_query, None, PoseStage.INITIAL, 0, 0, 0.0), seconds)
    return coarse


def _pose(coarse: Coarse, check: Check, counts_agreement: bool) -> Answer:
    """From the metric scale to the pose, believed or not; agreement with gravity and heading speaks for it if asked."""
    prepared, scale, seconds = coarse.prepared, coarse.scale, dict(coarse.stage_seconds)
    if isinstance(scale, Rejection):
        return coarse.answer(scale, seconds)
    query, references, options = prepared.query, prepared.references, prepared.options
    structure, matches = _structure_and_matches(coarse, scale, seconds, check)
    support = Support(query, references, structure, matches, None, prepared.origin)
    with _stage("pnp", seconds, check):
        estimate = solve_pose(query, structure, matches, scale.world_from_query, options.pnp, prepared.priors)
    if isinstance(estimate, Rejection):
        return coarse.answer(estimate, seconds, support)
    pose, inliers = estimate.world_from_camera, estimate.inliers
    chance = prepared.priors.log10_chance(pose) if counts_agreement else 0.0
    doubt = doubts(query, structure, matches, pose, inliers, options.pnp.inlier_px, options.gate, chance)
    if doubt:
        rejection = Rejection(RejectionReason.GATE, doubt)
        return coarse.answer(rejection, seconds, replace(support, estimate=estimate))
    if options.variant is Variant.BEST:
        with _stage("adjust", seconds, check):
            estimate = adjust_pose(query, references, structure, matches, estimate, options.adjust, prepared.priors)
    support = replace(support, estimate=estimate)
    with _stage("uncertainty", seconds, check):
        predicted = not options.structure.optimize
        covariance = pose_covariance(support, scale, options.adjust.uncertainty, prepared.priors, predicted)
    estimate = replace(estimate, covariance=covariance)
    support = replace(support, estimate=estimate)
    with _stage("judge", seconds, check):
        query_matches = prepared.correspondences.query_matches
        judged = judge(support, query_matches, options.pnp.inlier_px, options.coverage, options.judge, chance)
    if judged.rejection:
        return coarse.answer(judged.rejection, seconds, support)
    outcome = Localization(
        estimate.world_from_camera,
        estimate.covariance,
        estimate.stage,
        int(estimate.inliers.sum()),
        len(matches),
        float(np.median(estimate.errors_px[estimate.inliers])),
        estimate.prior_checks,
        judged.trust,
    )
    return coarse.answer(outcome, seconds, support)


def _structure_and_matches(
    coarse: Coarse, scale: MetricScale, stage_seconds: dict[str, float], check: Check
) -> tuple[Structure, PointMatches]:
    """They came with the scale from a device, or are computed here."""
    if coarse.structure is not None and coarse.matches is not None:
        return coarse.structure, coarse.matches
    prepared, reconstruction = coarse.prepared, coarse.reconstruction
    assert isinstance(reconstruction, Reconstruction)
    references, correspondences = prepared.references, prepared.correspondences
    with _stage("structure", stage_seconds, check):
        structure = build_structure(reconstruction, scale, references, correspondences, prepared.options.structure)
    with _stage("match", stage_seconds, check):
        options, initial = _match_options(prepared), scale.world_from_query
        foreseen = prepared.priors.pose.world_from_camera if prepared.priors.pose else None
        matches = match_points(prepared.query, references, structure, correspondences, initial, options, foreseen)
    return structure, matches


def _look_wider(coarse: Coarse, stage_seconds: dict[str, float], check: Check) -> Coarse:
    """The same query with wide correspondences among the references, and a reconstruction from them if they matter."""
    prepared, seconds = coarse.prepared, dict(stage_seconds)
    query, references, pipeline = prepared.query, prepared.references, prepared.pipeline
    with _stage("correspond", seconds, check):
        known = prepared.correspondences.query_matches
        correspondences = pipeline.matcher.correspond(query, references, True, check, known)
    with _stage("coarse", seconds, check):
        reconstruction = coarse.reconstruction
        if pipeline.reconstructor.uses_correspondences:
            reconstruction = reconstruct_one(
                pipeline.reconstructor, query, references, correspondences, prepared.priors
            )
    return _launch_scale(replace(prepared, correspondences=correspondences), reconstruction, seconds, check)()


def _may_be_better(answer: Answer, prepared: Prepared) -> bool:
    """Whether wide correspondences could make the answer better."""
    options, outcome = prepared.options, answer.outcome
    if options.variant is not Variant.BEST or len(prepared.references) < 2:
        return False
    if isinstance(outcome, Rejection):
        return outcome.reason not in (RejectionReason.DEGENERATE_REFERENCES, RejectionReason.AMBIGUOUS)
    return outcome.inlier_count < options.weak_inliers
