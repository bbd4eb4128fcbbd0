"""One attempt at a pose: scale > structure > match > pnp > gate > adjust > covariance > judge.

Where one reference is given the points are those of its depths; `Solver.LINES` needs no points at all.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapless.geometry import RigidTransform

from .bundle.adjust import adjust_pose, with_covariance
from .bundle.estimate import PosedSupport, PoseEstimate, Support, with_halves
from .bundle.pose_problem import AdjustInput
from .bundle.shutter import StillView, row_times, still_view, with_motion, without_motion
from .features.views import DepthSource, Matches, PosedView, Reconstruction
from .judge.answer import Answer, Localization
from .judge.evidence import Votes, votes_of
from .judge.hypothesis import Attempt, Doubt, Found, Solver, doubt_of, found_by
from .judge.intrinsics import intrinsics_checks
from .judge.judge import contradiction, judge, one_reference_failure, one_reference_radius_failure, trust_of_score
from .judge.references import unmoved_failure
from .judge.two_view import (
    lacks_distance,
    one_reference_rejection,
    two_view_evidence,
    two_view_failure,
    two_view_trust,
    without_unmoved,
)
from .options import DoubtOptions, Variant
from .pipeline import (
    Coarse,
    matches_of,
    structure_and_matches,
    unverified,
    wide_correspondences,
    with_wide_correspondences,
)
from .pose.by_depths import MatchedDepths, solve_by_depths
from .pose.own_depth import checked, contradicted, improved
from .pose.pnp import gate_failure, solve_pose
from .pose.two_view import TwoViewOptions, solve_two_view
from .rejection import Rejection, RejectionReason
from .structure.model import MetricScale, PointMatches, ScaleSource, ScaleStage, Structure


def solve(coarse: Coarse, attempt: Attempt, doubt: DoubtOptions) -> Found:
    """Computes an attempt's pose from its photographs, matched strictly and reconstructed together.

    Args:
        coarse: the reconstruction of the attempt's basis, with priors if there are any.
        attempt: the changes of the attempt.
        doubt: when the pose is doubtful.
    """
    if attempt.solver is Solver.LINES:
        return found_by(attempt, _from_lines(coarse), doubt)
    if attempt.solver is Solver.DEPTHS:
        return found_by(attempt, _from_depths(coarse), doubt)
    made = with_wide_correspondences(coarse) if attempt.matching.is_wide else coarse
    answer, alone = _from_points(made), made.rejected_alone
    # If only the priors gave an initial pose, and no answer, the photograph lacks what it lacks without them.
    doubts = doubt_of(alone) if alone and isinstance(answer.outcome, Rejection) else Doubt.NONE
    return found_by(attempt, answer, doubt, doubts)


def _from_points(coarse: Coarse) -> Answer:
    """The pose from 2D-3D matches.

    If the evidence does not suffice, the pose's agreement with gravity and heading counts as evidence, too.
    """
    prepared, scale = coarse.prepared, coarse.scale
    if isinstance(scale, Rejection):
        return coarse.answer(scale)
    if prepared.options.variant is Variant.COARSE:
        return coarse.answer(unverified(scale))
    if scale.is_from_depth:
        return _from_one_reference(coarse, scale)
    structure, matches = structure_and_matches(coarse, scale)
    if prepared.options.shutter is None:
        return _solved(coarse, scale, structure, matches)
    still = _still(coarse, scale, structure, matches)
    if still.view is not prepared.query:
        scale = replace(scale, world_from_query=still.world_from_camera)
        coarse = replace(coarse, prepared=replace(prepared, query=still.view), scale=scale)
        matches = matches_of(coarse, scale, structure)
    return _solved(coarse, scale, structure, matches, still)


def _still(coarse: Coarse, scale: MetricScale, structure: Structure, matches: PointMatches) -> StillView:
    """The photograph as if its camera had stood still while a rolling shutter read it, by matches with points."""
    prepared = coarse.prepared
    assert prepared.options.shutter is not None
    with prepared.context.stage("shutter"):
        seen = matches.seen(prepared.query, structure.x_in_world)
        start = scale.world_from_query
        return still_view(prepared.query, seen, matches.keypoint, start, prepared.options.shutter)


def _solved(
    coarse: Coarse, scale: MetricScale, structure: Structure, matches: PointMatches, still: StillView | None = None
) -> Answer:
    """The pose from matches with points, of a photograph that a rolling shutter read if there is a `still` view."""
    prepared, stage = coarse.prepared, coarse.prepared.context.stage
    query, references, options, priors = prepared.query, prepared.references, prepared.pipeline.options, prepared.priors
    query_matches = tuple(prepared.correspondences.query_matches)
    sigma = prepared.options.intrinsics
    error_px = prepared.correspondences.reference_error_px
    support = Support(query, references, structure, matches, prepared.origin, query_matches, sigma, error_px)
    with stage("pnp"):
        estimate = solve_pose(query, structure, matches, scale.world_from_query, options.pnp, priors)
    if isinstance(estimate, Rejection):
        return coarse.answer(estimate, support)
    posed = support.posed(estimate)
    if query.depths is not None:
        posed = checked(posed)
    # Depths that contradict the pose count always; what agrees only where the evidence does not suffice otherwise.
    by_depth = posed.estimate.depth_log10_chance
    agreement, chance = priors.log10_chance(estimate.world_from_camera) + by_depth, max(0.0, by_depth)
    failure = _gated(posed, coarse, chance)
    if failure and agreement != chance:
        failure, chance = _gated(posed, coarse, agreement), agreement
    if failure:
        return coarse.answer(Rejection(RejectionReason.GATE, failure), posed)
    if prepared.options.variant is Variant.BEST:
        with stage("adjust"):
            estimate = adjust_pose(AdjustInput.of(posed, options.adjust), estimate, priors)
    posed = support.posed(estimate)
    with stage("uncertainty"):
        predicted = not prepared.structure_options.optimize
        estimate = with_covariance(posed, scale, options.adjust, priors, predicted)
    posed = replace(posed, estimate=estimate)
    if still is not None and prepared.options.shutter is not None:
        with stage("shutter"):
            shutter = prepared.options.shutter
            posed = replace(posed, estimate=with_motion(posed, still, shutter, options.adjust, priors))
    return _judged(posed if query.depths is None else improved(posed), coarse, chance, agreement)


def _gated(support: PosedSupport, coarse: Coarse, log10_chance: float) -> str | None:
    """Says why chance, or what is fixed to the camera, could give the pose; None if they could not."""
    pipeline, inlier_px = coarse.prepared.pipeline, coarse.prepared.pipeline.options.pnp.inlier_px
    failure = gate_failure(support.query.camera, support.matches, support.estimate.inliers, inlier_px, log10_chance)
    return failure or unmoved_failure(support, inlier_px, pipeline.matcher.pairs.stationary, log10_chance)


def _judged(support: PosedSupport, coarse: Coarse, chance: float, agreement: float) -> Answer:
    """Accepts a pose or rejects it; `agreement` with directions counts if its evidence does not suffice otherwise."""
    prepared, options = coarse.prepared, coarse.prepared.pipeline.options.judge
    coverage, unit = prepared.options.coverage, prepared.unit
    with prepared.context.stage("judge"):
        judged = judge(support, coverage, options, chance, unit)
        is_gated = judged.rejection is not None and judged.rejection.reason is RejectionReason.GATE
        if is_gated and agreement != chance:
            judged = judge(support, coverage, options, agreement, unit)
    if judged.rejection:
        return coarse.answer(judged.rejection, support)
    estimate = with_halves(support.estimate, judged.evidence.disagreement * support.distance_m())
    checks = intrinsics_checks(estimate.intrinsics) if estimate.intrinsics else ()
    return coarse.answer(Localization.of(estimate, judged.trust, None, checks), support)


def _from_one_reference(coarse: Coarse, scale: MetricScale) -> Answer:
    """Estimates the pose from a single reference with depths."""
    (reference,), (matches,) = coarse.prepared.references, coarse.prepared.correspondences.query_matches
    depths = _depths_of_matches(coarse, scale, reference, matches)
    return _by_depths(coarse, [depths], scale.world_from_query, scale.source)


def _from_depths(coarse: Coarse) -> Answer:
    """Estimates the pose from matches whose keypoints have depths in the photograph, or in references."""
    prepared = coarse.prepared
    pairs = zip(prepared.references, prepared.correspondences.query_matches, strict=True)
    depths = [prepared.query.depths, *(it.depths for it in prepared.references)]
    is_measured = any(it is not None and it.source is DepthSource.MEASURED for it in depths)
    source = ScaleSource.DEPTH if is_measured else ScaleSource.NETWORK
    return _by_depths(coarse, [_stored_depths(*it) for it in pairs], None, source)


def _by_depths(
    coarse: Coarse, depths: Sequence[MatchedDepths], initial: RigidTransform | None, source: ScaleSource
) -> Answer:
    """Estimates the pose from matches with depths; priors are compared with it, but not used."""
    prepared, fixed = coarse.prepared, coarse.prepared.pipeline.matcher.pairs.stationary
    given = prepared.query, prepared.references, prepared.correspondences.query_matches
    with prepared.context.stage("pnp"):
        found = solve_by_depths(*given, depths, initial, prepared.origin, fixed)
    if isinstance(found, Rejection):
        return coarse.answer(found)
    estimate = found.support.estimate
    checks = prepared.priors.check(estimate.world_from_camera, estimate.covariance)
    estimate = replace(estimate, prior_checks=tuple(replace(it, used=False) for it in checks))
    support = replace(found.support, estimate=estimate)
    if prepared.query.depths is not None:
        support = contradicted(improved(support), found.excess)
    estimate = support.estimate
    trust = trust_of_score(found.score - estimate.depth_log10_chance)
    failure = one_reference_failure(found, trust, prepared.options.coverage) or one_reference_radius_failure(found)
    if failure:
        return coarse.answer(Rejection(RejectionReason.GATE, failure), support)
    if len(prepared.references) > 1:
        votes = Votes(found.carried_view, found.carried_keypoint, found.carried)
        with prepared.context.stage("judge"):
            rejection = contradiction(support, votes, prepared.unit, estimate.covariance)
        if rejection:
            return coarse.answer(rejection, support)
    estimate = _with_shutter(support, coarse)
    return coarse.answer(replace(Localization.of(estimate, trust), scale_source=source), support)


def _depths_of_matches(coarse: Coarse, scale: MetricScale, reference: PosedView, matches: Matches) -> MatchedDepths:
    """Depths of the matched keypoints of a single reference: its own, or those that the coarse stage predicts."""
    if scale.stage is ScaleStage.DEPTH:
        return _stored_depths(reference, matches)
    assert isinstance(coarse.reconstruction, Reconstruction)
    (predicted,), view = coarse.reconstruction.references, reference.view
    depth = scale.metres_per_unit * predicted.depth_at(view.features.pixels(matches[:, 1]), view.camera)
    return MatchedDepths(depth, None, scale.relative_sigma)


def _stored_depths(reference: PosedView, matches: Matches) -> MatchedDepths:
    """Depths of the matched keypoints of a reference that are stored with it; NaN without any."""
    if reference.depths is None or not np.isfinite(reference.depths.depth).any():
        return MatchedDepths(np.full(len(matches), np.nan), None, 0.0)
    depth, known = reference.depths.depth, np.isfinite(reference.depths.depth)
    sigma = float(np.median(reference.depths.relative_sigma[known]))
    return MatchedDepths(depth[matches[:, 1]].astype(np.float64), sigma, reference.depths.common_sigma)


def _from_lines(coarse: Coarse) -> Answer:
    """Estimates the pose from two-view and 2D-3D matches together; priors are compared with it, but not used.

    A pose that its evidence does not accept is no hypothesis: its matches agree with many others, too.
    """
    prepared, support = coarse.prepared, _two_view_support(coarse)
    if support is None:
        return coarse.answer(Rejection(RejectionReason.TOO_FEW_MATCHES, "no pose fits the epipolar lines of matches"))
    with prepared.context.stage("judge"):
        evidence = two_view_evidence(without_unmoved(support, prepared.pipeline.matcher.pairs.stationary))
        doubt, trust = two_view_failure(evidence), two_view_trust(evidence)
        is_doubted, covariance = trust < 1 - prepared.options.coverage, support.estimate.covariance
        rejection = (
            contradiction(support, votes_of(support), prepared.unit, covariance, is_doubted) if not doubt else None
        )
    if rejection:
        return coarse.answer(rejection, support)
    if doubt and lacks_distance(evidence):
        return coarse.answer(one_reference_rejection(doubt, support))
    if doubt or is_doubted:
        message = doubt or f"the trust of the pose from epipolar lines is {trust:.3f}"
        return coarse.answer(Rejection(RejectionReason.TOO_FEW_MATCHES, message))
    return coarse.answer(Localization.of(_with_shutter(support, coarse), trust, support.two_view), support)


def _with_shutter(support: PosedSupport, coarse: Coarse) -> PoseEstimate:
    """The estimate of a support, whose covariance contains what the motion during a read-out may do."""
    shutter = coarse.prepared.options.shutter
    if shutter is None:
        return support.estimate
    return without_motion(support, row_times(coarse.prepared.query, shutter), shutter)


def _two_view_support(coarse: Coarse) -> PosedSupport | None:
    """Finds a pose from two-view matches and wide correspondences."""
    prepared, options, scale = coarse.prepared, coarse.prepared.pipeline.options, coarse.scale
    if prepared.options.shutter is not None and isinstance(scale, MetricScale) and not scale.is_from_depth:
        still = _still(coarse, scale, *structure_and_matches(coarse, scale))
        prepared = replace(prepared, query=still.view)
    query, references, context = prepared.query, prepared.references, prepared.context
    with context.stage("two_view"):
        wide = wide_correspondences(prepared)
        stages = TwoViewOptions(prepared.structure_options, prepared.match_options, options.adjust)
        result = solve_two_view(query, references, wide, prepared.origin, stages, prepared.options.intrinsics)
    if result is None:
        return None
    checks = prepared.priors.check(result.estimate.world_from_camera, result.estimate.covariance)
    unused = tuple(replace(it, used=False) for it in checks)
    return replace(result, estimate=replace(result.estimate, prior_checks=unused))
