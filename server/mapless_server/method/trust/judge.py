"""Judge: accepts or rejects a pose, at a given share of right answers to accept.

The evidence for a pose gives a score, s = w . ln(evidence), monotone in each component. The *trust* of an answer is the
share of right answers to photographs with known poses (off by at most 10 cm and 5 degrees) whose score is at most as
high. So accepting poses with a trust of at least 1 - c accepts the share c of right answers, independent of the scale
of the score: trust is the p-value of "this is a right answer", as in conformal prediction (Vovk, Gammerman and Shafer
2005). It is not the probability of being right, which depends on how many of a caller's photographs show the place at
all.

A wrong focal length is checked separately (`focal`), because the evidence of its answers is as good as that of right
ones.

Weights and quantiles come from `research.trust`, which separates wrong poses (other places, mirrored photographs,
references with wrong poses, little overlap) from right ones by logistic regression with weights of one sign.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mapless.geometry import Array

from ..options import check_bounds
from ..rejection import Advice, Hint, Hypothesis, Rejection, RejectionReason
from ..results import Support
from ..uncertainty.covariance import accuracy_from_covariance
from ..views import Matches
from .ambiguity import AmbiguityOptions, find_rival
from .focal import Focal, FocalOptions, wrong_focal
from .gate import findable_count, hull_share, log10_false_alarms

FEATURES = ("significance", "inlier share", "found share", "hull share", "references", "fit", "precision")
"""The components of `Evidence.features`; a larger value is better in each."""

LEAST_RADIUS_M, LARGEST_RADIUS_M = 0.005, 1.0
"""Range in which a smaller radius is evidence: right answers are off by 10 cm at most, so radii beyond a metre do not
differ, nor do radii of a few millimetres."""


@dataclass(frozen=True)
class Evidence:
    """The evidence for a pose.

    Attributes:
        log10_false_alarms: log10 of the expected number of poses with as many inliers among wrong matches.
        inlier_count: number of inliers.
        match_count: number of 2D-3D matches.
        findable_count: points of the structure that project into the image; at most the number of its features.
        hull_share: share of the image covered by the convex hull of the inliers.
        reference_count: effective number of references that support it, (sum n_i)^2 / sum n_i^2 over the inliers n_i
            on points of each: 1 if one has them all, K if all have as many.
        error_sigma: median error of the inliers, in standard deviations of their keypoints, at least one.
        position_95_m: radius of the position.
    """

    log10_false_alarms: float
    inlier_count: int
    match_count: int
    findable_count: int
    hull_share: float
    reference_count: float
    error_sigma: float
    position_95_m: float

    @property
    def inlier_share(self) -> float:
        """Share of the matches that are inliers."""
        return self.inlier_count / self.match_count

    @property
    def found_share(self) -> float:
        """Inliers over findable points, at most one."""
        return min(1.0, self.inlier_count / max(1, self.findable_count))

    def features(self) -> Array:
        """Logarithms (7,) in the order of `FEATURES`."""
        return np.log(
            [
                max(1.0, -self.log10_false_alarms),
                self.inlier_share,
                self.found_share,
                max(1e-4, self.hull_share),
                self.reference_count,
                1 / self.error_sigma,
                1 / min(max(self.position_95_m, LEAST_RADIUS_M), LARGEST_RADIUS_M),
            ]
        )


_RARE = (0.0, 0.001, 0.0025, 0.005, 0.01, 0.02, 0.03, 0.05, 0.075)
LEVELS = (*_RARE, 0.1, 0.15, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Shares of the right answers at which `JudgeOptions.scores` are the quantiles."""


@dataclass(frozen=True)
class JudgeOptions:
    """Options of the judge.

    Attributes:
        weights: of each of `FEATURES`. Fitted; see the module.
        scores: quantiles of the scores of right answers at `LEVELS`.
        agreement_weight: of ln(1 / chance) if gravity or heading agrees with a pose. It would be 1 if poses were wrong
            only by chance; but poses from repeated structure and wrong references agree too, and so do slightly wrong
            ones.
        ambiguity: of the search for a second pose.
        focal: of the check of the photograph's focal length.
    """

    weights: tuple[float, ...] = (0.441, 3.474, 0.0, 1.779, 0.601, 4.552, 1.243)
    scores: tuple[float, ...] = (
        -9.29, -7.942, -6.365, -4.514, -0.949, 0.287, 1.425, 2.709, 3.32, 3.708,
        4.478, 5.112, 6.224, 7.021, 7.648, 8.076, 8.425, 8.805, 9.285, 10.588,
    )  # fmt: skip
    agreement_weight: float = 0.3
    ambiguity: AmbiguityOptions = field(default_factory=AmbiguityOptions)
    focal: FocalOptions = field(default_factory=FocalOptions)

    def __post_init__(self) -> None:
        check_bounds(self, "weights agreement_weight", at_least=0)
        for name, values, size in (("weights", self.weights, len(FEATURES)), ("scores", self.scores, len(LEVELS))):
            if len(values) != size:
                raise ValueError(f"JudgeOptions.{name} must be {size} numbers, is {values}")
        if not all(a <= b for a, b in itertools.pairwise(self.scores)):
            raise ValueError(f"JudgeOptions.scores must be rising, is {self.scores}")


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
    inlier_px: float,
    coverage: float,
    options: JudgeOptions,
    log10_chance: float = 0.0,
) -> Judgement:
    """Judges the estimate of a support.

    Args:
        support: with an estimate that passed the gate.
        query_matches: of the query with each reference.
        inlier_px: largest reprojection error of an inlier.
        coverage: share of right answers to accept, above 0 and at most 1.
        options: see there.
        log10_chance: see `Priors.log10_chance`.

    Returns:
        The judgement. Rejections, in the support's world: GATE, with a hint, if the photograph contradicts its focal
        length; AMBIGUOUS with both hypotheses if a second pose is supported about as well; GATE if the trust is less
        than 1 - coverage.
    """
    evidence = evidence_of(support, inlier_px, log10_chance)
    trust = trust_of(evidence, options, log10_chance)
    focal = wrong_focal(support, options.focal)
    if focal:
        return Judgement(trust, evidence, _miscalibrated(support, focal))
    hypotheses = find_rival(support, query_matches, options.ambiguity)
    if hypotheses:
        return Judgement(trust, evidence, _ambiguous(hypotheses))
    if trust < 1 - coverage:
        return Judgement(trust, evidence, _low_trust(evidence, trust, coverage))
    return Judgement(trust, evidence, None)


def evidence_of(support: Support, inlier_px: float, log10_chance: float = 0.0) -> Evidence:
    """The evidence for the estimate of a support.

    Args:
        support: with an estimate of four inliers or more.
        inlier_px: largest reprojection error of an inlier.
        log10_chance: see `Priors.log10_chance`.
    """
    estimate, query, structure, matches = support.estimate, support.query, support.structure, support.matches
    if estimate is None or estimate.inliers.sum() < 4:
        raise ValueError("there is no pose to speak for")
    inliers, pose = estimate.inliers, estimate.world_from_camera
    by_reference = np.array(support.inliers_by_reference(), float)
    sigma_px = structure.noise.sigma_px(query.features.sizes_px[matches.keypoint[inliers]].astype(np.float64))
    return Evidence(
        log10_false_alarms(query.camera, matches, inliers, inlier_px) + log10_chance,
        int(inliers.sum()),
        len(matches),
        findable_count(query, structure, pose),
        hull_share(query, matches, inliers),
        float(by_reference.sum() ** 2 / max(1.0, (by_reference**2).sum())) or 1.0,
        max(1.0, float(np.median(estimate.errors_px[inliers] / sigma_px))),
        accuracy_from_covariance(estimate.covariance).position_95_m,
    )


def score_of(evidence: Evidence, options: JudgeOptions) -> float:
    """The score of a pose; right poses have larger ones."""
    return float(evidence.features() @ np.array(options.weights))


def trust_of(evidence: Evidence, options: JudgeOptions, log10_chance: float = 0.0) -> float:
    """Trust: share of right answers with at most this score, to which agreement with priors is added."""
    agreement = -options.agreement_weight * math.log(10) * log10_chance
    return float(np.interp(score_of(evidence, options) + agreement, options.scores, LEVELS))


def _low_trust(evidence: Evidence, trust: float, coverage: float) -> Rejection:
    shown = math.floor(1000 * trust) / 1000  # rounded down, so that it never equals the bound
    message = (
        f"its trust of {shown:g} is below the {round(1 - coverage, 6):g} that a coverage of {coverage:g} asks for: "
        f"{format_evidence(evidence)}"
    )
    return Rejection(RejectionReason.GATE, message)


def _miscalibrated(support: Support, focal: Focal) -> Rejection:
    message = (
        f"the photograph says {focal.estimated_px / focal.given_px:.3f} times the focal length that its intrinsics say "
        f"(standard deviation {focal.sigma:.2g}): {focal.agreeing} of the matches looked at agree with the former, "
        f"{focal.agreeing_before} with the latter"
    )
    advice = (
        "Check the photograph's focal length: intrinsics belong to one image size, change with it when a photograph is "
        "resized, and have another principal point when it is cropped."
    )
    best = support.references[int(np.argmax(support.inliers_by_reference()))].name
    return Rejection(RejectionReason.GATE, message, Hint("judge", Advice.CHECK_CALIBRATION, advice, best))


def format_evidence(evidence: Evidence) -> str:
    """The evidence as text."""
    return (
        f"{evidence.inlier_count} of {evidence.match_count} matches agree, {100 * evidence.found_share:.0f} % of the "
        f"points that should be found, over {100 * evidence.hull_share:.0f} % of the image, the position within "
        f"{evidence.position_95_m:.2g} m"
    )


def _ambiguous(hypotheses: tuple[Hypothesis, Hypothesis]) -> Rejection:
    first, second = sorted(hypotheses, key=lambda it: -it.inlier_count)
    apart_m = math.dist(first.world_from_camera.translation, second.world_from_camera.translation)
    message = (
        f"two poses {apart_m:.2f} m apart explain the photograph: {first.inlier_count} keypoints agree with one by "
        f"{len(first.references)} references, {second.inlier_count} with the other by {len(second.references)}"
    )
    return Rejection(RejectionReason.AMBIGUOUS, message, hypotheses=(first, second))
