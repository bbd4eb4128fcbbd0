"""Checks by poses alone whether a scene's datum, direction of gravity and unit of length fit its references.

People hold cameras upright, so the cameras' horizons show which way is down: their x axes are level. Where cameras
look in many directions, down is the direction perpendicular to these; where they look in one, their y axes show it
more coarsely, since they may all be inclined. A camera on its side has its x axis along gravity instead.

A wrong unit is found only if it makes positions impossible, since scale does not change any angle.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mapless.geodesy import geodetic_from_world
from mapless.geometry import Array, RigidTransform, rotation_angle_deg
from mapless_server.store import SceneAttributes

MIN_CAMERAS = 3
"""Fewer show no typical direction."""

LEVEL_SPREAD = 0.05
"""Largest mean squared cosine between the cameras' x axes and gravity: 13 degrees of roll."""

HEADING_SPREAD = 0.1
"""Smallest mean squared cosine of x axes along the second horizontal direction: headings that differ by 18 degrees."""

LEVEL_BOUND_DEG = 20.0
"""Largest angle to the down that horizons show. Hand-held cameras roll by some degrees."""

UPRIGHT_CONSTANCY = 0.7
"""Smallest length of the mean y axis that is a typical direction: 45 degrees about it."""

SIDEWAYS_CONSTANCY = 0.9
"""Smallest length of the mean x axis of cameras on their side."""

UPRIGHT_BOUND_DEG = 50.0
"""Largest angle to a mean axis: cameras may all be inclined by 45 degrees. Exchanged axes give about 90, a sign 180."""

MAX_RADIUS_M, MIN_RADIUS_M = 10_000.0, 0.01
"""Radii of positions about their median. Nobody photographs a scene of 20 km from the ground, and cameras within 1 cm
triangulate nothing beyond a metre; positions in millimetres or degrees do so."""

MAX_ORIGIN_DISTANCE_M = 10_000.0
"""Largest distance of references from a datum's origin; map projections' coordinates are thousands of kilometres away
from it."""

MIN_HEIGHT_M, MAX_HEIGHT_M = -500.0, 10_000.0
"""Heights of references above the ellipsoid: from the Dead Sea to above all mountains."""

DEGREES_SPREAD, DEGREES_SHARE, DEGREES_RATIO = 0.05, 0.01, 100.0
"""Latitudes and longitudes of a scene differ by 5 km at most, and by a hundredth of their own value; heights, in
metres, differ by a hundred times as much."""

STANDING_DEG, STANDING_ELONGATION = 3.0, 10.0
"""Largest angle between the poses of a camera that stands still, a few times the noise of trackers; and the largest
ratio of the two widest spreads of its positions: along a way it is larger."""

MIN_COMPARED, UNIT_RATIO = 5, 300.0
"""References whose spread says something, and the ratio of two spreads that indicates another unit: 1000 where both are
of the same place, and parts of a place differ by less."""


@dataclass(frozen=True, eq=False)
class TypicalDown:
    """Down as the cameras show it: a unit vector (3,) in the world, and the largest angle that is no contradiction."""

    direction: Array
    bound_deg: float


def typical_down(poses: Sequence[RigidTransform]) -> TypicalDown | None:
    """The direction down as upright cameras show it; None if they are too few or do not agree."""
    if len(poses) < MIN_CAMERAS:
        return None
    x_axes, y_axes = (np.array([pose.rotation[:, axis] for pose in poses]) for axis in (0, 1))
    mean_y = y_axes.mean(axis=0)
    spreads, directions = np.linalg.eigh(x_axes.T @ x_axes / len(poses))
    along = float(mean_y @ directions[:, 0])
    if spreads[0] <= LEVEL_SPREAD and spreads[1] >= HEADING_SPREAD and abs(along) >= 0.5:
        return TypicalDown(math.copysign(1.0, along) * directions[:, 0], LEVEL_BOUND_DEG)
    constancy = float(np.linalg.norm(mean_y))
    return TypicalDown(mean_y / constancy, UPRIGHT_BOUND_DEG) if constancy >= UPRIGHT_CONSTANCY else None


def contradictions(
    poses: Sequence[RigidTransform], attributes: SceneAttributes, added: Sequence[RigidTransform] = ()
) -> list[str]:
    """Contradictions of a scene's attributes and the poses of its references, one sentence each with its numbers.

    Poses of added references are examined together with the others, and alone if that finds nothing, since they may be
    too few to matter among the others.
    """
    together = [*poses, *added]
    if not together:
        return []
    found = [_down(together, attributes), _origin(together, attributes)]
    if not attributes.arbitrary_unit:
        found.append(_unit(together))
    if poses and added and not any(found):
        found = [_down(added, attributes), _origin(added, attributes), another_unit(poses, added)]
    return [text for text in found if text]


def another_unit(stored: Sequence[RigidTransform], added: Sequence[RigidTransform]) -> str:
    """One sentence if added poses spread hundreds of times as far as the scene's others, or less; else empty."""
    if min(len(stored), len(added)) < MIN_COMPARED:
        return ""
    radii = [radius_m(np.array([pose.translation for pose in poses])) for poses in (stored, added)]
    if not (min(radii) > 0 and max(radii) / min(radii) >= UNIT_RATIO) or stands(stored) or stands(added):
        return ""
    return (
        f"these references are {radii[1]:.3g} m from their median position, in the median, those of the scene "
        f"{radii[0]:.3g} m: are they in another unit (ratios under {UNIT_RATIO:g} are plausible)?"
    )


def radius_m(positions: Array) -> float:
    """Median distance of positions (N, 3) from their median, metres."""
    return float(np.median(np.linalg.norm(positions - np.median(positions, axis=0), axis=1)))


def _down(poses: Sequence[RigidTransform], attributes: SceneAttributes) -> str:
    down, typical = attributes.down(), typical_down(poses)
    if down is None or len(poses) < MIN_CAMERAS:
        return ""
    mean_x = np.mean([pose.rotation[:, 0] for pose in poses], axis=0)
    constancy = float(np.linalg.norm(mean_x))
    if constancy >= SIDEWAYS_CONSTANCY and (typical is None or typical.bound_deg == UPRIGHT_BOUND_DEG):
        if abs(float(mean_x @ down)) >= constancy * math.cos(math.radians(UPRIGHT_BOUND_DEG)):
            return ""  # cameras on their side
        if typical is None:
            sign = math.copysign(1.0, float(mean_x @ down))
            typical = TypicalDown(sign * mean_x / constancy, UPRIGHT_BOUND_DEG)
    if typical is None:
        return ""
    angle_deg = math.degrees(math.acos(min(max(float(down @ typical.direction), -1.0), 1.0)))
    if angle_deg <= typical.bound_deg:
        return ""
    named = "down_in_world" if attributes.down_in_world is not None else "the datum's down"
    likely = "; is it up?" if angle_deg > 180 - typical.bound_deg else ""
    return (
        f"{named} {_vector(down)} is {angle_deg:.0f} degrees off the down of {len(poses)} reference cameras, "
        f"{_vector(typical.direction)} if they are upright (at most {typical.bound_deg:.0f} are plausible){likely}"
    )


def _origin(poses: Sequence[RigidTransform], attributes: SceneAttributes) -> str:
    """The contradiction of positions that are far from the datum's origin."""
    datum = attributes.datum
    if datum is None:
        return ""
    median = np.median([pose.translation for pose in poses], axis=0)
    distance_m = float(np.linalg.norm(median))
    if distance_m > MAX_ORIGIN_DISTANCE_M:
        return (
            f"the references are {distance_m / 1000:.1f} km from the world's origin, which the datum places on the "
            f"Earth (at most {MAX_ORIGIN_DISTANCE_M / 1000:.0f} km are plausible): coordinates of a map projection, or "
            "another unit than metres?"
        )
    height_m = geodetic_from_world(median, datum).height_m
    if not MIN_HEIGHT_M <= height_m <= MAX_HEIGHT_M:
        return (
            f"by the datum the references are {height_m:.0f} m above the ellipsoid ({MIN_HEIGHT_M:.0f} to "
            f"{MAX_HEIGHT_M:.0f} m are plausible)"
        )
    return ""


def stands(poses: Sequence[RigidTransform]) -> bool:
    """Whether a camera stands still: it neither turns nor moves along a line, and its positions are noise.

    Positions of a moving one are as close in kilometres, but along a way, or with directions that change.
    """
    positions = np.array([pose.translation for pose in poses])
    if radius_m(positions) >= MIN_RADIUS_M:
        return False
    if any(rotation_angle_deg(poses[0].rotation.T @ pose.rotation) > STANDING_DEG for pose in poses):
        return False
    spreads = np.linalg.svd(positions - positions.mean(axis=0), compute_uv=False)
    return bool(spreads[0] <= STANDING_ELONGATION * spreads[1])


def _unit(poses: Sequence[RigidTransform]) -> str:
    """The contradiction of positions that nobody can have visited if they are in metres."""
    positions = np.array([pose.translation for pose in poses])
    if len(positions) < 2 or stands(poses):
        return ""
    text = _degrees(positions)
    if text:
        return text
    radius = radius_m(positions)
    if MIN_RADIUS_M <= radius <= MAX_RADIUS_M or (radius < MIN_RADIUS_M and len(positions) < MIN_COMPARED):
        return ""
    likely = "millimetres?" if radius > MAX_RADIUS_M else "kilometres or degrees? or did the camera only turn?"
    return (
        f"the references are {radius:.3g} m from their median position, in the median ({MIN_RADIUS_M:g} to "
        f"{MAX_RADIUS_M:g} m are plausible): is the unit not the metre? {likely}"
    )


def _degrees(positions: Array) -> str:
    """The contradiction of two coordinates that are latitudes and longitudes: nearly constant, unlike the third."""
    centre, spread = np.median(positions, axis=0), np.ptp(positions, axis=0)
    for third in range(3):
        pair = [axis for axis in range(3) if axis != third]
        size = np.abs(centre[pair])
        within = size.max() <= 180 and size.min() <= 90
        is_narrow = (spread[pair] > 0) & (spread[pair] <= np.minimum(DEGREES_SPREAD, DEGREES_SHARE * size))
        if within and is_narrow.all() and spread[third] >= DEGREES_RATIO * spread[pair].max():
            names = " and ".join("xyz"[axis] for axis in pair)
            return (
                f"{names} of the references look like latitudes and longitudes in degrees: all within "
                f"{spread[pair].max():.2g} of {_vector(centre[pair])}; poses must be in metres"
            )
    return ""


def _vector(numbers: Array) -> str:
    return f"({', '.join(f'{number:.4g}' for number in np.round(numbers, 6) + 0.0)})"
