"""Checks of a group: whether its photographs contradict a rig's mounting or a session's unit; and its hints.

A wrong mounting or unit still gives a pose with small radii, because the photographs that fit agree well. The evidence
against it is the inliers that other photographs lose, and the length of the path.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from mapless.geometry import Array, RigidTransform

from ..bundle.priors import conflict_threshold
from ..features.views import PosedView
from ..judge.answer import Answer, Localization
from ..judge.cameras import MANY_MATCHES
from ..judge.hints import FEW_MATCHES
from ..pairs.readings.conventions import CONVENTIONS, Convention
from ..pairs.readings.explanation import MOST_NAMED
from ..rejection import Advice, Hint, Rejection, RejectionReason
from .jumps import ALL_JUMPS, OTHER_UNIT, find_jumps
from .rig import RigEstimate
from .sequence import SequenceEstimate
from .start import CHECK_TRACKING, STAGE

SURE_INLIERS = 30
"""The pose of a photograph with so many inliers alone is reliable."""

KEPT_SHARE = 0.25
"""Least share of these inliers that the rig's pose keeps; with the right mounting it keeps nearly all."""

_FIRST = 4
"""So many photographs contradict most readings; the others are compared with the rest only."""

SIGNIFICANT_SIGMAS = 4.0
"""Least difference of the path's lengths, in standard deviations."""


def check_mounting(estimate: RigEstimate, alone: Sequence[Answer]) -> RigEstimate | Rejection:
    """Checks a rig's pose against the poses of the photographs that are localized reliably alone.

    Returns a rejection GATE with the numbers of the photographs, if one of these loses its inliers.
    """
    kept = {it.source.image: int(it.inliers.sum()) for it in estimate.matched}
    sure = {
        image: answer.outcome.inlier_count
        for image, answer in enumerate(alone)
        if isinstance(answer.outcome, Localization) and answer.outcome.inlier_count >= SURE_INLIERS
    }
    against = [image for image, count in sure.items() if kept.get(image, 0) < KEPT_SHARE * count]
    if not against:
        return estimate
    counts = ", ".join(f"{kept.get(image, 0)} of {sure[image]} in images[{image}]" for image in against)
    message = f"the joint pose keeps too few of the inliers that photographs have alone: {counts}"
    advice = "Check rig_from_camera of these images, and that all were taken at one moment."
    return Rejection(RejectionReason.GATE, message, Hint(STAGE, Advice.CHECK_CALIBRATION, advice))


def check_tracking(
    estimate: SequenceEstimate, session_from_camera: Sequence[RigidTransform], unit: str = "m"
) -> SequenceEstimate | Rejection:
    """Checks that the session agrees with the photographs somewhere; `unit` is the scene's, in messages.

    It does not in wrong axes, inverse, or in a unit that is wrong by far. Returns a rejection GATE if all of
    `ALL_JUMPS` steps or more are jumps; or two or more, none of which is one if the session's poses are read
    otherwise: the message then says how.
    """
    poses, count = estimate.world_from_camera, len(estimate.jumps)
    # A single step of a device that has jumped may agree with another reading of its poses by chance.
    readings = _fitting_readings(estimate, session_from_camera) if count >= 2 else []
    if count < max(len(poses) - 1, ALL_JUMPS) and not readings:
        return estimate
    tracked, shown_m = (sum(_distance(*ends) for ends in pairwise(it)) for it in (session_from_camera, poses))
    pairs = f"all {len(poses)}" if count == len(poses) - 1 else f"{count} pairs"
    message = (
        f"the tracked poses contradict the photographs between {pairs} of them: the session's path is "
        f"{tracked:.2f} long, that of the photographs {shown_m:.2f} {unit}"
    )
    if readings:
        texts = [it.text.replace("world", "session") for it in readings]
        likely = "; or ".join(texts) if len(texts) <= MOST_NAMED else "they are in other axes"
        message += f"; likely: {likely}: read so, they agree with all photographs"
    return Rejection(RejectionReason.GATE, message, CHECK_TRACKING)


def _fitting_readings(estimate: SequenceEstimate, session: Sequence[RigidTransform]) -> list[Convention]:
    """How the session's poses may be meant: the conventions that make them agree with all photographs.

    Of those that agree as well as the best one, the most common.
    """
    own = dict(enumerate(zip(estimate.world_from_camera, estimate.covariances, strict=True)))
    few = {i: own[i] for i in range(min(_FIRST, len(own)))}
    fitting = []
    for convention in CONVENTIONS:
        read = [convention.correct(it) for it in session]
        if math.isfinite(_agreement(few, read)) and math.isfinite(cost := _agreement(own, read)):
            fitting.append((cost, convention))
    limit = min((cost for cost, _ in fitting), default=0.0) + conflict_threshold(6)
    equal = [convention for cost, convention in fitting if cost <= limit]
    return [it for it in equal if it.rarity == min(other.rarity for other in equal)]


def _agreement(own: Mapping[int, tuple[RigidTransform, Array]], session: Sequence[RigidTransform]) -> float:
    """The cost of a session that agrees with photographs, see `find_jumps`; infinite if one of them contradicts it."""
    chain = find_jumps(own, session, 1.0)
    return chain.cost if chain and not chain.jumps and len(chain.frames) == len(own) else math.inf


def check_unit(
    estimate: SequenceEstimate, session_from_camera: Sequence[RigidTransform], unit: str = "m"
) -> SequenceEstimate | Rejection:
    """Checks the unit of a session that is said to be the scene's, by the length of the path without jumps.

    Returns a rejection SCALE_UNRELIABLE with the estimated unit, if the two lengths differ significantly.
    """
    poses = estimate.world_from_camera
    at_jump = {step for jump in estimate.jumps for step in range(jump.before, jump.after)}
    steps = [(i, i + 1) for i in range(len(poses) - 1) if i not in at_jump]
    path_m = sum(_distance(poses[i], poses[j]) for i, j in steps)
    tracked_m = sum(_distance(session_from_camera[i], session_from_camera[j]) for i, j in steps)
    # The variance of a step is the sum of its ends'; an end that two steps share counts twice, which is conservative.
    variances = np.trace(estimate.covariances[:, :3, :3], axis1=1, axis2=2)
    sigma_m = math.sqrt(sum(float(variances[i] + variances[j]) for i, j in steps))
    if abs(path_m - tracked_m) <= SIGNIFICANT_SIGMAS * sigma_m or tracked_m * path_m == 0:
        return estimate
    unit_m = path_m / tracked_m
    if 1 / OTHER_UNIT <= unit_m <= OTHER_UNIT:
        return estimate
    message = (
        f"the session's path is {tracked_m:.2f} long, that of the photographs {path_m:.2f} {unit}: its unit is "
        f"{unit_m:.2f} {unit} instead of 1 {unit}, as the request says"
    )
    advice = "Ask for the session's scale (estimate_session_scale), or send its poses in the scene's unit of length."
    return Rejection(RejectionReason.SCALE_UNRELIABLE, message, Hint(STAGE, Advice.CHECK_CALIBRATION, advice))


def _distance(first: RigidTransform, second: RigidTransform) -> float:
    return math.dist(first.translation, second.translation)


def hinted_group(
    rejection: Rejection, images: Sequence[tuple[Answer, Sequence[PosedView]]], *, is_sequence: bool = False
) -> Rejection:
    """Adds a hint to the rejection of a rig or a sequence, if it has none yet.

    Each image has its own answer, and the references that were used, in the order of its counts.
    """
    if rejection.hint is not None:
        return rejection
    counted = [
        (count, reference.name if count else None)
        for answer, references in images
        for count, reference in zip(answer.reference_match_counts, references, strict=False)
    ]
    matches, best = max(counted, key=lambda it: it[0], default=(0, None))
    alone = sum(isinstance(answer.outcome, Localization) for answer, _ in images)
    # Intrinsics and references are right where photographs are localized alone.
    if is_sequence and alone > 1 and rejection.reason in (RejectionReason.PNP_FAILED, RejectionReason.GATE):
        return replace(rejection, hint=replace(CHECK_TRACKING, best_reference=best))
    advice, message = _advice(rejection.reason, matches, len(images))
    return replace(rejection, hint=Hint(STAGE, advice, message, best))


def _advice(reason: RejectionReason, matches: int, image_count: int) -> tuple[Advice, str]:
    shared = f"the best reference shares {matches} features with one of the {image_count} photographs"
    if reason is RejectionReason.SCALE_UNRELIABLE:
        return (
            Advice.RETAKE_PHOTOGRAPH,
            "Take the photographs from further apart, so that the session's motion determines its unit; or say that "
            "the session is metric, if it is.",
        )
    if matches < FEW_MATCHES:
        return (
            Advice.CHOOSE_OTHER_REFERENCES,
            f"Use references that show what the photographs show: {shared}, no more than chance gives.",
        )
    if matches >= MANY_MATCHES:
        return (
            Advice.CHECK_CALIBRATION,
            "Check the poses of the cameras to one another, that all photographs were taken at one moment, and the "
            f"references' poses: {shared}, but all together agree on no pose.",
        )
    return (
        Advice.LOOK_AT_REFERENCE,
        f"Point a camera at what the best reference shows, or add references from nearer: {shared}.",
    )
