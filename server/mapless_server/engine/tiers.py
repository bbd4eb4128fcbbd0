"""Decides when a query is tried with stronger features, and which of two answers is better.

Cheap features suffice for nearly every query. Stronger ones often find enough matches where these do not, at many times
the cost; so a tier is tried only if the previous tier's answer is a rejection that better matches could change, or a
pose with little support.
"""

import math
from dataclasses import replace

import numpy as np

from mapless.geometry import RigidTransform, rotation_angle_deg
from mapless_server.method.bundle.priors import Priors
from mapless_server.method.bundle.radii import Accuracy, accuracy_from_covariance
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.rejection import Advice, Hint, Hypothesis, Rejection, RejectionReason

from .options import EscalationOptions
from .query import QueryRun, Result, Tier

UNRECOVERABLE = frozenset({RejectionReason.NO_USABLE_REFERENCES, RejectionReason.DEGENERATE_REFERENCES})
"""Rejections because of the references themselves, which no features change."""

SAME_POSITION_M, SAME_ROTATION_DEG = 0.1, 2.0
"""Two poses closer than this never contradict each other, however small the claimed radii, which leave out the errors
of the references' poses."""

SAME_SHARE = 0.05
"""A pose that was rejected contradicts one at more than this share of the distance from what the photograph shows: that
is as far as a right pose may be off. Of 12 right poses of ALIKED with LightGlue two were further from a rejected one of
EdgePoint2, with over twice its inliers; of nine wrong ones all were, seven of them with less than 1.5 times its
inliers."""

CLEARLY_MORE = 1.5
"""If two poses contradict each other, that of the stronger features is accepted if it has this many times the inliers
of the other; so is one that contradicts a rejected pose where the soft priors are. Priors do not decide for a place if
another one has this many times its inliers."""


def is_doubtful(answer: Answer, options: EscalationOptions) -> bool:
    """Whether stronger features could improve the answer.

    They cannot if the intrinsics are wrong: other features do not correct them, but may determine them too little to
    detect it. A pose that nothing has checked (`Variant.COARSE`) has no trust and claims nothing, so there is
    nothing to doubt.
    """
    outcome = answer.outcome
    if isinstance(outcome, Rejection):
        return outcome.reason not in UNRECOVERABLE and not outcome.intrinsics_checks
    if outcome.covariance is None or outcome.trust is None:
        return False
    radius_m = accuracy_from_covariance(outcome.covariance).position_68_m
    return outcome.trust < options.doubtful_trust or not radius_m <= options.doubtful_radius_m


def may_be_turned(answer: Answer, options: EscalationOptions) -> bool:
    """Whether the photograph may show more turned: not if it fits two places, or is where no prior allows it.

    Of a facade that looks alike upside down, the little that matches of a turned photograph gives a pose of little
    trust, far from the right one. A large radius alone is no sign of that.
    """
    outcome = answer.outcome
    if isinstance(outcome, Localization):
        return outcome.trust is not None and outcome.trust < options.doubtful_trust
    found = RejectionReason.AMBIGUOUS, RejectionReason.PRIOR_CONFLICT
    return outcome.reason not in found and is_doubtful(answer, options)


def shows_no_more(best: Result, turned: Result) -> bool:
    """Whether a photograph was not localized turned either, and no more of it agrees with a pose than as it is."""
    return isinstance(turned.answer.outcome, Rejection) and inlier_count(turned) <= inlier_count(best)


def with_untried(run: QueryRun, answer: Answer, tier: Tier) -> Answer:
    """Adds to a rejection's hint what was not tried: its advice alone would send elsewhere whom a repeat would help."""
    outcome = answer.outcome
    if not isinstance(outcome, Rejection):
        return answer
    assert outcome.hint is not None  # `_result` adds it
    untried = f"with {tier.features.partition('-')[0]} features"
    if run.tries_turns:
        untried = "turned by 90, 180 and 270 degrees"
    elif run.narrowed is not None:
        untried = "with references of the whole scene"
    elif run.ambiguous is not None:
        untried = "with references of one of the places"
    advice = f"{outcome.hint.message} Trying it {untried} was not finished: asking again, when less is asked, may help."
    return replace(answer, outcome=replace(outcome, hint=replace(outcome.hint, message=advice)))


def better_of(cheaper: Result, stronger: Result) -> Result:
    """The better of a doubtful result and one with stronger features.

    A localization is better than a rejection, and of two rejections that of the stronger features says more. Of two
    poses that agree, within the sum of their 95 % radii or what the options let pass, the one with the smaller claimed
    radius is better. Of two that contradict each other at least one is wrong, and the cheaper features' was doubtful:
    that of the stronger ones is answered if it has clearly more inliers, and neither otherwise. A pose that was
    rejected for lack of evidence, or beside a second one, is evidence, too: it contradicts a pose that is too far from
    it.
    """
    first, second = cheaper.answer.outcome, stronger.answer.outcome
    if isinstance(second, Rejection):
        return stronger if isinstance(first, Rejection) else cheaper
    if isinstance(first, Rejection):
        other = _rejected_pose(cheaper.answer)
        if other is None or stronger.answer.support is None:
            return stronger
        pose, inlier_count, radius_m = other
        reach_m, reach_deg = max(radius_m, SAME_SHARE * stronger.answer.support.distance_m()), math.inf
    else:
        pose, inlier_count = first.world_from_camera, first.inlier_count
        claims = _claim(first), _claim(second)
        # Halves of the data that disagree are no reason to take two poses for one.
        known = [_without_halves(it.answer, claim) for it, claim in zip((cheaper, stronger), claims, strict=True)]
        reach_m = max(SAME_POSITION_M, sum(it.position_95_m for it in known))
        reach_deg = max(SAME_ROTATION_DEG, sum(it.rotation_95_deg for it in known))
    apart_m = float(np.linalg.norm(second.world_from_camera.translation - pose.translation))
    apart_deg = rotation_angle_deg(pose.rotation.T @ second.world_from_camera.rotation)
    if apart_m <= reach_m and apart_deg <= reach_deg:
        is_first_better = isinstance(first, Localization) and claims[0].position_68_m < claims[1].position_68_m
        return cheaper if is_first_better else stronger
    if second.inlier_count >= CLEARLY_MORE * inlier_count:
        return stronger
    poses = (
        f"the features disagree: the pose of {cheaper.tier.features} ({inlier_count} inliers) and that of "
        f"{stronger.tier.features} ({second.inlier_count})"
    )
    if cheaper.tier is stronger.tier:
        poses = (
            f"the photograph fits two places: the pose as it is ({inlier_count} inliers) and that of the photograph "
            f"turned ({second.inlier_count})"
        )
    message = f"{poses} are {apart_m:.2f} {stronger.attributes.unit} and {apart_deg:.1f} degrees apart"
    rejection = Rejection(RejectionReason.GATE, message, _places_apart(stronger))
    return replace(stronger, answer=replace(stronger.answer, outcome=rejection))


def of_two_places(narrowed: Result, elsewhere: Result) -> Result:
    """The result of references where the soft priors say the camera is, or that of references elsewhere.

    Localized at both, the priors decide, unless the photograph has clearly more inliers elsewhere: then neither is
    answered. Localized elsewhere alone, the priors are wrong, unless a pose that was rejected where they say has about
    as many inliers. Of two rejections, the one with more inliers says more.
    """
    first, second = narrowed.answer.outcome, elsewhere.answer.outcome
    if isinstance(second, Rejection):
        is_better = isinstance(first, Rejection) and inlier_count(elsewhere) > inlier_count(narrowed)
        return elsewhere if is_better else narrowed
    if isinstance(first, Rejection):
        other = _rejected_pose(narrowed.answer)
        if other is None or second.inlier_count >= CLEARLY_MORE * other[1]:
            return elsewhere
        return elsewhere if _apart_m(other[0], second) <= max(other[2], _same_m(elsewhere)) else narrowed
    apart_m = _apart_m(first.world_from_camera, second)
    apart_deg = rotation_angle_deg(first.world_from_camera.rotation.T @ second.world_from_camera.rotation)
    same_deg = max(SAME_ROTATION_DEG, sum(_claim(it).rotation_95_deg for it in (first, second)))
    is_same = apart_m <= _same_m(elsewhere) and apart_deg <= same_deg
    if is_same or second.inlier_count < CLEARLY_MORE * first.inlier_count:
        return narrowed
    poses = [
        Hypothesis(it.world_from_camera, it.inlier_count, tuple(used.name for used in of.references))
        for it, of in ((second, elsewhere), (first, narrowed))
    ]
    message = (
        f"two poses {apart_m:.2f} {elsewhere.attributes.unit} and {apart_deg:.0f} degrees apart explain the "
        f"photograph: the one where the prior says with {first.inlier_count} inliers, the other with "
        f"{second.inlier_count}"
    )
    hint = Hint("judge", Advice.CHECK_PRIOR, "Check the prior: references elsewhere show more of the photograph.", None)
    rejection = Rejection(RejectionReason.AMBIGUOUS, message, hint, hypotheses=(poses[0], poses[1]))
    return replace(elsewhere, answer=replace(elsewhere.answer, outcome=rejection))


def place_of_priors(outcome: Rejection, priors: Priors) -> Hypothesis | Hint | None:
    """Which of the two places that explain a photograph is the one of its priors, or a hint why they do not decide.

    They decide if all of them agree with one hypothesis and one is in conflict with the other, unless the other has
    clearly more inliers. None without priors or two places.
    """
    if len(outcome.hypotheses) != 2 or outcome.hint is not None or not priors:
        return None
    # Hypotheses are not adjusted: they are known as well as poses of one place agree, at two standard deviations.
    sigmas = [SAME_POSITION_M / 2] * 3 + [math.radians(SAME_ROTATION_DEG) / 2] * 3
    covariance = np.diag(np.square(sigmas))
    checks = [priors.check(it.world_from_camera, covariance) for it in outcome.hypotheses]
    excluded = [any(check.conflict for check in of_one) for of_one in checks]
    best = next(iter(outcome.hypotheses[0].references), None)
    if all(excluded):
        message = "Check the prior: it fits neither of the two places."
        return Hint("judge", Advice.CHECK_PRIOR, message, best)
    if not any(excluded):
        message = (
            "Take a photograph that shows where the two places differ, or give a prior with smaller standard "
            "deviations: the one given fits both; if there is one place only, check the references' poses."
        )
        return Hint("judge", Advice.TELL_PLACES_APART, message, best)
    place, other = outcome.hypotheses[:: -1 if excluded[0] else 1]
    if not all(check.is_likely for check in checks[excluded.index(False)]):
        return Hint("judge", Advice.CHECK_PRIOR, "Check the prior: it fits neither of the two places well.", best)
    if other.inlier_count >= CLEARLY_MORE * place.inlier_count:
        message = "Check the prior: the photograph shows more of the other place."
        return Hint("judge", Advice.CHECK_PRIOR, message, best)
    return place


def inlier_count(result: Result) -> int:
    """Inliers of the pose that was estimated, also of one that was rejected; 0 if there is none."""
    support = result.answer.support
    return 0 if support is None or support.estimate is None else support.inlier_count()


def _apart_m(pose: RigidTransform, localization: Localization) -> float:
    return float(np.linalg.norm(localization.world_from_camera.translation - pose.translation))


def _same_m(result: Result) -> float:
    support = result.answer.support
    share_m = 0.0 if support is None else SAME_SHARE * support.distance_m()
    return max(SAME_POSITION_M, share_m)


def _rejected_pose(answer: Answer) -> tuple[RigidTransform, int, float] | None:
    """The pose that was found and rejected by its evidence, its number of inliers and 95 % radius; None for no pose."""
    outcome, support = answer.outcome, answer.support
    judged = isinstance(outcome, Rejection) and outcome.reason in (RejectionReason.GATE, RejectionReason.AMBIGUOUS)
    if not judged or support is None or support.estimate is None:
        return None
    radius_m = accuracy_from_covariance(support.estimate.covariance).position_95_m
    return support.estimate.world_from_camera.shifted(support.origin), support.inlier_count(), radius_m


def _places_apart(result: Result) -> Hint:
    """The hint for two searches, with other features or of the photograph turned, that find two places."""
    matches = result.answer.reference_match_counts
    best = result.references[int(np.argmax(matches))].name if result.references and any(matches) else None
    message = (
        "Say where the camera is, or take a photograph that shows more of what the references show: two searches find "
        "two places."
    )
    return Hint("judge", Advice.TELL_PLACES_APART, message, best)


def _without_halves(answer: Answer, claim: Accuracy) -> Accuracy:
    """The radii of an answer that claims these, by the jackknife alone, before halves of the data changed them."""
    if answer.support is None or answer.support.estimate is None:
        return claim
    return accuracy_from_covariance(answer.support.estimate.covariance)


def _claim(localization: Localization) -> Accuracy:
    """The radii that the answer claims; infinite without a covariance."""
    if localization.covariance is None:
        return Accuracy(math.inf, math.inf, math.inf, math.inf)
    return accuracy_from_covariance(localization.covariance)
