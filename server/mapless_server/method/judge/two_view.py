"""Whether a pose from two-view matches and 2D-3D matches is right, or chance and repetition could have produced it.

Two a-contrario tests (see `pnp`):

    pose        as many inliers among wrong matches, at a pose through three 2D-3D matches or six two-view matches. Each
                kind has its own chance of an inlier, a disc or a band in the image, and the numbers of inliers of the
                two are independent, so the chances multiply.
    distance    as many inliers among the matches that do not involve the reference with the most inliers, at the right
                direction from it and a distance through one of them. One reference alone determines the direction:
                hundreds of its matches agree with any distance. The chance is that of a band for both kinds, because
                a point that this reference observes lies on the epipolar line whatever the distance.

Wrong matches of repeated texture agree with one another, so a second reference must support the pose with a share of
its own matches. This share gives the trust: the share of right answers with one as low (see `judge`).
"""

from dataclasses import dataclass, fields, replace

import numpy as np

from ..bundle.estimate import PosedSupport, TwoViewSupport
from ..features.limits import EPIPOLAR_PX
from ..pairs.stationary import StationaryOptions, are_moved
from ..pose.pnp import disc_chance, false_alarms, format_false_alarms, log10_tail
from ..pose.relative import PNP, band_chance
from ..pose.two_view_matches import TwoViewMatches
from ..rejection import Advice, Hint, Rejection, RejectionReason
from .evidence import hull_px2
from .references import moved_matches

MAX_LOG10_POSE = -15.0
"""Largest log10 of the expected number of such poses among wrong matches. Evidence: epipolar-poses."""

MAX_LOG10_DISTANCE = -5.0
"""The same limit for distances."""

MIN_SECOND_SHARE = 0.35
"""Least share of inliers among the matches of the reference with the second most inliers. Evidence:
epipolar-poses."""

SHARES = (0.253, 0.256, 0.274, 0.288, 0.331, 0.432, 0.476, 0.636)
LEVELS = (0.0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 1.0)
"""Quantiles of that share in right answers to photographs that failed otherwise, and the shares of those that have
less."""

MIN_HULL_SHARE = 0.04
"""Least share of the image covered by the convex hull of the inliers; see `groups.images`."""


@dataclass(frozen=True)
class TwoViewEvidence:
    """The evidence for a pose.

    Attributes:
        log10_pose: log10 of the expected number of such poses; see the module.
        log10_distance: log10 of the expected number of such distances.
        inlier_count: number of inliers of both kinds.
        match_count: number of matches of both kinds.
        other_inliers: inliers on points, and of references other than the one with the most.
        second_share: share of inliers among the matches of the reference with the second most.
        hull_share: share of the image covered by the convex hull of the inliers.
    """

    log10_pose: float
    log10_distance: float
    inlier_count: int
    match_count: int
    other_inliers: int
    second_share: float
    hull_share: float


def two_view_evidence(support: PosedSupport) -> TwoViewEvidence:
    """Computes the evidence for the estimate of a support; ValueError if it has no two-view matches."""
    estimate, lines, matches, camera = support.estimate, support.two_view, support.matches, support.query.camera
    if lines is None:
        raise ValueError("support.two_view must not be None")
    disc, band = disc_chance(camera, PNP.inlier_px), band_chance(camera)
    # Matches searched near a pose agree with it by construction.
    points = int((~matches.guided).sum()), int((estimate.inliers & ~matches.guided).sum())
    all_lines = len(lines.inliers), int(lines.inliers.sum())
    pose = min(
        false_alarms(*points, disc) + log10_tail(*all_lines, band),
        false_alarms(*all_lines, band, sample=6) + log10_tail(*points, disc),
    )
    every = TwoViewMatches.of(support.query, support.references, support.query_matches)
    agreeing = every.sampson_px(estimate.world_from_camera) < EPIPOLAR_PX
    counts = np.bincount(every.reference[agreeing], minlength=len(support.references))
    strongest, second = np.argsort(-counts, kind="stable")[:2]
    others = lines.reference != strongest
    other_inliers = int(lines.inliers[others].sum()) + points[1]
    distance = false_alarms(int(others.sum()) + points[0], other_inliers, band, sample=1)
    keypoint = np.concatenate([matches.keypoint[estimate.inliers], lines.keypoint[lines.inliers]])
    return TwoViewEvidence(
        pose,
        distance,
        points[1] + all_lines[1],
        points[0] + all_lines[0],
        other_inliers,
        float(counts[second] / max(1, len(support.query_matches[second]))),
        hull_px2(support.query.features.keypoints[keypoint]) / (camera.width_px * camera.height_px),
    )


def without_unmoved(support: PosedSupport, options: StationaryOptions) -> PosedSupport:
    """The support without matches at the same pixels as in the references, which may be fixed to the camera.

    `options` have the largest displacement of what is fixed. ValueError if there are no two-view matches.
    """
    estimate, lines = support.estimate, support.two_view
    if lines is None:
        raise ValueError("support.two_view must not be None")
    points = moved_matches(support, options)
    rows = np.ones(len(lines.reference), bool)
    for i, (reference, matches) in enumerate(zip(support.references, support.query_matches, strict=True)):
        own = np.flatnonzero(lines.reference == i)
        pairs = np.stack([lines.keypoint[own], lines.reference_keypoint[own]], axis=1).astype(np.int32)
        rows[own] = are_moved(support.query, reference, pairs, matches, options)
    if points.all() and rows.all():
        return support
    kept = replace(estimate, inliers=estimate.inliers[points], errors_px=estimate.errors_px[points])
    moved = TwoViewSupport(*(getattr(lines, it.name)[rows] for it in fields(lines)))
    return replace(support, matches=support.matches.select(points), estimate=kept, two_view=moved)


def lacks_distance(evidence: TwoViewEvidence) -> bool:
    """Whether only one reference supports the pose, and too few other matches do."""
    return evidence.log10_pose <= MAX_LOG10_POSE and evidence.log10_distance > MAX_LOG10_DISTANCE


def two_view_failure(evidence: TwoViewEvidence) -> str | None:
    """Says in one sentence why a pose fails; None if it passes."""
    count = f"{evidence.inlier_count} of {evidence.match_count} matches with references and points agree on a pose"
    if evidence.log10_pose > MAX_LOG10_POSE:
        return f"{count}, which chance could do ({format_false_alarms(evidence.log10_pose, MAX_LOG10_POSE)})"
    if lacks_distance(evidence):
        return (
            f"{count}, but all except {evidence.other_inliers} of them are with one reference, which determines "
            "the direction but not the distance"
        )
    if evidence.second_share < MIN_SECOND_SHARE:
        return (
            f"{count}, but of the matches with the second reference only {100 * evidence.second_share:.0f} %: repeated "
            "structure somewhere else, most likely"
        )
    if evidence.hull_share < MIN_HULL_SHARE:
        return f"{count}, but they cover only {100 * evidence.hull_share:.1f} % of the image"
    return None


def one_reference_rejection(message: str, support: PosedSupport) -> Rejection:
    """Makes the rejection of a pose without a distance, with its hint."""
    best = support.references[int(np.argmax(support.inliers_by_reference()))].name
    advice = (
        f"Add references that show the same as {best} from a step aside, or use others: one reference determines the "
        "direction but not the distance."
    )
    return Rejection(RejectionReason.LOW_OVERLAP, message, Hint("two_view", Advice.ADD_REFERENCES, advice, best))


def two_view_trust(evidence: TwoViewEvidence) -> float:
    """Trust, 0 to 1: the share of right answers whose second reference has at most this share of inliers."""
    return float(np.interp(evidence.second_share, SHARES, LEVELS))
