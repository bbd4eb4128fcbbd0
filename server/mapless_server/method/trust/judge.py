"""Judge: accepts or rejects a pose, at a given share of right answers to accept.

The evidence for a pose gives a score, the larger the better. The *trust* of an answer is the share of right answers to
photographs of difficult places, with known poses, whose score is at most as high. So accepting poses with a trust of at
least 1 - c accepts the share c of right answers, independent of the scale of the score: trust is the p-value of "this
is a right answer", as in conformal prediction (Vovk, Gammerman and Shafer 2005). It is not the probability of being
right, which depends on how many of a caller's photographs show the place at all.

Wrong intrinsics are checked separately (`intrinsics`), because the evidence of their answers is as good as that of
right ones.

The quantiles come from `research.trust`: answers to photographs with many and few references, of the third of twelve
places where right answers have the least evidence, so that the coverage holds in a place like these; elsewhere more are
accepted. A right answer is off by at most 5 % of the distance to what the photograph shows, 5 degrees and, in
scenes in metres, 25 cm.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..intrinsics import ContradictionOptions
from ..options import check_bounds
from ..rejection import Advice, Hint, Hypothesis, Rejection, RejectionReason
from ..results import Support
from ..uncertainty.radii import accuracy_from_covariance
from ..views import Matches
from .ambiguity import AmbiguityOptions, find_rival
from .evidence import AgreementOptions, Evidence, Votes, evidence_of, votes_of
from .intrinsics import WrongCameraOptions, wrong_camera, wrong_intrinsics

_RARE = (0.0, 0.001, 0.0025, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075)
LEVELS = (*_RARE, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Shares of the right answers at which `JudgeOptions.scores` are the quantiles."""


@dataclass(frozen=True)
class JudgeOptions:
    """Options of the judge.

    Attributes:
        scores: quantiles of the scores of right answers at `LEVELS`.
        agreement_weight: weight of ln(1 / chance) if gravity or heading agrees with a pose. It would be 1 if poses were
            wrong only by chance; but poses from repeated structure and wrong references agree too, and so do slightly
            wrong ones.
        agreement: options of the comparison of halves.
        ambiguity: options of the search for a second pose.
        intrinsics: options of the check of the photograph's intrinsics.
        camera: options of the comparison with other cameras.
        max_radius_share: largest 68 % radius of the position, as a share of the distance to what the photograph shows:
            of the poses with a larger one too many are wrong. Of 2,416 right answers 7 have it, of 116 wrong ones 18.
            Each of twelve places left out, the others choose this limit.
    """

    scores: tuple[float, ...] = (
        -12.224, -11.752, -11.254, -10.17, -8.789, -7.801, -6.527, -4.942, -3.329, -1.931,
        -0.623, 0.323, 1.854, 2.719, 3.518, 4.185, 4.882, 5.504, 6.015, 6.717,
    )  # fmt: skip
    agreement_weight: float = 0.3
    agreement: AgreementOptions = field(default_factory=AgreementOptions)
    ambiguity: AmbiguityOptions = field(default_factory=AmbiguityOptions)
    intrinsics: ContradictionOptions = field(default_factory=ContradictionOptions)
    camera: WrongCameraOptions = field(default_factory=WrongCameraOptions)
    max_radius_share: float = 0.08

    def __post_init__(self) -> None:
        check_bounds(self, "agreement_weight", at_least=0)
        check_bounds(self, "max_radius_share", above=0)
        if len(self.scores) != len(LEVELS):
            raise ValueError(f"JudgeOptions.scores must be {len(LEVELS)} numbers, is {self.scores}")
        if not all(a <= b for a, b in itertools.pairwise(self.scores)):
            raise ValueError(f"JudgeOptions.scores must be rising, is {self.scores}")

    def with_trust(self, quantiles: tuple[float, ...]) -> "JudgeOptions":
        """Options of a scene whose right answers have these quantiles (at `LEVELS`) of the trust by these options."""
        return replace(self, scores=tuple(np.interp(quantiles, LEVELS, self.scores).tolist()))


@dataclass(frozen=True)
class Judgement:
    """The result of the judge.

    Attributes:
        trust: 0 to 1; share of right answers whose score is at most as high.
        evidence: from which it is computed.
        rejection: why the pose is not accepted; None if it is.
    """

    trust: float
    evidence: Evidence
    rejection: Rejection | None


def judge(
    support: Support,
    query_matches: Sequence[Matches],
    coverage: float,
    options: JudgeOptions,
    log10_chance: float = 0.0,
) -> Judgement:
    """Judges the estimate of a support.

    Args:
        support: the support, whose estimate has passed the gate.
        query_matches: matches of the query with each reference.
        coverage: share of right answers to accept, above 0 and at most 1.
        options: options of the judge.
        log10_chance: see `Priors.log10_chance`.

    Returns:
        The judgement. Its rejection, in the support's world, is GATE, with a hint, if the photograph contradicts its
        intrinsics; AMBIGUOUS with both hypotheses if a second pose is supported about as well; GATE, with a hint, if
        the position's radius is too large; and GATE if the trust is
        less than 1 - coverage.
    """
    votes = votes_of(support, query_matches)
    evidence = evidence_of(support, votes, query_matches, options.agreement)
    trust = trust_of(evidence, options, log10_chance)
    rejection = contradiction(support, votes, options)
    if rejection is None:
        rejection = low_trust(evidence, trust, coverage)
    return Judgement(trust, evidence, rejection)


def contradiction(support: Support, votes: Votes, options: JudgeOptions) -> Rejection | None:
    """Rejects a pose whose matches contradict the intrinsics or support a second pose, or whose radius is too large."""
    if support.estimate is not None and support.estimate.intrinsics is not None:
        best = support.references[int(np.argmax(support.inliers_by_reference()))].name
        evidence = support.estimate.intrinsics
        wrong = wrong_intrinsics(evidence, best, options.intrinsics)
        if wrong := wrong or wrong_camera(support, evidence, best, options.camera):
            return wrong
    hypotheses = find_rival(support, votes, options.ambiguity)
    return _ambiguous(hypotheses) if hypotheses else _too_uncertain(support, options)


def trust_of(evidence: Evidence, options: JudgeOptions, log10_chance: float = 0.0) -> float:
    """Trust: the share of right answers with at most this score; agreement with priors raises the score."""
    agreement = -options.agreement_weight * math.log(10) * log10_chance
    return float(np.interp(evidence.score + agreement, options.scores, LEVELS))


def trust_in_scene(trust: float, quantiles: tuple[float, ...]) -> float:
    """Trust in a scene whose right answers have these quantiles of trust; unchanged without quantiles."""
    return float(np.interp(trust, quantiles, LEVELS)) if quantiles else trust


def low_trust(evidence: Evidence, trust: float, coverage: float) -> Rejection | None:
    """Rejects a pose if its trust is less than 1 - coverage."""
    if trust >= 1 - coverage:
        return None
    shown = math.floor(1000 * trust) / 1000  # rounded down, so that it never equals the bound
    message = (
        f"its trust of {shown:g} is below the {round(1 - coverage, 6):g} that a coverage of {coverage:g} requires: "
        f"{format_evidence(evidence)}"
    )
    return Rejection(RejectionReason.GATE, message)


def format_evidence(evidence: Evidence) -> str:
    """Formats the evidence as text."""
    return (
        f"{evidence.inlier_count} of {evidence.match_count} matches agree, {100 * evidence.found_share:.0f} % of the "
        f"points that should be found, of which references find {100 * evidence.expected_share:.0f} %, over "
        f"{100 * evidence.hull_share:.0f} % of the image; {100 * math.sqrt(evidence.epipolar_share):.0f} % of the "
        "matches with the two best references lie on their epipolar lines; halves of the data give positions apart by "
        f"{100 * evidence.disagreement:.1f} % of the distance"
    )


def _too_uncertain(support: Support, options: JudgeOptions) -> Rejection | None:
    """Rejects a pose whose own radius says that it may well be wrong."""
    assert support.estimate is not None
    share = accuracy_from_covariance(support.estimate.covariance).position_68_m / support.distance_m()
    if share <= options.max_radius_share:
        return None
    message = (
        f"its position is known to {100 * share:.1f} % of the distance to what the photograph shows (68 % radius), "
        f"{100 * options.max_radius_share:g} % is needed"
    )
    strongest = np.argsort(-np.array(support.inliers_by_reference()), kind="stable")[:2]
    names = [support.references[i].name for i in strongest]
    advice = f"Add references that show the same from other places: {' and '.join(names)} alone do not suffice."
    return Rejection(RejectionReason.GATE, message, Hint("judge", Advice.ADD_REFERENCES, advice, names[0]))


def _ambiguous(hypotheses: tuple[Hypothesis, Hypothesis]) -> Rejection:
    first, second = sorted(hypotheses, key=lambda it: -it.inlier_count)
    apart_m = math.dist(first.world_from_camera.translation, second.world_from_camera.translation)
    message = (
        f"two poses {apart_m:.2f} m apart explain the photograph: {first.inlier_count} keypoints agree with one by "
        f"{len(first.references)} references, {second.inlier_count} with the other by {len(second.references)}"
    )
    return Rejection(RejectionReason.AMBIGUOUS, message, hypotheses=(first, second))
