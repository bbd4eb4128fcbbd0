"""Gate: rejects poses that chance or repeated structure could support as well.

A pose must have more inliers than wrong matches can be expected to give (a-contrario model estimation, Moisan and
Stival 2004). Wrong matches of repeated texture agree with one another, so two more conditions hold for right poses: a
share of the points inside the image is found, and the inliers cover more than one corner.

This is a cheap first test; `judge` computes the trust of poses that pass it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull
from scipy.special import gammaln

from mapless.geometry import Camera, RigidTransform

from ..options import check_bounds
from ..results import PointMatches, Structure
from ..views import View


@dataclass(frozen=True)
class GateOptions:
    """Options of the gate.

    Attributes:
        max_log10_false_alarms: largest log10 of the expected number of poses with as many inliers among wrong matches.
        min_found_share: least share of inliers among the points inside the image, or among the photograph's features if
            they are fewer. Of 200 photographs with right poses, hard ones among them, the lowest was 0.10; wrong poses
            by chance or repetition mostly had 0.01.
        enough_inliers: so many inliers are enough for any share: with many references the structure extends far beyond
            one photograph. Repetition has supported wrong poses with at most 23.
        min_hull_share: least share of the image covered by the convex hull of the inliers. On the same photographs the
            lowest of right poses was 0.08; a repeated floor tile with 16 inliers had 0.03.
        agreeing_factor: on both shares if gravity or heading agrees with the pose. Of 120 poses found by chance none
            agreed with gravity to a degree. Of 23 photographs with few or distant references whose pose agreed but had
            too small a share, none was at another place: 14 were off by less than 10 cm, none by more than 30.
    """

    max_log10_false_alarms: float = -3.0
    min_found_share: float = 0.08
    enough_inliers: int = 100
    min_hull_share: float = 0.04
    agreeing_factor: float = 0.25

    def __post_init__(self) -> None:
        check_bounds(self, "min_found_share min_hull_share", at_least=0, below=1)
        check_bounds(self, "agreeing_factor", at_least=0, at_most=1)
        check_bounds(self, "max_log10_false_alarms", at_least=-math.inf)


def gate_failure(
    query: View,
    structure: Structure,
    matches: PointMatches,
    world_from_camera: RigidTransform,
    inliers: NDArray[np.bool_],
    inlier_px: float,
    options: GateOptions,
    log10_chance: float = 0.0,
) -> str | None:
    """Why a pose fails the gate, in one sentence; None if it passes.

    Args:
        query: the photograph.
        structure: metric points.
        matches: of the query with them.
        world_from_camera: the pose.
        inliers: (M,) which of the matches are inliers; at least four.
        inlier_px: largest reprojection error of an inlier.
        options: see there.
        log10_chance: see `Priors.log10_chance`.
    """
    expected = log10_false_alarms(query.camera, matches, inliers, inlier_px) + log10_chance
    count = f"{inliers.sum()} of {len(matches)} matches agree on a pose"
    if expected > options.max_log10_false_alarms:
        return f"{count}, which chance could do ({format_false_alarms(expected)})"
    less = options.agreeing_factor if log10_chance < 0 else 1.0
    findable = findable_count(query, structure, world_from_camera)
    if inliers.sum() < min(less * options.min_found_share * findable, options.enough_inliers):
        return f"{count}, but {findable} points should be found: repeated structure somewhere else, most likely"
    covered = hull_share(query, matches, inliers)
    if covered < less * options.min_hull_share:
        return f"{count}, but they cover only {100 * covered:.1f} % of the image"
    return None


def findable_count(query: View, structure: Structure, world_from_camera: RigidTransform) -> int:
    """Number of points that project into the image, occluded or not; at most the number of its features."""
    size = np.array([query.camera.width_px, query.camera.height_px])
    projected = query.camera.project(world_from_camera.inverse().apply(structure.x_in_world))
    inside = int(((projected >= -0.5) & (projected < size - 0.5)).all(axis=1).sum())
    return min(inside, len(query.features))


def hull_share(query: View, matches: PointMatches, inliers: NDArray[np.bool_]) -> float:
    """Share of the image covered by the convex hull of the inliers (M,), three or more."""
    pixels = query.features.keypoints[matches.keypoint[inliers]]
    return float(ConvexHull(pixels, qhull_options="QJ").volume) / (query.camera.width_px * query.camera.height_px)


def log10_false_alarms(camera: Camera, matches: PointMatches, inliers: NDArray[np.bool_], inlier_px: float) -> float:
    """log10 of the expected number of poses with as many inliers among random matches.

    The chance of an inlier is the share of its disc in the image for matches found in the whole image, and in the
    search circle for guided matches. The smaller of the two groups' results is returned.
    """
    disc = inlier_px**2
    area = camera.width_px * camera.height_px / np.pi
    guided = matches.guided
    return min(
        false_alarms(int((~guided).sum()), int((inliers & ~guided).sum()), disc / area),
        false_alarms(int(guided.sum()), int((inliers & guided).sum()), disc / max(matches.radius_px**2, disc)),
    )


def false_alarms(match_count: int, inlier_count: int, chance: float) -> float:
    """log10 of (n - 3) C(n, k) C(k, 3) p^(k - 3), at least k of n matches agreeing with a pose through three of them.

    Args:
        match_count: n.
        inlier_count: k.
        chance: p, the probability that a wrong match agrees.
    """
    n, k = match_count, inlier_count
    if k <= 3 or chance >= 1:
        return np.inf
    return float((np.log(n - 3) + _log_choose(n, k) + _log_choose(k, 3) + (k - 3) * np.log(chance)) / np.log(10))


def format_false_alarms(log10_expected: float) -> str:
    """The number as text; it is infinite for three matches, which agree with a pose by construction."""
    if log10_expected == np.inf:
        return "any number of such poses expected"
    return f"10^{log10_expected:.1f} such poses expected"


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))
