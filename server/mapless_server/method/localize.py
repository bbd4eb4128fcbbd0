"""The method on one screen: correspond > coarse > scale > structure > match > pnp > gate > adjust > covariance > judge.

Where the references share too little with one another for that, `two_view` follows.

`localize` calls the three parts in order for one query. The queue calls each part separately: `prepare` (correspond),
`reconstruct` (coarse and scale of a batch of queries; in `pipeline`), `refine` (the rest).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from .adjust import adjust_pose, pose_covariance
from .answer import Answer, Localization, is_better
from .context import StageContext
from .match import match_points
from .one_reference import one_reference_failure, solve_one_reference, trust_of_score
from .options import LocalizeOptions, Variant
from .pipeline import Coarse, Pipeline, Prepared, reconstruct, with_wide_correspondences
from .pnp import solve_pose
from .priors.known import NO_PRIORS, Priors
from .rejection import Rejection, RejectionReason
from .results import MetricScale, PointMatches, ScaleStage, Structure, Support
from .structure import build_structure
from .trust.gate import gate_failure
from .trust.intrinsics import intrinsics_checks
from .trust.judge import contradiction, judge
from .trust.two_view import (
    lacks_distance,
    one_reference_rejection,
    two_view_evidence,
    two_view_failure,
    two_view_trust,
)
from .trust.votes import votes_of
from .two_view.solve import solve_two_view
from .views import Matches, PosedView, Reconstruction, View

MIN_FEATURES = 12
"""A photograph with fewer local features is blank, black or blurred."""


def localize(
    query: View,
    references: Sequence[PosedView],
    pipeline: Pipeline,
    options: LocalizeOptions,
    context: StageContext | None = None,
    priors: Priors = NO_PRIORS,
) -> Answer:
    """Localizes a query among posed references, the most similar first; priors are in the references' world.

    A rejection is an answer too; it names the first stage that failed. Raises whatever the context's check raises.
    """
    prepared = prepare(query, references, pipeline, options, context or StageContext(), priors=priors)
    if isinstance(prepared, Answer):
        return prepared
    (coarse,) = reconstruct([prepared])
    if isinstance(coarse, Exception):
        raise coarse
    return coarse if isinstance(coarse, Answer) else refine(coarse)


def prepare(
    query: View,
    references: Sequence[PosedView],
    pipeline: Pipeline,
    options: LocalizeOptions,
    context: StageContext,
    query_matches: Sequence[Matches] | None = None,
    priors: Priors = NO_PRIORS,
    is_metric: bool = True,
) -> Prepared | Answer:
    """Matches the query with its references and these with one another; an answer if the query is rejected here.

    `query_matches` with each reference, if given, are used as they are: the references were chosen by them.
    `is_metric` is whether the unit of the references' poses is the metre. Raises ValueError if a view lacks input of
    the coarse backend.
    """
    if not references:
        return Answer(Rejection(RejectionReason.NO_USABLE_REFERENCES, "no references"))
    if len(query.features) < MIN_FEATURES:
        message = f"the photograph has {len(query.features)} local features, {MIN_FEATURES} are needed"
        return Answer(Rejection(RejectionReason.LOW_TEXTURE, message))
    origin = references[0].world_from_camera.translation
    nearby = tuple(replace(r, world_from_camera=r.world_from_camera.shifted(-origin)) for r in references)
    bucket = pipeline.reconstructor.bucket(query, nearby)
    with context.stage("correspond"):
        correspondences = pipeline.matcher.correspond(query, references, False, context.check, query_matches)
    return Prepared(
        query,
        nearby,
        tuple(references),
        origin,
        pipeline,
        options,
        correspondences,
        bucket,
        context,
        priors.shifted(-origin),
        is_metric,
    )


def refine(coarse: Coarse) -> Answer:
    """Structure, matches and pose; if the result is weak, all again from wide correspondences.

    If the gate still rejects the pose, its agreement with gravity or heading is counted as evidence for it. If that
    does not help either, the pose is estimated from matches with the references themselves (see `two_view`).
    """
    answer = _strict_then_wide(coarse, counts_agreement=False)
    is_gated = isinstance(answer.outcome, Rejection) and answer.outcome.reason is RejectionReason.GATE
    if is_gated and coarse.prepared.priors.has_directions:
        answer = _strict_then_wide(coarse, counts_agreement=True)
    return _solve_two_view(coarse, answer) if coarse.prepared.can_use_two_views(answer) else answer


def _strict_then_wide(coarse: Coarse, counts_agreement: bool) -> Answer:
    answer = _solve(coarse, counts_agreement)
    if not coarse.prepared.can_improve(answer):
        return answer
    wide = _solve(with_wide_correspondences(coarse), counts_agreement)
    better = wide if is_better(wide, answer, coarse.prepared.pipeline.options.max_radius_ratio) else answer
    return replace(better, stage_seconds=wide.stage_seconds)


def _solve(coarse: Coarse, counts_agreement: bool) -> Answer:
    """From the metric scale to an accepted pose; `counts_agreement` with gravity and heading as evidence for it."""
    prepared, scale, stage = coarse.prepared, coarse.scale, coarse.prepared.context.stage
    if isinstance(scale, Rejection):
        return coarse.answer(scale)
    if scale.stage is ScaleStage.NETWORK:
        return _solve_one_reference(coarse, scale)
    query, references, options, priors = prepared.query, prepared.references, prepared.pipeline.options, prepared.priors
    structure, matches = _structure_and_matches(coarse, scale)
    query_matches = tuple(prepared.correspondences.query_matches)
    support = Support(query, references, structure, matches, None, prepared.origin, query_matches=query_matches)
    with stage("pnp"):
        estimate = solve_pose(query, structure, matches, scale.world_from_query, options.pnp, priors)
    if isinstance(estimate, Rejection):
        return coarse.answer(estimate, support)
    pose, inliers = estimate.world_from_camera, estimate.inliers
    chance = priors.log10_chance(pose) if counts_agreement else 0.0
    failure = gate_failure(query.camera, matches, inliers, options.pnp.inlier_px, options.gate, chance)
    if failure:
        return coarse.answer(Rejection(RejectionReason.GATE, failure), replace(support, estimate=estimate))
    if prepared.options.variant is Variant.BEST:
        with stage("adjust"):
            sigma = prepared.options.intrinsics
            estimate = adjust_pose(query, references, structure, matches, estimate, options.adjust, priors, sigma)
    support = replace(support, estimate=estimate, query=estimate.view or query)
    with stage("uncertainty"):
        predicted = not prepared.structure_options.optimize
        covariance = pose_covariance(support, scale, options.adjust, priors, predicted)
    estimate = replace(estimate, covariance=covariance)
    support = replace(support, estimate=estimate)
    with stage("judge"):
        judged = judge(support, query_matches, prepared.options.coverage, options.judge, chance)
    if judged.rejection:
        return coarse.answer(judged.rejection, support)
    checks = intrinsics_checks(estimate.intrinsics, options.judge.intrinsics) if estimate.intrinsics else ()
    return coarse.answer(Localization.of(estimate, judged.trust, None, checks), support)


def _solve_one_reference(coarse: Coarse, scale: MetricScale) -> Answer:
    """From a single reference, by the network's depths and metres; priors are compared with the pose, and not used."""
    prepared, options = coarse.prepared, coarse.prepared.pipeline.options
    assert isinstance(coarse.reconstruction, Reconstruction)
    given = prepared.query, prepared.references, coarse.reconstruction, scale, prepared.correspondences.query_matches
    with prepared.context.stage("pnp"):
        found = solve_one_reference(*given, prepared.origin, options.one_reference)
    if isinstance(found, Rejection):
        return coarse.answer(found)
    estimate = found.support.estimate
    assert estimate is not None
    checks = prepared.priors.check(estimate.world_from_camera, estimate.covariance)
    estimate = replace(estimate, prior_checks=tuple(replace(it, used=False) for it in checks))
    support = replace(found.support, estimate=estimate)
    trust = trust_of_score(found.score, options.one_reference)
    failure = one_reference_failure(found, trust, prepared.options.coverage, options.gate)
    if failure:
        return coarse.answer(Rejection(RejectionReason.GATE, failure), support)
    return coarse.answer(replace(Localization.of(estimate, trust), scale_source=scale.source), support)


def _solve_two_view(coarse: Coarse, answer: Answer) -> Answer:
    """The answer from two-view matches and 2D-3D matches together; the given rejection if that gives none."""
    support = _two_view_support(coarse, answer.support)
    answer = replace(answer, stage_seconds=dict(coarse.prepared.context.stage_seconds))
    if support is None or support.estimate is None:
        return answer
    prepared, options = coarse.prepared, coarse.prepared.pipeline.options
    query_matches, estimate = prepared.correspondences.query_matches, support.estimate
    with prepared.context.stage("judge"):
        evidence = two_view_evidence(support, query_matches, options.two_view_gate)
        doubt, trust = (
            two_view_failure(evidence, options.two_view_gate),
            two_view_trust(evidence, options.two_view_gate),
        )
        rejection = None if doubt else contradiction(support, votes_of(support, query_matches), options.judge)
    if rejection:
        return coarse.answer(rejection, support)
    if doubt and lacks_distance(evidence, options.two_view_gate):
        assert isinstance(answer.outcome, Rejection)
        return replace(answer, outcome=one_reference_rejection(answer.outcome.reason, doubt, support))
    if doubt or trust < 1 - prepared.options.coverage:
        return answer
    return coarse.answer(Localization.of(estimate, trust, support.two_view), support)


def _two_view_support(coarse: Coarse, found: Support | None) -> Support | None:
    """The pose from two-view matches and wide correspondences; a pose found before is a candidate."""
    prepared, options = coarse.prepared, coarse.prepared.pipeline.options
    query, references, context = prepared.query, prepared.references, prepared.context
    query_matches, matcher = prepared.correspondences.query_matches, prepared.pipeline.matcher
    known = [found.estimate.world_from_camera] if found and found.estimate else []
    with context.stage("two_view"):
        wide = matcher.correspond(query, references, True, context.check, query_matches)
        stages = prepared.structure_options, prepared.match_options, options.adjust
        result = solve_two_view(query, references, wide, known, prepared.origin, *stages, options.two_view)
    if result is None or result.estimate is None:
        return None
    checks = prepared.priors.check(result.estimate.world_from_camera, result.estimate.covariance)
    unused = tuple(replace(it, used=False) for it in checks)
    return replace(result, estimate=replace(result.estimate, prior_checks=unused))


def _structure_and_matches(coarse: Coarse, scale: MetricScale) -> tuple[Structure, PointMatches]:
    """Computed on the device together with the scale, or else here."""
    if coarse.structure is not None and coarse.matches is not None:
        return coarse.structure, coarse.matches
    prepared, reconstruction = coarse.prepared, coarse.reconstruction
    assert isinstance(reconstruction, Reconstruction)
    references, correspondences = prepared.references, prepared.correspondences
    with prepared.context.stage("structure"):
        structure = build_structure(reconstruction, scale, references, correspondences, prepared.structure_options)
    with prepared.context.stage("match"):
        initial, options = scale.world_from_query, prepared.match_options
        prior_pose = prepared.priors.pose.world_from_camera if prepared.priors.pose else None
        matches = match_points(prepared.query, references, structure, correspondences, initial, options, prior_pose)
    return structure, matches
