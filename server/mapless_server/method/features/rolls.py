"""How photographs are rolled against one another, and the rasters in which features that must be upright match them.

The roll of a photograph against a reference is the angle, clockwise, by which its raster has to be turned so that what
both show is upright in both alike. Features that match however the camera is rolled show it; so do poses.
"""

import math
from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from mapless.geometry import Array

from .views import Matches, View

UPRIGHT_DEG = 20.0
"""Learned features still match what is rolled by so much. Evidence: upright."""

ROUNDED_DEG = 5.0
"""Angles are rounded to this, so that slightly different matches lead to the same raster."""

MAX_RASTERS = 3
"""A photograph is turned in so many ways at most, since each costs as much as the photograph as it is."""

NEAR_SHARE = 0.05
"""Matches agree with a similarity of two images that are so near it, as a share of the width."""

MAX_SCALE = 8.0
"""Photographs that show something in sizes that differ more have no matches: wrong ones end in one patch of texture."""

LEAST_AGREEMENT = 4.5
"""Matches show a roll if they have at least this agreement. Evidence: place-agreement."""


class Similarity(NamedTuple):
    """The turn, scale and shift of the images on which most matches of a photograph and a reference agree.

    Attributes:
        clockwise_deg: the roll of the photograph against the reference.
        agreeing: number of matches that are near the similarity.
        total: number of all matches.
    """

    clockwise_deg: float
    agreeing: int
    total: int

    @property
    def agreement(self) -> float:
        """How little like chance it is: wrong matches lie where there is texture, so that some agree, too.

        Those of photographs of different places rarely reach three, whatever their number.
        """
        return self.agreeing / math.sqrt(self.total)


def similarity_of(query: View, reference: View, matches: Matches) -> Similarity | None:
    """The similarity that most matches agree with, by RANSAC; None without any.

    Depth and perspective make right matches agree only roughly.
    """
    if len(matches) < 4:
        return None
    ours, theirs = query.features.pixels(matches[:, 0]), reference.features.pixels(matches[:, 1])
    near_px = NEAR_SHARE * reference.camera.width_px
    found, inliers = cv2.estimateAffinePartial2D(
        ours[:, None], theirs[:, None], method=cv2.RANSAC, ransacReprojThreshold=near_px, maxIters=500
    )
    if not inliers.any() or not 1 / MAX_SCALE <= math.hypot(*found[:, 0]) <= MAX_SCALE:
        return None
    return Similarity(math.degrees(math.atan2(found[1, 0], found[0, 0])), int(inliers.sum()), len(matches))


def roll_of_rotation(reference_from_query: Array) -> float | None:
    """The roll, degrees clockwise, of a camera by its rotation (3, 3) in another's frame: that about the optical axis.

    Swing-twist decomposition: the twist about z is what is left when the optical axis is turned the shortest way. None
    if that turns it by more than 60 degrees: such cameras hardly show the same.
    """
    r = reference_from_query
    if r[2, 2] < 0.5:
        return None
    return math.degrees(math.atan2(r[1, 0] - r[0, 1], r[0, 0] + r[1, 1]))


def roll_of_directions(in_query: Array, in_reference: Array) -> float | None:
    """The roll, degrees clockwise, of a direction (3,) seen in two cameras; None within 30 degrees of an axis."""
    if min(np.hypot(*in_query[:2]), np.hypot(*in_reference[:2])) < 0.5:
        return None
    return math.degrees(math.atan2(in_reference[1], in_reference[0]) - math.atan2(in_query[1], in_query[0]))


def nearest_quarter(angle_deg: float) -> float:
    """The quarter turns nearest to an angle: 0, 90, 180 or 270 degrees; rasters turned by these keep their pixels."""
    return 90.0 * round(angle_deg / 90) % 360


def roll_about_axis(roll_deg: float) -> Array:
    """The rotation (3, 3) of a camera rolled by so much in the other's frame, both with the same optical axis."""
    cos, sin = math.cos(math.radians(roll_deg)), math.sin(math.radians(roll_deg))
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def rasters_of(rolls_deg: Sequence[float | None], counts: Sequence[int] | None = None) -> tuple[float, ...]:
    """The angles, degrees clockwise in [0, 360), by which to turn a photograph with these rolls to references.

    Those whose roll is None are left out. The references with the most matches come first, whose angles the rasters
    have (without `counts`, the first ones); the others are within twice `UPRIGHT_DEG` of one, if the largest number of
    rasters suffices. Empty if the photograph as it is suffices.
    """
    chosen: list[float] = []
    order = range(len(rolls_deg)) if counts is None else np.argsort(-np.asarray(counts), kind="stable")
    for roll_deg in (it for i in order if (it := rolls_deg[i]) is not None):
        if all(apart_deg(roll_deg, it) > 2 * UPRIGHT_DEG for it in chosen):
            rounded_deg = ROUNDED_DEG * round(roll_deg / ROUNDED_DEG) % 360
            chosen.append(0.0 if apart_deg(roll_deg, 0.0) <= UPRIGHT_DEG else rounded_deg)
    chosen = chosen[:MAX_RASTERS]
    return () if chosen == [0.0] else tuple(chosen)


def are_alike(first: Sequence[float], second: Sequence[float]) -> bool:
    """Whether features of the one rasters, by their angles, match what those of the others match."""
    pairs = zip(first, second, strict=False)
    return len(first) == len(second) and all(apart_deg(a, b) <= UPRIGHT_DEG / 2 for a, b in pairs)


def apart_deg(first_deg: float, second_deg: float) -> float:
    """The angle between two directions, 0 to 180 degrees."""
    return abs((first_deg - second_deg + 180) % 360 - 180)
