"""What to do about the rejection of several photographs that were to be posed together.

As in `hints`, it is read off the numbers: how many features the photographs share with their references. What is in
doubt here besides is how the photographs stand to one another: a rig's mounting, a session's poses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from ..answer import Answer
from ..hints import HintOptions
from ..rejection import Advice, Hint, Rejection, RejectionReason
from ..views import PosedView

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
