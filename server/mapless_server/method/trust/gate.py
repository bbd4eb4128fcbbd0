"""Whether a pose is one at all: what wrong matches alone could support as well is not.

Wrong matches must not be expected to support a pose so well (a-contrario model estimation, Moisan and Stival 2004), and
repeated texture, whose wrong matches do agree with each other, lacks two things that a true pose has: what should be
seen is found, and not in one corner only.

This is the coarse sieve, before anything dear is computed; how far to trust what passes it is the judge's (`judge`).
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
        max_log10_false_alarms: a pose is one when fewer than 10 to this power poses supported as well are expected
            from wrong matches.
        min_found_share: least share of the points inside the image that are inliers; a photograph with fewer features
            than that has points can show no more of them than it has features. Of 200 photographs posed rightly,
            hard ones among them, the worst had 0.10; of those posed wrongly by chance or repetition most had 0.01.
        enough_inliers: so many are believed whatever else should be visible: with many references the structure reaches
            far beyond what one photograph can show. Repetition has fooled no more than 23.
        min_hull_share: least share of the image that the inliers' convex hull covers. On the same photographs the worst
            right one had 0.08; a repeated floor tile that fooled 16 matches had 0.03.
        agreeing_factor: on both shares where gravity or heading agrees with the pose. Of 120 poses found by chance none
            agreed with gravity to a degree. Of 23 photographs with few or distant references whose pose agreed and
            found too little, none was somewhere else: 14 were off by less than 10 cm, none by more than 30.
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


def doubts(
    query: View,
    structure: Structure,
    matches: PointMatches,
    world_from_camera: RigidTransform,
    inliers: NDArray[np.bool_],
    inlier_px: float,
    options: GateOptions,
    log10_chance: float = 0.0,
) -> str | None:
    """What speaks against a pose, in one sentence; None if nothing does.

    Args:
        query: the photograph.
        structure: metric points.
        matches: of the query with them.
        world_from_camera: the pose.
        inliers: (M,) which of the matches agree with it; at least four.
        inlier_px: within which they do.
        options: see there.
        log10_chance: how improbable it is that a pose found by chance agrees with what is known of it (see `priors`).
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
    """Points of the structure that lie inside the image, hidden or not; at most as many as it has features."""
    size = np.array([query.camera.width_px, query.camera.height_px])
    projected = query.camera.project(world_from_camera.inverse().apply(structure.x_in_world))
    inside = int(((projected >= -0.5) & (projected < size - 0.5)).all(axis=1).sum())
    return min(inside, len(query.features))


def hull_share(query: View, matches: PointMatches, inliers: NDArray[np.bool_]) -> float:
    """Share of the image that the convex hull of the inliers (M,), three or more, covers."""
    pixels = query.features.keypoints[matches.keypoint[inliers]]
    return float(ConvexHull(pixels, qhull_options="QJ").volume) / (query.camera.width_px * query.camera.height_px)


def log10_false_alarms(camera: Camera, matches: PointMatches, inliers: NDArray[np.bool_], inlier_px: float) -> float:
    """Expected number, as a power of ten, of poses that random matches would support as well.

    Matches found in the whole image hit an inlier's disc by chance with its share of the image; matches searched within
    a radius with its share of that circle. The stronger of the two groups decides.
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
    """The number for a person; three matches agree with a pose by construction, which no number tells."""
    if log10_expected == np.inf:
        return "any number of such poses expected"
    return f"10^{log10_expected:.1f} such poses expected"


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))
