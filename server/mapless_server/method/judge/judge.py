"""Judge: accepts or rejects a pose, at a given share of right answers to accept.

The evidence for a pose gives a score, the larger the better. The *trust* of an answer is the share of right answers to
photographs of difficult places, with known poses, whose score is at most as high. So accepting poses with a trust of at
least 1 - c accepts the share c of right answers, independent of the scale of the score: trust is the p-value of "this
is a right answer", as in conformal prediction (Vovk, Gammerman and Shafer 2005). It is not the probability of being
right, which depends on how many of a caller's photographs show the place at all. Wrong intrinsics are checked
separately (`cameras`), because the evidence of their answers is as good as that of right ones.

The quantiles were measured on the third of twelve places where right answers have the least evidence, so that the
coverage holds in a place like these. A right answer is off by at most 5 % of the distance to what the photograph shows,
5 degrees and, in scenes in metres, 25 cm.

A pose is ambiguous if it has a rival: with repeated structure, or some references with wrong poses, the matches of the
references form two clusters. A second pose, among the matches that are outliers of the first, is a rival if

    its inliers are not chance (the a-contrario test of `pnp`, over these matches),
    it explains at least a given share of the number of keypoints that the first pose explains,
    it is further from the first pose than the 95 % radii of both, and
    most of its inliers come from references that support it more than the first pose.

Keypoints are counted over the matches with each reference, before the majority vote for a keypoint's point, which
removes the matches of the weaker place.
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, rotation_angle_deg

from ..bundle.estimate import Accuracy, PosedSupport, accuracy_from_covariance, with_halves
from ..features.limits import INEXACT_INLIER_PX
from ..optim.optimize import pose_hessian, world_covariance
from ..pose.by_depths import Found
from ..pose.pnp import LN_10, MAX_LOG10_FALSE_ALARMS, PnpOptions, disc_chance, false_alarms, format_false_alarms, ransac
from ..rejection import Advice, Hint, PoseHypothesis, Rejection, RejectionReason
from .cameras import wrong_camera
from .evidence import Evidence, Votes, evidence_of, votes_of
from .intrinsics import is_camera_doubtful, wrong_intrinsics
from .references import disagreeing_references, supporters_of

RIVAL_MIN_KEYPOINTS = 10
"""Least number of keypoints of a rival; it has the majority of those of the first pose, too."""

RIVAL_MAX_LOG10_FALSE_ALARMS = -6.0
"""As `pnp.MAX_LOG10_FALSE_ALARMS`, but stricter, because a rival is searched for every answer."""

MIN_APART_M, MIN_APART_DEG = 0.1, 5.0
"""Poses nearer than this are one place, independent of their radii."""

RIVAL_PNP = PnpOptions(min_iterations=50, max_iterations=200, max_matches=300)
"""RANSAC of the rival's pose; the few iterations find a pose with a third of the matches as inliers."""

AGREEMENT_WEIGHT = 0.3
"""Weight of ln(1 / chance) if gravity or heading agrees with a pose. It would be 1 if poses were wrong only by chance;
but slightly wrong ones, and those from repeated structure, agree, too."""

MAX_RADIUS_SHARE = 0.08
"""Largest 68 % radius of the position, as a share of the distance to what the photograph shows: of the poses with a
larger one too many are wrong. Evidence: largest-radius."""

MAX_GUESSED_RADIUS_SHARE = 0.04
"""The same where the intrinsics are a guess: most of the radius is then an error of the distance that no other evidence
shows. Evidence: unknown-camera."""

LEVELS = (
    0.0, 0.001, 0.0025, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0,
)  # fmt: skip
"""Shares of the right answers at which `JudgeOptions.scores` are the quantiles."""

ONE_REFERENCE_SCORES = (
    24.5, 24.5, 24.5, 24.5, 25.2, 33.5, 38.6, 44.0, 63.1, 86.9,
    109.8, 162.3, 271.0, 360.9, 491.1, 698.1, 961.1, 1254.3, 1632.0, 2947.7,
)  # fmt: skip
"""Quantiles, at `LEVELS`, of the scores of right answers (`Found.score`), on the one of four places with measured depth
where they have the least evidence. Evidence: depth-scores."""

MAX_ONE_REFERENCE_RADIUS_SHARE = 0.04
"""Largest 95 % radius of a position from one reference, without the error that all depths share, as a share of the
distance: a few matches on a small or flat thing fit poses that are farther apart. Evidence: depth-radius."""


@dataclass(frozen=True)
class JudgeOptions:
    """Options of the judge: `scores`, quantiles of the scores of right answers at `LEVELS`."""

    scores: tuple[float, ...] = (
        -12.224, -11.752, -11.254, -10.17, -8.789, -7.801, -6.527, -4.942, -3.329, -1.931,
        -0.623, 0.323, 1.854, 2.719, 3.518, 4.185, 4.882, 5.504, 6.015, 6.717,
    )  # fmt: skip

    def __post_init__(self) -> None:
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
    support: PosedSupport, coverage: float, options: JudgeOptions, log10_chance: float = 0.0, unit: str = "m"
) -> Judgement:
    """Judges the estimate of a support, which has passed the gate; `coverage` is the share of right answers to accept.

    The rejection, in the support's world, is GATE, with a hint, if the references disagree, the photograph contradicts
    its intrinsics or the position's radius is too large; AMBIGUOUS with both hypotheses if a second pose is supported
    about as well; and GATE if the trust is less than 1 - coverage. For `log10_chance` see `Priors.log10_chance`; `unit`
    is the scene's unit of length, in messages.
    """
    votes = votes_of(support)
    evidence = evidence_of(support, votes)
    trust = trust_of(evidence, options, log10_chance)
    doubt = low_trust(evidence, trust, coverage)
    estimate = with_halves(support.estimate, evidence.disagreement * support.distance_m())
    contradicted = contradiction(support, votes, unit, estimate.covariance, is_doubted=doubt is not None)
    return Judgement(trust, evidence, contradicted or doubt)


def contradiction(
    support: PosedSupport, votes: Votes, unit: str, covariance: Array, is_doubted: bool = False
) -> Rejection | None:
    """Rejects a pose whose references, intrinsics or other matches contradict it, or whose radius is too large.

    The latter has the pose, with the covariance (6, 6) that it would be answered with, unless it is doubted for lack of
    evidence, too.
    """
    if disagreeing := disagreeing_references([supporters_of(support)]):
        return disagreeing
    evidence = support.estimate.intrinsics
    best = support.references[int(np.argmax(support.inliers_by_reference()))].name
    wrong = wrong_intrinsics(evidence, best) if evidence else None
    if wrong:
        return (_too_uncertain(support) if _is_guessed(support) else None) or wrong  # what is unknown is not accused
    if is_camera_doubtful(support) and (wrong := wrong_camera(support, best)):
        return wrong
    hypotheses = find_rival(support, votes)
    if hypotheses:
        return _ambiguous(hypotheses, unit)
    rejection = _too_uncertain(support)
    return (
        rejection if rejection is None or is_doubted else replace(rejection, imprecise=_imprecise(support, covariance))
    )


def trust_of(evidence: Evidence, options: JudgeOptions, log10_chance: float = 0.0) -> float:
    """Trust: the share of right answers with at most this score; agreement with priors raises the score."""
    agreement = -AGREEMENT_WEIGHT * LN_10 * log10_chance
    return float(np.interp(evidence.score + agreement, options.scores, LEVELS))


def trust_in_scene(trust: float, quantiles: tuple[float, ...]) -> float:
    """Trust in a scene whose right answers have these quantiles of trust; unchanged without quantiles."""
    return float(np.interp(trust, quantiles, LEVELS)) if quantiles else trust


def trust_of_score(score: float) -> float:
    """Share of right answers from one reference whose score is at most as high."""
    return float(np.interp(score, ONE_REFERENCE_SCORES, LEVELS))


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


def one_reference_failure(found: Found, trust: float, coverage: float) -> str | None:
    """Says in one sentence why a pose is not accepted; None if it is."""
    inliers = found.support.estimate.inliers
    count = f"{inliers.sum()} of {len(inliers)} matches agree on a pose"
    if -found.score > MAX_LOG10_FALSE_ALARMS:
        return f"{count}, which chance could do ({format_false_alarms(-found.score, MAX_LOG10_FALSE_ALARMS)})"
    if -found.moved_score > MAX_LOG10_FALSE_ALARMS:
        chance = format_false_alarms(-found.moved_score, MAX_LOG10_FALSE_ALARMS)
        return f"{count}, at the same pixels as in the reference, as if fixed to the camera; without them {chance}"
    if trust < 1 - coverage:
        required = f"the {round(1 - coverage, 6):g} that a coverage of {coverage:g} requires"
        return f"its trust of {np.floor(1000 * trust) / 1000:g} is below {required}: {count} with a single reference"
    return None


def one_reference_radius_failure(found: Found) -> str | None:
    """Says in one sentence that the matches hardly determine the position; None if they do."""
    radius = accuracy_from_covariance(found.own_covariance).position_95_m / found.support.distance_m()
    if radius <= MAX_ONE_REFERENCE_RADIUS_SHARE:
        return None
    inliers, largest = found.support.estimate.inliers, f"{100 * MAX_ONE_REFERENCE_RADIUS_SHARE:g} % is the most"
    count = f"{inliers.sum()} of {len(inliers)} matches agree on a pose"
    return f"{count}, which know the position to {100 * radius:.1f} % of the distance (95 % radius), {largest}"


def format_evidence(evidence: Evidence) -> str:
    """Formats the evidence as text."""
    return (
        f"{evidence.inlier_count} of {evidence.match_count} matches agree, {100 * evidence.found_share:.0f} % of the "
        f"points that should be found, of which references find {100 * evidence.expected_share:.0f} %, over "
        f"{100 * evidence.hull_share:.0f} % of the image; {100 * math.sqrt(evidence.epipolar_share):.0f} % of the "
        "matches with the two best references lie on their epipolar lines; halves of the data give positions apart by "
        f"{100 * evidence.disagreement:.1f} % of the distance"
    )


def _too_uncertain(support: PosedSupport) -> Rejection | None:
    """Rejects a pose whose own radius says that it may well be wrong."""
    share = accuracy_from_covariance(support.estimate.covariance).position_68_m / support.distance_m()
    largest = MAX_GUESSED_RADIUS_SHARE if _is_guessed(support) else MAX_RADIUS_SHARE
    if share <= largest:
        return None
    message = (
        f"its position is known to {100 * share:.1f} % of the distance to what the photograph shows (68 % radius), "
        f"{100 * largest:g} % is needed"
    )
    strongest = np.argsort(-np.array(support.inliers_by_reference()), kind="stable")[:2]
    names = [support.references[i].name for i in strongest]
    if unknown := _unknown_focal(support):
        advice = "Send intrinsics that are certain to less than that, or a photograph of things at several distances."
        hint = Hint("judge", Advice.CHECK_CALIBRATION, advice, names[0])
        return Rejection(RejectionReason.GATE, f"{message}: {unknown}", hint)
    advice = f"Add references that show the same from other places: {' and '.join(names)} alone do not suffice."
    return Rejection(RejectionReason.GATE, message, Hint("judge", Advice.ADD_REFERENCES, advice, names[0]))


def _is_guessed(support: PosedSupport) -> bool:
    return support.intrinsics_sigma is not None and support.intrinsics_sigma.is_guess


def _unknown_focal(support: PosedSupport) -> str:
    """Says that most of the position's variance is that of the intrinsics, and why; empty if it is not."""
    evidence, covariance = support.estimate.intrinsics, support.estimate.covariance
    if evidence is None or 2 * np.trace(evidence.pose_covariance[:3, :3]) < np.trace(covariance[:3, :3]):
        return ""
    return (
        f"its focal length is known to {100 * math.sqrt(evidence.covariance[0, 0]):.1f} %, and what it shows, as of a "
        "flat wall, does not tell a longer one from a larger distance"
    )


def _imprecise(support: PosedSupport, covariance: Array) -> PoseHypothesis:
    counts = np.array(support.inliers_by_reference())
    names = tuple(support.references[i].name for i in np.argsort(-counts, kind="stable") if counts[i])
    return PoseHypothesis(support.estimate.world_from_camera, support.inlier_count(), names, covariance)


def _ambiguous(hypotheses: tuple[PoseHypothesis, PoseHypothesis], unit: str) -> Rejection:
    first, second = sorted(hypotheses, key=lambda it: -it.inlier_count)
    apart = math.dist(first.world_from_camera.translation, second.world_from_camera.translation)
    message = (
        f"two poses {apart:.2f} {unit} apart explain the photograph: {first.inlier_count} keypoints agree with one by "
        f"{len(first.references)} references, {second.inlier_count} with the other by {len(second.references)}"
    )
    return Rejection(RejectionReason.AMBIGUOUS, message, hypotheses=(first, second))


def find_rival(support: PosedSupport, votes: Votes) -> tuple[PoseHypothesis, PoseHypothesis] | None:
    """Finds a support's pose and its rival among the votes, as hypotheses in the support's world; None without one."""
    estimate, camera = support.estimate, support.query.camera
    errors_px = votes.seen.errors_px(estimate.world_from_camera)
    own = errors_px < RIVAL_PNP.inlier_px
    wanted = max(RIVAL_MIN_KEYPOINTS, int(np.ceil(votes.keypoint_count(own) / 2)))
    candidates = _outliers(votes, own, ~(errors_px < INEXACT_INLIER_PX), len(support.references))
    if votes.keypoint_count(candidates) < wanted:
        return None
    rival = _second_pose(camera, votes[candidates], wanted)
    if rival is None:
        return None
    pose, radii = rival
    own_radii = accuracy_from_covariance(estimate.covariance)
    if not _are_apart(estimate.world_from_camera, own_radii, pose, radii):
        return None
    theirs = votes.seen.errors_px(pose) < RIVAL_PNP.inlier_px
    counts = [np.bincount(votes.reference[rows], minlength=len(support.references)) for rows in (own, theirs)]
    if counts[1][counts[1] > counts[0]].sum() < counts[1].sum() / 2:
        return None
    names = [reference.name for reference in support.references]
    return (
        PoseHypothesis(estimate.world_from_camera, votes.keypoint_count(own), _supporters(names, counts[0], counts[1])),
        PoseHypothesis(pose, votes.keypoint_count(theirs), _supporters(names, counts[1], counts[0])),
    )


def _second_pose(camera: Camera, votes: Votes, wanted: int) -> tuple[RigidTransform, Accuracy] | None:
    """Finds a pose with enough inliers that are not chance, and its radii."""
    pose = ransac(votes.seen, None, RIVAL_PNP)
    if pose is None:
        return None
    inliers = votes.seen.errors_px(pose) < RIVAL_PNP.inlier_px
    keypoint_count, count = len(np.unique(votes.keypoint)), votes.keypoint_count(inliers)
    # The chance of an inlier is proportional to the number of matches of a keypoint.
    chance = float(disc_chance(camera, RIVAL_PNP.inlier_px) * len(votes.keypoint) / keypoint_count)
    if count < wanted or false_alarms(keypoint_count, count, chance) > RIVAL_MAX_LOG10_FALSE_ALARMS:
        return None
    # With a keypoint noise of one pixel.
    covariance = world_covariance(pose_hessian(camera, pose, votes.seen.x_in_world[inliers]), pose)
    return pose, accuracy_from_covariance(covariance)


def _supporters(names: Sequence[str], own: NDArray[np.intp], other: NDArray[np.intp]) -> tuple[str, ...]:
    """Names of the references with more inliers of one pose than of the other, those with the most first."""
    return tuple(names[i] for i in np.argsort(-own, kind="stable") if own[i] > other[i])


def _outliers(
    votes: Votes, own: NDArray[np.bool_], apart: NDArray[np.bool_], reference_count: int
) -> NDArray[np.bool_]:
    """Mask (V,) of the matches far from the first pose, of references with more such matches than inliers."""
    against, favour = (np.bincount(votes.reference[rows], minlength=reference_count) for rows in (apart, own))
    return np.asarray(apart & (against > favour)[votes.reference])


def _are_apart(first: RigidTransform, radii: Accuracy, second: RigidTransform, other: Accuracy) -> bool:
    apart_m = float(np.linalg.norm(second.translation - first.translation))
    apart_deg = rotation_angle_deg(first.rotation.T @ second.rotation)
    reach_m = max(MIN_APART_M, radii.position_95_m + other.position_95_m)
    reach_deg = max(MIN_APART_DEG, radii.rotation_95_deg + other.rotation_95_deg)
    return apart_m > reach_m or apart_deg > reach_deg
