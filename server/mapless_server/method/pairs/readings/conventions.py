"""Poses that are given in other conventions, each with the correction from what was given to what was meant.

A camera's axes are signed permutations of right, down and forward: 24 keep the hand, 24 are left-handed. If both world
and camera are mirrored, a rotation is still a rotation, so poses of left-handed engines pass all other checks.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import reduce
from itertools import islice, permutations, product
from typing import Generic, TypeVar

import numpy as np

from mapless.geometry import Array, Quaternion, RigidTransform

T = TypeVar("T")

PoseCorrection = Callable[[RigidTransform], RigidTransform]

USUAL, RARE, STRANGE = range(3)
"""How common a mistake is: of those that explain a scene equally well, only the most common are named."""


@dataclass(frozen=True, eq=False)
class Mistake(Generic[T]):
    """A way in which data (poses or views) may have been misread: its name, its correction, and how common it is."""

    text: str
    correct: Callable[[T], T]
    rarity: int


Convention = Mistake[RigidTransform]

MIRROR = np.diag([1.0, -1.0, 1.0])
"""From a left-handed world to a right-handed one; which axis is mirrored changes no relative pose."""


def _with_axes(world: Array, camera: Array) -> PoseCorrection:
    """The correction that changes the axes of the world and those of the camera by matrices (3, 3)."""
    return lambda pose: RigidTransform(world @ pose.rotation @ camera, world @ pose.translation)


def _reordered(order: tuple[int, int, int, int]) -> PoseCorrection:
    """The correction for a quaternion (x, y, z, w) whose parts were read in a wrong order."""

    def correct(pose: RigidTransform) -> RigidTransform:
        q = pose.quaternion()
        parts = (q.x, q.y, q.z, q.w)
        return RigidTransform(Quaternion(*(parts[i] for i in order)).matrix(), pose.translation)

    return correct


def _with_positions(axes: Array) -> PoseCorrection:
    """The correction for positions whose axes (3, 3) are not those of the rotations."""
    return lambda pose: RigidTransform(pose.rotation, axes @ pose.translation)


def _in_turn(*corrections: PoseCorrection) -> PoseCorrection:
    """The correction that applies these one after the other."""
    return lambda pose: reduce(lambda it, correct: correct(it), corrections, pose)


NEEDED = "where an optical frame (x right, y down, z forward) is needed"
_DIRECTIONS = (("right", "left"), ("down", "up"), ("forward", "back"))
_KNOWN = {
    "x right, y up, z back": (
        "the camera axes are OpenGL's (x right, y up, z back) where the format has OpenCV's, or the reverse",
        USUAL,
    ),
    "x forward, y left, z up": (
        f"the camera axes are a robot's body axes (REP 103: x forward, y left, z up) {NEEDED}",
        USUAL,
    ),
    "x up, y back, z right": (
        "the optical axes were converted as if they were a robot's body axes (REP 103: x forward, y left, z up)",
        RARE,
    ),
    "x forward, y right, z down": (
        f"the camera axes are a vehicle's body axes (x forward, y right, z down) {NEEDED}",
        RARE,
    ),
    "x up, y right, z forward": ("the poses are of images turned by 90 degrees (EXIF orientation)", USUAL),
    "x left, y up, z forward": ("the poses are of images turned by 180 degrees (EXIF orientation)", USUAL),
    "x down, y left, z forward": ("the poses are of images turned by 270 degrees (EXIF orientation)", USUAL),
    "x right, y up, z forward": ("the axes are left-handed (y up, as in Unity)", USUAL),
    "x forward, y right, z up": ("the axes are left-handed (x forward, y right, z up, as in Unreal)", RARE),
}
"""By the directions of a camera's x, y and z."""


def _signed_permutations() -> Iterator[Array]:
    """The 48 matrices (3, 3), the identity first."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            matrix = np.zeros((3, 3))
            matrix[list(order), range(3)] = signs
            yield matrix


def _directions(axes: Array) -> str:
    """Directions of the columns of a signed permutation (3, 3), optical axes from the camera's."""
    words = [_DIRECTIONS[int(np.abs(column).argmax())][int(column.sum() < 0)] for column in axes.T]
    return ", ".join(f"{name} {word}" for name, word in zip("xyz", words, strict=True))


def _camera_axes() -> Iterator[Convention]:
    for axes in islice(_signed_permutations(), 1, None):
        is_left_handed = np.linalg.det(axes) < 0
        words = _directions(axes)
        hand = "left-handed: " if is_left_handed else ""
        text, rarity = _KNOWN.get(words, (f"the camera axes are {hand}{words} {NEEDED}", STRANGE))
        yield Convention(text, _with_axes(MIRROR if is_left_handed else np.eye(3), axes.T), rarity)


def _positions_axes() -> Iterator[Convention]:
    """Positions whose world axes are not those of the rotations."""
    for axes in islice(_signed_permutations(), 1, None):
        names = ", ".join(f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in axes)
        text = f"the positions are in other world axes than the rotations: ({names}) of the given x, y, z fits"
        yield Convention(text, _with_positions(axes), STRANGE)


def _inverses() -> Iterator[Convention]:
    yield Convention("the poses are camera_from_world, not world_from_camera", RigidTransform.inverse, USUAL)
    for axes in _camera_axes():
        if axes.rarity != STRANGE:
            text = axes.text.removeprefix("the camera axes are ")
            name = "OpenGL's camera axes" if text.startswith("OpenGL's") else text
            rarity = RARE if axes.rarity == USUAL else STRANGE
            correct = _in_turn(RigidTransform.inverse, axes.correct)
            yield Convention(f"the poses are camera_from_world with {name}", correct, rarity)


def _halves() -> Iterator[Convention]:
    """Rotations that are read otherwise than positions."""
    yield Convention(
        "the rotations are transposed: camera_from_world (or given by columns, or conjugate quaternions) beside "
        "positions in the world",
        lambda pose: RigidTransform(pose.rotation.T, pose.translation),
        USUAL,
    )
    yield Convention(
        "the positions are the translations of camera_from_world, beside rotations of world_from_camera",
        lambda pose: RigidTransform(pose.rotation, -(pose.rotation @ pose.translation)),
        USUAL,
    )
    orders = {"w x y z and were read as x y z w": (1, 2, 3, 0), "x y z w and were read as w x y z": (3, 0, 1, 2)}
    for words, order in orders.items():
        correct = _reordered(order)
        yield Convention(f"the quaternions are {words}", correct, USUAL)
        of_inverse = _in_turn(RigidTransform.inverse, correct, RigidTransform.inverse)
        yield Convention(f"the quaternions of camera_from_world are {words}", of_inverse, RARE)


CONVENTIONS: tuple[Convention, ...] = (*_camera_axes(), *_inverses(), *_halves(), *_positions_axes())
"""All, the most common not first."""
