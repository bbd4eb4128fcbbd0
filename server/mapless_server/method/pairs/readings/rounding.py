"""Poses that were written with few digits: the steps of their numbers, and the errors that these steps make.

Rounded numbers are multiples of a step. That alone is no mistake: poses of a simulator are so, too. It explains pairs
that do not fit if errors as large as theirs come of moving every pose within its steps.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from mapless.geometry import Array, RigidTransform, rotation_from_vector

from ...features.views import PosedView
from .errors import FEW_SHARE, PairSample, summary
from .repeats import EXACT_DIGITS, decimal

MIN_POSES = 4
"""Fewer poses may have round numbers by chance."""
DIGITS = range(-4, 7)
"""Digits after the point that are tried for positions; negative before it."""
MOST_ROTATION_DIGITS = 4
"""The same for rotations, from one on: more digits than these are enough."""
EXPLAINED_FACTOR = 3.0
"""Rounding explains errors that are at most so many times those that it makes."""


def steps_of(poses: Sequence[RigidTransform]) -> tuple[Array, float]:
    """Finds the steps of positions (3,), in the poses' unit, and of matrices or quaternions; 0 where there are none.

    A pose that is given several times counts once.
    """
    poses = list({pose.matrix().round(EXACT_DIGITS).tobytes(): pose for pose in poses}.values())
    if len(poses) < MIN_POSES:
        return np.zeros(3), 0.0
    positions = np.array([pose.translation for pose in poses])
    return np.array([_step(positions[:, axis]) for axis in range(3)]), _rotation_step(poses)


def _step(values: Array) -> float:
    """The largest decimal or single-precision step of which all values are multiples; 0 if they are constant."""
    if np.ptp(values) == 0:
        return 0.0
    for digits in DIGITS:
        step = decimal(digits)
        multiples = values / step
        if (np.abs(multiples - np.round(multiples)) <= np.maximum(1e-6, 1e-15 * np.abs(multiples) * 4)).all():
            return step if digits < DIGITS[-1] else 0.0
    if np.array_equal(values.astype(np.float32).astype(float), values):
        return float(np.spacing(np.float32(np.abs(values).max())))
    return 0.0


def _rotation_step(poses: Sequence[RigidTransform]) -> float:
    for digits in range(1, MOST_ROTATION_DIGITS + 1):
        rounded = [_is_of_rounded_matrix(pose, digits) or _is_of_rounded_quaternion(pose, digits) for pose in poses]
        if np.mean(rounded) >= FEW_SHARE:  # a rounded matrix is not always nearest to the rotation made of it
            return decimal(digits)
    return 0.0


def _is_of_rounded_matrix(pose: RigidTransform, digits: int) -> bool:
    rounded = np.round(pose.rotation, digits)
    u, _, vt = np.linalg.svd(rounded)
    return bool(np.abs(u @ vt - pose.rotation).max() < decimal(EXACT_DIGITS))


def _is_of_rounded_quaternion(pose: RigidTransform, digits: int) -> bool:
    q = pose.quaternion()
    numbers = np.array([q.x, q.y, q.z, q.w])
    rounded = np.round(numbers, digits)
    length = float(np.linalg.norm(rounded))
    return length > 0 and bool(np.abs(rounded / length - numbers).max() < decimal(EXACT_DIGITS))


def rounding_text(sample: PairSample, given_px: float) -> str:
    """Names the rounded numbers if rounding gives errors like the given median of the sample's pairs; else empty."""
    position, rotation = steps_of([view.world_from_camera for view in sample.views.values()])

    def explain(position: Array, rotation: float) -> bool:
        made_px, _ = summary(sample.measure(_moved(sample.views, position, rotation)))
        return given_px <= EXPLAINED_FACTOR * made_px

    parts = []
    if position.any() and explain(position, 0.0):
        names = [f"{name} to {step:.2g}" for name, step in zip("xyz", position, strict=True) if step]
        parts.append(f"the positions are rounded ({', '.join(names)})")
    if rotation and explain(np.zeros(3), rotation):
        parts.append(f"the rotations are rounded to {round(-math.log10(rotation))} digits")
    if not parts and rotation and position.any() and explain(position, rotation):
        parts.append("positions and rotations are rounded")
    if not parts:
        return ""
    return f"{' and '.join(parts)}: write all digits, or subtract a common origin from large coordinates first"


def _moved(views: Mapping[int, PosedView], position: Array, rotation: float) -> dict[int, PosedView]:
    """Views whose poses are moved by random parts of the steps, as rounding did; the same for the same views."""
    random = np.random.default_rng(len(views))
    moved = {}
    for i, view in views.items():
        pose = view.world_from_camera
        shift = random.uniform(-0.5, 0.5, 3) * position
        turn = random.uniform(-0.5, 0.5, 3) * rotation
        turned = RigidTransform(rotation_from_vector(turn) @ pose.rotation, pose.translation + shift)
        moved[i] = replace(view, world_from_camera=turned)
    return moved
