"""Whether the references that a pose rests on agree with their own poses, by matches that these took no part in.

It is evidence about the references, not about the pose: where they do not agree, no pose that rests on them is right,
however many matches it explains.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

from ..bundle.estimate import PosedSupport
from ..features.views import ReferenceErrors
from ..pairs.agreement import MAX_ERROR_PX
from ..rejection import Advice, Hint, Rejection, RejectionReason

MIN_SHARE, MIN_INLIERS = 0.1, 6
"""Inliers of a reference that a pose rests on: as a share of those of the reference with the most, and in all."""

MOST_REFERENCES = 5
"""Those with the most inliers are compared: ten pairs."""


@dataclass(frozen=True)
class Supporters:
    """The references that support a pose.

    Attributes:
        names: their names.
        inlier_counts: for each, inliers of the pose that rest on it.
        error_px: returns the error of a pair of them; None if they were not matched with one another.
    """

    names: Sequence[str]
    inlier_counts: Sequence[int]
    error_px: ReferenceErrors | None


def supporters_of(support: PosedSupport) -> Supporters:
    """The references that support the estimate of a support."""
    names = [reference.name for reference in support.references]
    return Supporters(names, support.inliers_by_reference(), support.reference_error_px)


def disagreeing_references(photographs: Iterable[Supporters]) -> Rejection | None:
    """Rejects a pose, of one photograph or of several together, whose supporting references mostly do not agree."""
    errors_px: list[float] = []
    best: tuple[int, str] = (0, "")
    for photograph in photographs:
        counts = photograph.inlier_counts
        if photograph.error_px is None or not counts:
            continue
        used = _most_supporting(counts)
        if used:
            best = max(best, (counts[used[0]], photograph.names[used[0]]))
        found = (photograph.error_px(*sorted(pair)) for pair in combinations(used, 2))
        errors_px += [it for it in found if it is not None]
    agreeing = sum(it <= MAX_ERROR_PX for it in errors_px)
    if not errors_px or 2 * agreeing >= len(errors_px):
        return None
    message = (
        f"of {len(errors_px)} pairs of references that the pose rests on, {agreeing} agree with their own poses: what "
        f"they show in common is {sorted(errors_px)[len(errors_px) // 2]:.0f} px off, in the median (of an image of "
        f"1024 pixels, at most {MAX_ERROR_PX:g})"
    )
    return Rejection(
        RejectionReason.GATE, message, Hint("judge", Advice.CHECK_REFERENCE_POSES, ADVICE, best[1] or None)
    )


def _most_supporting(counts: Sequence[int]) -> list[int]:
    """Indices of the references that a pose rests on, at most `MOST_REFERENCES`, those with the most inliers first."""
    least = max(MIN_INLIERS, MIN_SHARE * max(counts, default=0))
    return sorted((i for i, count in enumerate(counts) if count >= least), key=lambda i: -counts[i])[:MOST_REFERENCES]


def without_agreement(photographs: Sequence[Supporters]) -> Rejection | None:
    """Rejects a pose in a scene that contradicts itself unless two references that support it agree.

    The pose is that of one photograph, or of several together. Elsewhere references of which nothing is known are taken
    to have right poses.
    """
    best: tuple[int, str] = (0, "")
    for photograph in photographs:
        counts, error_px = photograph.inlier_counts, photograph.error_px
        used = _most_supporting(counts)
        found = [] if error_px is None else [error_px(*sorted(pair)) for pair in combinations(used, 2)]
        if any(it is not None and it <= MAX_ERROR_PX for it in found):
            return None
        best = max([best, *zip(counts, photograph.names, strict=True)])
    message = "no two of the references that the pose rests on agree with their own poses"
    return Rejection(
        RejectionReason.GATE, message, Hint("judge", Advice.CHECK_REFERENCE_POSES, ADVICE, best[1] or None)
    )


ADVICE = (
    "Check the references' poses, not the photograph: world_from_camera (not its inverse) with OpenCV's axes (x right, "
    "y down, z forward), all in one world; `mapless-server audit` compares all of a scene."
)
"""The hint beside CHECK_REFERENCE_POSES."""


def with_contradiction(rejection: Rejection, contradiction: str) -> Rejection:
    """The rejection of a photograph in a scene that contradicts itself: that is said, and no advice of other causes."""
    if not contradiction:
        return rejection
    hint = rejection.hint
    stage, best = ("", None) if hint is None else (hint.stage, hint.best_reference)
    advice = Hint(stage, Advice.CHECK_REFERENCE_POSES, ADVICE, best)
    # The message of a group's rejection may be that of one of its photographs.
    is_said = contradiction in rejection.message
    message = rejection.message if is_said else f"{rejection.message}; {contradiction}"
    return Rejection(rejection.reason, message, advice, rejection.hypotheses, rejection.tried)
