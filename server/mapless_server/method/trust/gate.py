"""Gate: rejects poses that chance could support as well.

A pose must have more inliers than wrong matches can be expected to give (a-contrario model estimation, Moisan and
Stival 2004). This is a cheap first test, which means the same for every scene; wrong matches of repeated texture agree
with one another and pass it. `judge` computes the trust of poses that pass.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

from mapless.geometry import Camera

from ..results import PointMatches

MAX_LOG10_FALSE_ALARMS = -3.0
"""Largest log10 of the expected number of poses with as many inliers among wrong matches."""


def gate_failure(
    camera: Camera,
    matches: PointMatches,
    inliers: NDArray[np.bool_],
    inlier_px: float,
    log10_chance: float = 0.0,
) -> str | None:
    """Says in one sentence why a pose fails the gate; None if it passes.

    Args:
        camera: camera of the photograph.
        matches: matches of the photograph with the points of a structure.
        inliers: (M,) which of them are inliers of the pose; at least four.
        inlier_px: largest reprojection error of an inlier.
        log10_chance: see `Priors.log10_chance`.
    """
    expected = log10_false_alarms(camera, matches, inliers, inlier_px) + log10_chance
    if expected <= MAX_LOG10_FALSE_ALARMS:
        return None
    count = f"{inliers.sum()} of {len(matches)} matches agree on a pose"
    return f"{count}, which chance could do ({format_false_alarms(expected, MAX_LOG10_FALSE_ALARMS)})"


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


def false_alarms(match_count: int, inlier_count: int, chance: float, sample: int = 3) -> float:
    """Log10 of (n - m) C(n, k) C(k, m) p^(k - m): at least k of n matches agree with a pose through m of them.

    Args:
        match_count: n.
        inlier_count: k.
        chance: p, the probability that a wrong match agrees.
        sample: m, the number of matches that determine a pose.
    """
    n, k, m = match_count, inlier_count, sample
    if k <= m or chance >= 1:
        return np.inf
    return float((np.log(n - m) + _log_choose(n, k) + _log_choose(k, m) + (k - m) * np.log(chance)) / np.log(10))


def log10_tail(match_count: int, inlier_count: int, chance: float) -> float:
    """log10 of an upper bound of the probability of k or more inliers of n wrong matches, (n + 1) C(n, k) p^k."""
    n, k = match_count, inlier_count
    return float(min(0.0, (np.log(n + 1) + _log_choose(n, k) + k * np.log(chance)) / np.log(10)))


def format_false_alarms(log10_expected: float, log10_allowed: float) -> str:
    """Formats the expected number and its bound; it is infinite for three matches, which agree by construction."""
    expected, allowed = (
        f"{float(f'{10**it:.2g}'):g}" if -4 <= it < 5 else f"10^{it:.1f}".removesuffix(".0")
        for it in (log10_expected, log10_allowed)
    )
    if log10_expected == np.inf:
        expected = "many"
    return f"{expected} such poses expected by chance, at most {allowed} allowed"


def _log_choose(n: int, k: int) -> float:
    return float(gammaln(n + 1) - gammaln(k + 1) - gammaln(n - k + 1))
