"""Whether two references agree with their poses, by matches that the poses took no part in.

References are matched along the epipolar lines of their poses, so what remains of the matches says nothing of these.
The evidence is taken before: matches that are distinct by their descriptors, and that one fundamental matrix, estimated
from them alone, explains. If there are enough, the poses must satisfy them: their distance from the epipolar lines of
the poses is the error of the pair. A repeated pattern gives such matches, too, but then a good part of the others
satisfies poses that are right. Where the poses place most points behind the cameras, no distance is small enough.
"""

import numpy as np
from numpy.typing import NDArray

from ..features.limits import MAX_SIDE_PX
from ..features.views import Matches, PosedView
from .epipolar import MIN_MATCHES, QUICK_ITERATIONS, PosedMatches, fundamental_inliers

MAX_ERROR_PX = 3.0
"""Largest median error of a pair that agrees, pixels of an image of `MAX_SIDE_PX`. Evidence: scene-agreement."""

STATIONARY_PX = 35.0
"""The same for two references at one place, where only the rotation is compared: a camera turned by hand or on a tripod
does not turn about its centre, and what is near moves by some per cent of the image."""

AMBIGUOUS_SHARE = 0.25
"""Matches that satisfy the poses, as a share of those that contradict them, from which the pair says nothing."""

_MOST_MATCHES = 150
"""Matches from which the error of a pair is computed, at most."""

LARGEST_ERROR_PX = float(MAX_SIDE_PX)
"""The error of a pair whose points lie behind its cameras."""


def thinned(matches: Matches) -> Matches:
    """As many of the matches, evenly, as the error of a pair is computed from."""
    return matches[:: -(-len(matches) // _MOST_MATCHES) or 1]


def pair_error_px(first: PosedView, second: PosedView, matches: Matches) -> float | None:
    """Error of a pair: median distance of consistent matches from satisfying the poses; None if they do not show it.

    The matches (M, 2) are distinct ones that have not been filtered by the poses. The distance (see `epipolar`) is in
    pixels of an image whose longer side is 1024; the largest possible if most points are behind the cameras. For
    references at one place it is relative to `STATIONARY_PX`.
    """
    if len(matches) < MIN_MATCHES:
        return None
    matches = thinned(matches)
    per_px = MAX_SIDE_PX / max(max(it.view.camera.width_px, it.view.camera.height_px) for it in (first, second))
    posed = PosedMatches.of_pair(first, second, matches)
    (is_one_place,) = posed.are_at_one_place
    scale = per_px * MAX_ERROR_PX / STATIONARY_PX if is_one_place else per_px
    errors_px = scale * np.nan_to_num(np.abs(posed.distances_px()[0]), nan=np.inf)
    agreeing: NDArray[np.bool_] = errors_px <= MAX_ERROR_PX
    consistent = agreeing
    if agreeing.sum() < max(MIN_MATCHES, len(matches) / 2):  # else the matrix would be that of the poses
        consistent = fundamental_inliers(first.view, second.view, matches, QUICK_ITERATIONS)
        if not consistent.any():
            return None
        is_satisfied = float(np.median(errors_px[consistent])) <= MAX_ERROR_PX
        if not is_satisfied and agreeing.sum() > AMBIGUOUS_SHARE * consistent.sum():
            return None
    error_px = float(np.median(errors_px[consistent]))
    if error_px > MAX_ERROR_PX or is_one_place:
        return min(error_px, LARGEST_ERROR_PX)
    (behind_share,) = PosedMatches.of_pair(first, second, matches[consistent & agreeing]).behind_shares()
    return LARGEST_ERROR_PX if behind_share > 0.5 else error_px
