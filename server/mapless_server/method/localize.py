"""The method on one screen: correspond > coarse > scale > structure > match > pnp > gate > adjust > covariance > judge.

Where one reference is given, or the references share too little with one another for that: `alternatives`.

`localize` calls the three parts in order for one query. The queue calls each part separately: `prepare` (correspond),
`reconstruct` (coarse and scale of a batch of queries; in `pipeline`), `refine` (the rest).
"""

from collections.abc import Sequence
from dataclasses import replace

from .alternatives import from_one_reference, or_from_two_views
from .bundle.adjust import adjust_pose, with_covariance
from .bundle.estimate import Support
from .bundle.priors import NO_PRIORS, Priors
from .bundle.radii import with_halves
from .features.views import Matches, PosedView, View
from .judge.answer import Answer, Localization, is_better
from .judge.fixed import unmoved_failure
from .judge.intrinsics import intrinsics_checks
from .judge.judge import judge
from .options import LocalizeOptions, StageContext, Variant
from .pairs.pair import Matching
from .pipeline import Coarse, Pipeline, Prepared, reconstruct, structure_and_matches, with_wide_correspondences
from .pose.pnp import gate_failure, solve_pose
from .rejection import Rejection, RejectionReason
from .structure.model import ScaleStage

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
    """Matches the query with its references, and these with one another; an answer if the query is rejected here.

    `query_matches` with each reference, if given, are used unchanged: the references were chosen by them.
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
        correspondences = pipeline.matcher.correspond(query, references, Matching.STRICT, context.check, query_matches)
    given = query, nearby, tuple(references), origin, pipeline, options
    return Prepared(*given, correspondences, bucket, context, priors.shifted(-origin), is_metric)


def refine(coarse: Coarse) -> Answer:
    """Computes structure, matches and pose; if the result is weak, all of it again from wide correspondences.

    If the gate still rejects the pose, its agreement with gravity or heading is counted as evidence for it. If that
    does not help either, the pose is estimated from matches with the references themselves (see `two_view`).

    A pose that is rejected with priors, or weak and from an initial pose that only they gave, is no evidence against
    what the photograph gives without them: that is computed, too, and is the answer to a photograph rejected with them.
    """
    prepared = coarse.prepared
    answer = _strict_then_wide(coarse, counts_agreement=False)
    is_gated = isinstance(answer.outcome, Rejection) and answer.outcome.reason is RejectionReason.GATE
    if is_gated and prepared.priors.has_directions:
        answer = _strict_then_wide(coarse, counts_agreement=True)
    is_rejected = isinstance(answer.outcome, Rejection)
    if not (prepared.priors and prepared.can_improve(answer) and (is_rejected or coarse.rests_on_priors)):
        return or_from_two_views(coarse, answer)
    alone = prepared.checked(_strict_then_wide(coarse.without_priors(), counts_agreement=False))
    alone = or_from_two_views(coarse, alone)
    is_used = is_rejected or is_better(alone, answer, prepared.pipeline.options.max_radius_ratio)
    return alone if is_used else replace(answer, stage_seconds=alone.stage_seconds)


def _strict_then_wide(coarse: Coarse, counts_agreement: bool) -> Answer:
    answer = solve(coarse, counts_agreement)
    if not coarse.prepared.can_improve(answer):
        return answer
    wide = solve(with_wide_correspondences(coarse), counts_agreement)
    better = wide if is_better(wide, answer, coarse.prepared.pipeline.options.max_radius_ratio) else answer
    return replace(better, stage_seconds=wide.stage_seconds)


def solve(coarse: Coarse, counts_agreement: bool = False) -> Answer:
    """Computes an accepted pose from the scale; if `counts_agreement`, gravity and heading count as evidence for it."""
    prepared, scale, stage = coarse.prepared, coarse.scale, coarse.prepared.context.stage
    if isinstance(scale, Rejection):
        return coarse.answer(scale)
    if scale.stage is ScaleStage.NETWORK:
        return from_one_reference(coarse, scale)
    query, references, options, priors = prepared.query, prepared.references, prepared.pipeline.options, prepared.priors
    structure, matches = structure_and_matches(coarse, scale)
    query_matches = tuple(prepared.correspondences.query_matches)
    sigma = prepared.options.intrinsics
    support = Support(query, references, structure, matches, None, prepared.origin, None, query_matches, sigma)
    support = replace(support, reference_error_px=prepared.correspondences.reference_error_px)
    with stage("pnp"):
        estimate = solve_pose(query, structure, matches, scale.world_from_query, options.pnp, priors)
    if isinstance(estimate, Rejection):
        return coarse.answer(estimate, support)
    pose, inliers = estimate.world_from_camera, estimate.inliers
    chance = priors.log10_chance(pose) if counts_agreement else 0.0
    failure = gate_failure(query.camera, matches, inliers, options.pnp.inlier_px, chance)
    support = replace(support, estimate=estimate)
    fixed = prepared.pipeline.matcher.stationary
    failure = failure or unmoved_failure(support, options.pnp.inlier_px, fixed, chance)
    if failure:
        return coarse.answer(Rejection(RejectionReason.GATE, failure), support)
    if prepared.options.variant is Variant.BEST:
        with stage("adjust"):
            given = query, references, structure, matches, estimate, options.adjust, priors, sigma
            estimate = adjust_pose(*given, query_matches)
    support = replace(support, estimate=estimate, query=estimate.view or query)
    with stage("uncertainty"):
        predicted = not prepared.structure_options.optimize
        estimate = with_covariance(support, scale, options.adjust, priors, predicted, sigma)
    support = replace(support, estimate=estimate)
    with stage("judge"):
        judged = judge(support, query_matches, prepared.options.coverage, options.judge, chance, prepared.unit)
    if judged.rejection:
        return coarse.answer(judged.rejection, support)
    estimate = with_halves(estimate, judged.evidence.disagreement * support.distance_m())
    checks = intrinsics_checks(estimate.intrinsics, options.judge.intrinsics) if estimate.intrinsics else ()
    return coarse.answer(Localization.of(estimate, judged.trust, None, checks), support)
