"""Poses for queries where `localize` has no points: one reference, or references that share too little."""

from dataclasses import replace

from .bundle.estimate import Support
from .features.views import Reconstruction
from .judge.answer import Answer, Localization
from .judge.evidence import votes_of
from .judge.judge import contradiction
from .judge.one_reference import one_reference_failure, trust_of_score
from .judge.two_view import (
    lacks_distance,
    one_reference_rejection,
    two_view_evidence,
    two_view_failure,
    two_view_trust,
    without_unmoved,
)
from .pairs.pair import Matching
from .pipeline import Coarse
from .pose.one_reference import solve_one_reference
from .pose.two_view import solve_two_view
from .rejection import Rejection, RejectionReason
from .structure.model import MetricScale


def from_one_reference(coarse: Coarse, scale: MetricScale) -> Answer:
    """Estimates the pose from a single reference with a network's depths; priors are compared with it, but not used."""
    prepared, options = coarse.prepared, coarse.prepared.pipeline.options
    assert isinstance(coarse.reconstruction, Reconstruction)
    given = prepared.query, prepared.references, coarse.reconstruction, scale, prepared.correspondences.query_matches
    with prepared.context.stage("pnp"):
        fixed = prepared.pipeline.matcher.stationary
        found = solve_one_reference(*given, prepared.origin, options.one_reference, fixed)
    if isinstance(found, Rejection):
        return coarse.answer(found)
    estimate = found.support.estimate
    assert estimate is not None
    checks = prepared.priors.check(estimate.world_from_camera, estimate.covariance)
    estimate = replace(estimate, prior_checks=tuple(replace(it, used=False) for it in checks))
    support = replace(found.support, estimate=estimate)
    trust = trust_of_score(found.score)
    failure = one_reference_failure(found, trust, prepared.options.coverage)
    if failure:
        return coarse.answer(Rejection(RejectionReason.GATE, failure), support)
    return coarse.answer(replace(Localization.of(estimate, trust), scale_source=scale.source), support)


def or_from_two_views(coarse: Coarse, answer: Answer) -> Answer:
    """Estimates the pose from two-view and 2D-3D matches together, where that can help; else returns the answer."""
    if not coarse.prepared.can_use_two_views(answer):
        return answer
    support = _two_view_support(coarse, answer.support)
    answer = replace(answer, stage_seconds=dict(coarse.prepared.context.stage_seconds))
    if support is None or support.estimate is None:
        return answer
    prepared, options = coarse.prepared, coarse.prepared.pipeline.options
    query_matches, estimate = prepared.correspondences.query_matches, support.estimate
    with prepared.context.stage("judge"):
        moved = without_unmoved(support, query_matches, prepared.pipeline.matcher.stationary)
        evidence = two_view_evidence(moved, query_matches)
        doubt, trust = two_view_failure(evidence), two_view_trust(evidence)
        votes = votes_of(support, query_matches)
        rejection = None if doubt else contradiction(support, votes, options.judge, unit=prepared.unit)
    if rejection:
        return coarse.answer(rejection, support)
    if doubt and lacks_distance(evidence):
        assert isinstance(answer.outcome, Rejection)
        return replace(answer, outcome=one_reference_rejection(answer.outcome.reason, doubt, support))
    if doubt or trust < 1 - prepared.options.coverage:
        return answer
    return coarse.answer(Localization.of(estimate, trust, support.two_view), support)


def _two_view_support(coarse: Coarse, found: Support | None) -> Support | None:
    """Finds a pose from two-view matches and wide correspondences; a pose found before is one of the candidates."""
    prepared, options = coarse.prepared, coarse.prepared.pipeline.options
    query, references, context = prepared.query, prepared.references, prepared.context
    query_matches, matcher = prepared.correspondences.query_matches, prepared.pipeline.matcher
    known = [found.estimate.world_from_camera] if found and found.estimate else []
    with context.stage("two_view"):
        in_world = prepared.references_in_world
        wide = matcher.correspond(query, in_world, Matching.WIDE, context.check, query_matches)
        stages = prepared.structure_options, prepared.match_options, options.adjust, prepared.options.intrinsics
        result = solve_two_view(query, references, wide, known, prepared.origin, *stages)
    if result is None or result.estimate is None:
        return None
    checks = prepared.priors.check(result.estimate.world_from_camera, result.estimate.covariance)
    unused = tuple(replace(it, used=False) for it in checks)
    return replace(result, estimate=replace(result.estimate, prior_checks=unused))
