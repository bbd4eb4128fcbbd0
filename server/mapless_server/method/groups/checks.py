"""Checks of a group: mountings and units that single photographs contradict, and what helps after a rejection.

A rig has one pose whatever its mounting, and a sequence bends to any unit of length; both are answered with small
radii, because the photographs that fit agree well. The evidence against them is the photographs that do not fit any
more, and the length of the way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapless.geometry import RigidTransform

from ..answer import Answer, Localization
from ..hints import HintOptions
from ..rejection import Advice, Hint, Rejection, RejectionReason
from ..views import PosedView
from .rig import RigEstimate
from .sequence import SequenceEstimate

SURE_INLIERS = 30
"""A photograph with so many alone knows where it is."""

KEPT_SHARE = 0.25
"""Of these, a rig that is mounted as it says keeps nearly all; one whose mounts are wrong next to none."""

UNIT_TOLERANCE = 1.25
"""Drift makes a way longer or shorter by some per cent; wrong units are feet, centimetres, or a scale never found."""

SIGNIFICANT_SIGMAS = 4.0
"""By which the way's length has to miss the session's."""


def check_mounting(estimate: RigEstimate, alone: Sequence[Answer]) -> RigEstimate | Rejection:
    """The estimate, unless photographs that know where they are contradict it.

    Args:
        estimate: of the rig.
        alone: each photograph's own answer.

    Returns:
        Else GATE, with the numbers of the photographs.
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


def check_unit(
    estimate: SequenceEstimate, session_from_camera: Sequence[RigidTransform]
) -> SequenceEstimate | Rejection:
    """The estimate of a session that is said to be metric, unless the photographs' way is of another length.

    Returns:
        Else SCALE_UNRELIABLE, with the unit that the photographs say.
    """
    way_m = _length(estimate.world_from_camera)
    said_m = _length(session_from_camera)
    # A step is as uncertain as its ends; ends that two steps share count twice, which errs to the safe side.
    variances = np.trace(estimate.covariances[:, :3, :3], axis1=1, axis2=2)
    sigma_m = math.sqrt(float((variances[1:] + variances[:-1]).sum()))
    if abs(way_m - said_m) <= SIGNIFICANT_SIGMAS * sigma_m or said_m * way_m == 0:
        return estimate
    unit_m = way_m / said_m
    if 1 / UNIT_TOLERANCE <= unit_m <= UNIT_TOLERANCE:
        return estimate
    message = (
        f"the session's way is {said_m:.2f} long, that of the photographs {way_m:.2f} m: its unit is {unit_m:.2f} m, "
        "and not a metre as it was said to be"
    )
    advice = "Ask for the session's scale (estimate_session_scale), or send its poses in metres."
    return Rejection(RejectionReason.SCALE_UNRELIABLE, message, Hint(STAGE, Advice.CHECK_CALIBRATION, advice))


def _length(poses: Sequence[RigidTransform]) -> float:
    """Of the way along the poses' places."""
    places = np.array([pose.translation for pose in poses])
    return float(np.linalg.norm(np.diff(places, axis=0), axis=1).sum())


STAGE = "join"
"""In which photographs are posed together."""


def hinted_group(
    rejection: Rejection, images: Sequence[tuple[Answer, Sequence[PosedView]]], options: HintOptions | None = None
) -> Rejection:
    """The rejection of a group, with a hint if it has none yet.

    Args:
        rejection: of all together.
        images: each photograph's own answer, and the references that were used, in the order of its counts.
        options: of the hints.
    """
    if rejection.hint is not None:
        return rejection
    matches, best = _best(images)
    advice, message = _advice(rejection.reason, matches, len(images), options or HintOptions())
    return replace(rejection, hint=Hint(STAGE, advice, message, best))


def _best(images: Sequence[tuple[Answer, Sequence[PosedView]]]) -> tuple[int, str | None]:
    """The most matches that a reference has with any of the photographs, and its name; None if none has any."""
    counted = [
        (count, reference.name)
        for answer, references in images
        for count, reference in zip(answer.reference_match_counts, references, strict=False)
    ]
    count, name = max(counted, key=lambda it: it[0], default=(0, None))
    return count, name if count else None


def _advice(reason: RejectionReason, matches: int, image_count: int, options: HintOptions) -> tuple[Advice, str]:
    shared = f"the best reference shares {matches} features with one of the {image_count} photographs"
    if reason is RejectionReason.SCALE_UNRELIABLE:
        return (
            Advice.RETAKE_PHOTOGRAPH,
            "Take the photographs from further apart, so that the session's motion tells its unit; or say that the "
            "session is metric, if it is.",
        )
    if matches < options.few_matches:
        return (
            Advice.CHOOSE_OTHER_REFERENCES,
            f"Use references that show what the photographs show: {shared}, as chance does for another place.",
        )
    if matches >= options.many_matches:
        return (
            Advice.CHECK_CALIBRATION,
            "Check the photographs' intrinsics, the poses of the cameras to one another, and the references' poses: "
            f"{shared}, but all together agree on no pose.",
        )
    return (
        Advice.LOOK_AT_REFERENCE,
        f"Point a camera at what the best reference shows, or add references from nearer: {shared}.",
    )
