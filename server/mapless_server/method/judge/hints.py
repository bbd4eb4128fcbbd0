"""Hints: what would help after a rejection, by its numbers of features, of matches with each reference, of inliers.

Where much is shared and little agrees, the photograph's camera is compared with others (`cameras`), and named if that
is significant; nothing else is said of intrinsics.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..bundle.estimate import PosedSupport
from ..features.views import PosedView, View
from ..rejection import Advice, Hint, Rejection, RejectionReason
from .answer import Answer
from .cameras import MANY_MATCHES, compare_cameras

_STAGES = {
    RejectionReason.NO_USABLE_REFERENCES: "coarse",
    RejectionReason.DEGENERATE_REFERENCES: "coarse",
    RejectionReason.LOW_TEXTURE: "",
    RejectionReason.LOW_OVERLAP: "coarse",
    RejectionReason.SCALE_UNRELIABLE: "scale",
    RejectionReason.TOO_FEW_MATCHES: "match",
    RejectionReason.PNP_FAILED: "pnp",
}
"""The stages that reject for these reasons; for the others it is the judge."""

_OF_MATCHES = (
    RejectionReason.LOW_OVERLAP,
    RejectionReason.TOO_FEW_MATCHES,
    RejectionReason.PNP_FAILED,
    RejectionReason.GATE,
)
"""Reasons for which too few matches agree."""

FEW_FEATURES = 200
"""A photograph with fewer is dark, blurred or shows nothing; sharp ones have 500 to 2048."""

FEW_MATCHES = 30
"""References of another place have fewer matches with a photograph by chance."""

LEAST_USUAL_SHARE = 0.25
"""Share of a reference's matches that at least have points, and agree on a pose, unless something is wrong."""


@dataclass(frozen=True)
class _Case:
    """The numbers that a hint follows from.

    `matches` and `second` are with the two references with most matches, of which `best` is the name of the first;
    `tried` are those with points, None if there are none yet, and `inliers` those of them that agree.
    """

    rejection: Rejection
    features: int
    matches: int
    second: int
    inliers: int
    tried: int | None
    best: str | None
    reference_count: int
    has_prior: bool


def hinted(
    answer: Answer, query: View, references: Sequence[PosedView], has_prior: bool = False, compares: bool = True
) -> Answer:
    """Adds a hint to a rejection without one.

    Args:
        answer: answer to the photograph, with the matches behind it.
        query: the photograph.
        references: its references, in order.
        has_prior: whether the request has one on position or heading.
        compares: whether other cameras are compared with the photograph's where few of its matches agree, which takes
            up to a second.
    """
    rejection = answer.outcome
    if not isinstance(rejection, Rejection) or rejection.hint is not None:
        return answer
    matches = answer.reference_match_counts
    best = int(np.argmax(matches)) if any(matches) else None
    most, second = sorted((*matches, 0, 0), reverse=True)[:2]
    case = _Case(
        rejection,
        len(query.features),
        most,
        second,
        int(answer.support.estimate.inliers.sum()) if isinstance(answer.support, PosedSupport) else 0,
        rejection.tried if answer.support is None else len(answer.support.matches),
        None if best is None else references[best].name,
        len(references),
        has_prior,
    )
    if compares and rejection.reason in _OF_MATCHES and _agrees_little(case) and answer.support is not None:
        compared = compare_cameras(answer.support)
        if compared is not None and compared.is_significant:
            message = f"{compared.advice} All matches together fit a camera with {compared.named} better."
            hint = Hint("judge", Advice.CHECK_CALIBRATION, message, case.best)
            return replace(answer, outcome=replace(rejection, hint=hint, intrinsics_checks=compared.checks))
    advice, message = _advice(case)
    share = query.photograph.ignored_share if query.photograph else 0.0
    # Vehicles, grippers and people take less, inverted masks ignore more.
    if share >= 0.5 or (share > 0 and case.features < FEW_FEATURES):
        percent = f"{100 * share:.0f} %" if share >= 0.01 else "less than 1 %"
        message += f" The mask ignores {percent} of the image: 0 means ignore, every other value use."
    hint = Hint(_STAGES.get(rejection.reason, "judge") if references else "", advice, message, case.best)
    return replace(answer, outcome=replace(rejection, hint=hint))


def _advice(case: _Case) -> tuple[Advice, str]:
    reason = case.rejection.reason
    if reason is RejectionReason.PRIOR_CONFLICT:
        return Advice.CHECK_PRIOR, "Check the prior: the matches place the camera elsewhere."
    if reason is RejectionReason.AMBIGUOUS and len({it.world for it in case.rejection.hypotheses}) > 1:
        return (
            Advice.TELL_PLACES_APART,
            "Name the scene, narrow the group, or take a photograph that shows where the two places differ; where both "
            "scenes have a datum, a position on the Earth decides, too. If both are of one place, delete one of them.",
        )
    if reason is RejectionReason.AMBIGUOUS:
        return (
            Advice.TELL_PLACES_APART,
            "Give a prior on the pose, or take a photograph that shows where the two places differ; if there is one "
            "place only, check the references' poses.",
        )
    if reason is RejectionReason.LOW_TEXTURE:
        return Advice.RETAKE_PHOTOGRAPH, _retake(case)
    if reason is RejectionReason.DEGENERATE_REFERENCES:
        return (
            Advice.SPREAD_REFERENCES,
            f"The {case.reference_count} references were taken from one place: use some from different places.",
        )
    if case.reference_count == 0 and case.has_prior:
        return Advice.CHECK_PRIOR, "Check the prior: it leaves no reference."
    if case.reference_count < 2:
        return (
            Advice.ADD_REFERENCES,
            f"There {'is one reference' if case.reference_count else 'are no references'}: two at least are needed, "
            "taken from different places.",
        )
    return _of_overlap(case)


def _of_overlap(case: _Case) -> tuple[Advice, str]:
    """The hint if photograph and references are usable, but have too little in common."""
    shared = f"the best reference shares {case.matches} of the photograph's {case.features} features"
    if case.features < FEW_FEATURES:
        return Advice.RETAKE_PHOTOGRAPH, _retake(case)
    if case.rejection.reason in (RejectionReason.NO_USABLE_REFERENCES, RejectionReason.SCALE_UNRELIABLE):
        return (
            Advice.SPREAD_REFERENCES,
            f"The {case.reference_count} references do not give depth together: use some that show the same things "
            "from different places, and check their poses.",
        )
    if case.matches < FEW_MATCHES:
        return (
            Advice.CHOOSE_OTHER_REFERENCES,
            f"Use references that show what the photograph shows: {shared}, no more than chance gives.",
        )
    if case.matches >= MANY_MATCHES and case.tried is not None and case.tried < LEAST_USUAL_SHARE * case.matches:
        # Even if what two references show were independent, they would have so many of the features in common.
        if case.tried < LEAST_USUAL_SHARE * case.matches * case.second / case.features and case.second >= MANY_MATCHES:
            return (
                Advice.CHECK_CALIBRATION,
                f"Check the references' poses, for which `mapless-server audit` helps: world_from_camera (not its "
                f"inverse), with OpenCV's axes. The two best references share {case.matches} and {case.second} of the "
                f"photograph's {case.features} features, but only {case.tried} have a point that fits their poses. If "
                "the two show different things, add references from a step aside.",
            )
        return (
            Advice.ADD_REFERENCES,
            f"Add references that show the same as {case.best} from a step aside: {shared}, but of the photograph's "
            f"matches only {case.tried} have a point that a second reference shows as well, as depth requires.",
        )
    if _agrees_little(case):
        agreeing = f"{case.inliers} of {case.tried} matches with points agree on a pose" if case.tried else "few agree"
        return (
            Advice.ADD_REFERENCES,
            f"Add references that show the same as {case.best} from other places, or take another photograph: "
            f"{shared}, but {agreeing}. What repeats or has moved does not, nor what has wrong poses of references, "
            "which `mapless-server audit` names.",
        )
    return (
        Advice.LOOK_AT_REFERENCE,
        f"Point the camera at what the best reference shows, or add references from nearer: {shared}.",
    )


def _agrees_little(case: _Case) -> bool:
    """Whether one reference shares more with the photograph than chance could, and little of it agrees on a pose."""
    return case.matches >= MANY_MATCHES and case.inliers < LEAST_USUAL_SHARE * case.matches


def _retake(case: _Case) -> str:
    return (
        f"Take the photograph again, with more light, without motion blur and of something with texture: it has "
        f"{case.features} local features."
    )
