"""The way down: from gravity that a device wrote, else from the horizons of cameras that were held upright."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path

import numpy as np

from mapless.geometry import Array, RigidTransform
from mapless_server.scenes.plausibility import LEVEL_BOUND_DEG, MIN_CAMERAS, typical_down
from mapless_tools.ingest.metres import Finder, read_positions

from ..pictures import Part, PosedPicture

DOWN_OF_ORIENTATION = {
    1: (0, 1), 2: (0, 1), 3: (0, -1), 4: (0, -1), 5: (1, 0), 6: (1, 0), 7: (-1, 0), 8: (-1, 0),
}  # fmt: skip
"""Down in x right, y down of the stored raster, by EXIF's orientation: 6 and 8 are a phone held upright."""
GRAVITY_BOUND_DEG = 10.0
"""Directions of gravity further from their median contradict it: sensors of gravity are right within a degree, and
poses within less, but a hand that shakes adds its acceleration."""
HORIZON_SHARE = 0.5
"""Smallest share of the cameras whose horizons must agree."""
MAX_PAIRS = 400


@dataclass(frozen=True, eq=False)
class Down:
    """A unit vector (3,) down in the reconstruction's frame, its standard deviation, and the clause where it is from.

    Another direction contradicts it beyond `bound_deg`.
    """

    direction: Array
    sigma_deg: float
    bound_deg: float
    source: str
    is_measured: bool = True


def angle_deg(first: Array, second: Array) -> float:
    """The angle of two unit vectors (3,), degrees."""
    return math.degrees(2 * math.asin(min(1.0, float(np.linalg.norm(first - second)) / 2)))


def upright_axes(posed: PosedPicture) -> RigidTransform:
    """The pose of the camera turned upright by EXIF's orientation: x to the right, y down as a viewer sees it."""
    x, y = DOWN_OF_ORIENTATION[posed.picture.orientation]
    down, ahead = np.array([x, y, 0.0]), np.array([0.0, 0.0, 1.0])
    turned = np.column_stack([np.cross(down, ahead), down, ahead])
    pose = posed.world_from_camera
    return RigidTransform(pose.rotation @ turned, pose.translation)


def known_directions(file: Path) -> dict[str, Array]:
    """Unit vectors (3,) by name of a CSV file (name, x, y, z); ValueError if it cannot be read or a vector is zero."""
    vectors = read_positions(file)
    for name, vector in vectors.items():
        if not np.linalg.norm(vector) > 0:
            raise ValueError(f"{file}: the direction of {name} is zero")
    return {name: vector / np.linalg.norm(vector) for name, vector in vectors.items()}


def down_of_gravity(file: Path, part: Part, find: Finder) -> Down:
    """The mean of the directions that a CSV file has in cameras' axes; ValueError if most of them do not agree."""
    poses = {it.picture.name: it.world_from_camera for it in part.posed}
    units = {name: vector for name, vector in known_directions(file).items() if name in find}
    if not units:
        raise ValueError(f"{file}: none of its names is that of a photograph of this part")
    directions = np.array([poses[find(name).name].rotation @ vector for name, vector in units.items()])
    angles = np.degrees(np.arccos(np.clip(directions @ directions.T, -1, 1)))
    fits = angles[np.median(angles, axis=1).argmin()] <= GRAVITY_BOUND_DEG
    if fits.sum() * 2 <= len(fits):
        raise ValueError(
            f"{file}: only {fits.sum()} of {len(fits)} directions agree within {GRAVITY_BOUND_DEG:g} degrees: they "
            "must be in the camera's axes, x right, y down, z forward of the photograph as stored"
        )
    mean = directions[fits].mean(axis=0)
    mean /= np.linalg.norm(mean)
    scatter_deg = max(float(np.sqrt(np.mean([angle_deg(mean, it) ** 2 for it in directions[fits]]))), 0.5)
    left_out = "" if fits.all() else f", {(~fits).sum()} of {len(fits)} contradict it and are left out"
    source = f"gravity of {file.name}, {fits.sum()} directions to {scatter_deg:.1f} degrees{left_out}"
    return Down(mean, scatter_deg / math.sqrt(fits.sum()), GRAVITY_BOUND_DEG, source)


def down_of_horizons(part: Part) -> Down | None:
    """Down as most cameras show it, turned upright by EXIF; None if no half of them agrees."""
    poses = [upright_axes(it) for it in part.posed]
    agreeing = _level(poses)
    if len(agreeing) < max(MIN_CAMERAS, HORIZON_SHARE * len(poses)):
        return None
    level = [poses[i] for i in agreeing]
    typical = typical_down(level)
    if typical is None:
        return None
    sines = [float(it.rotation[:, 0] @ typical.direction) for it in level]
    roll_deg = math.degrees(math.asin(min(1.0, math.sqrt(sum(it**2 for it in sines) / len(sines)))))
    # With one direction of view nothing shows by how much all cameras are inclined.
    is_coarse = typical.bound_deg > LEVEL_BOUND_DEG
    sigma_deg = typical.bound_deg / 2 if is_coarse else max(roll_deg, 1.0) / math.sqrt(len(level)) + 0.5
    left_out = f", {len(poses) - len(level)} are rolled" if len(level) < len(poses) else ""
    how = "all look in one direction and may be inclined" if is_coarse else f"they roll by {roll_deg:.1f} degrees"
    source = f"the horizons of {len(level)} cameras, held upright ({how}{left_out})"
    return Down(typical.direction, sigma_deg, typical.bound_deg, source, is_measured=False)


def _level(poses: Sequence[RigidTransform]) -> list[int]:
    """The largest set of cameras that have one direction down: their x axes level, their y axes not upward."""
    x_axes, y_axes = (np.array([pose.rotation[:, axis] for pose in poses]) for axis in (0, 1))
    pairs = list(combinations(range(len(poses)), 2))
    if len(pairs) > MAX_PAIRS:
        chosen = np.random.default_rng(0).choice(len(pairs), MAX_PAIRS, replace=False)
        pairs = [pairs[i] for i in sorted(chosen)]
    first, second = np.array(pairs, int).reshape(-1, 2).T
    normals = np.cross(x_axes[first], x_axes[second])
    lengths = np.linalg.norm(normals, axis=1)
    normals = normals[lengths > 1e-3] / lengths[lengths > 1e-3, None]
    directions = np.concatenate([normals, -normals, y_axes])
    along = directions @ y_axes.T
    fits = (np.abs(directions @ x_axes.T) <= math.sin(math.radians(LEVEL_BOUND_DEG))) & (along > 0)
    best = int((fits * (1 + along)).sum(axis=1).argmax())
    return np.flatnonzero(fits[best]).tolist()
