"""Poses that are given in other conventions, each with the correction from what was given to what was meant.

A camera's axes are signed permutations of right, down and forward: 24 keep the hand, 24 are left-handed. If both world
and camera are mirrored, a rotation is still a rotation, so poses of left-handed engines pass all other checks.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product

import numpy as np

from mapless.geometry import Array, Quaternion, RigidTransform

from ...features.views import PosedView

PoseCorrection = Callable[[RigidTransform], RigidTransform]
ViewCorrection = Callable[[PosedView], PosedView]

USUAL, RARE, STRANGE = 0, 1, 2
"""How common a mistake is: of those that explain a scene equally well, only the most common are named."""


@dataclass(frozen=True, eq=False)
class Convention:
    """A way in which poses may be meant: how it is named, its correction, and how common it is."""

    text: str
    correct: PoseCorrection
    rarity: int

    def text_in(self, frame: str) -> str:
        """How it is named where the poses are not in the world, but in another frame, such as a session."""
        return self.text.replace("world", frame)


MIRROR = np.diag([1.0, -1.0, 1.0])
"""From a left-handed world to a right-handed one; which axis is mirrored changes no relative pose."""


def turned_camera(rotation: Array) -> PoseCorrection:
    """The correction that turns the camera's axes by a rotation (3, 3), in them."""
    return lambda pose: RigidTransform(pose.rotation @ rotation, pose.translation)


def _mirrored(axes: Array) -> PoseCorrection:
    return lambda pose: RigidTransform(MIRROR @ pose.rotation @ axes, MIRROR @ pose.translation)


def _reordered(order: tuple[int, int, int, int]) -> PoseCorrection:
    """The correction for a quaternion (x, y, z, w) whose parts were read in a wrong order."""

    def correct(pose: RigidTransform) -> RigidTransform:
        q = pose.quaternion()
        parts = (q.x, q.y, q.z, q.w)
        return RigidTransform(Quaternion(*(parts[i] for i in order)).matrix(), pose.translation)

    return correct


def _of_inverse(correction: PoseCorrection) -> PoseCorrection:
    """Applies a correction of world_from_camera to poses that are its inverse."""
    return lambda pose: correction(pose.inverse())


def _within_inverse(correction: PoseCorrection) -> PoseCorrection:
    """Applies a correction of camera_from_world to the inverse of poses."""
    return lambda pose: correction(pose.inverse()).inverse()


OPTICAL = "an optical frame (x right, y down, z forward)"
NEEDED = f"where {OPTICAL} is needed"
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
    for axes in _signed_permutations():
        if np.array_equal(axes, np.eye(3)):
            continue
        is_left_handed = np.linalg.det(axes) < 0
        words = _directions(axes)
        hand = "left-handed: " if is_left_handed else ""
        text, rarity = _KNOWN.get(words, (f"the camera axes are {hand}{words} {NEEDED}", STRANGE))
        yield Convention(text, _mirrored(axes.T) if is_left_handed else turned_camera(axes.T), rarity)


def _positions_axes() -> Iterator[Convention]:
    """Positions whose world axes are not those of the rotations."""
    for axes in _signed_permutations():
        if not np.array_equal(axes, np.eye(3)):
            names = ", ".join(f"{'-' if row.sum() < 0 else ''}{'xyz'[int(np.abs(row).argmax())]}" for row in axes)
            yield Convention(
                f"the positions are in other world axes than the rotations: ({names}) of the given x, y, z fits",
                lambda pose, axes=axes: RigidTransform(pose.rotation, axes @ pose.translation),  # type: ignore[misc]
                STRANGE,
            )


def _inverses() -> Iterator[Convention]:
    yield Convention("the poses are camera_from_world, not world_from_camera", RigidTransform.inverse, USUAL)
    for axes in _camera_axes():
        if axes.rarity != STRANGE:
            text = axes.text.removeprefix("the camera axes are ")
            name = "OpenGL's camera axes" if text.startswith("OpenGL's") else text
            rarity = RARE if axes.rarity == USUAL else STRANGE
            yield Convention(f"the poses are camera_from_world with {name}", _of_inverse(axes.correct), rarity)


_W_FIRST = _reordered((1, 2, 3, 0))
_W_LAST = _reordered((3, 0, 1, 2))


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
    named = (("w x y z and were read as x y z w", _W_FIRST), ("x y z w and were read as w x y z", _W_LAST))
    for words, correction in named:
        yield Convention(f"the quaternions are {words}", correction, USUAL)
        text = f"the quaternions of camera_from_world are {words}"
        yield Convention(text, _within_inverse(correction), RARE)


CONVENTIONS: tuple[Convention, ...] = (*_camera_axes(), *_inverses(), *_halves(), *_positions_axes())
"""All, the most common not first."""


def on_view(correct: PoseCorrection) -> ViewCorrection:
    """A correction of a view's pose."""
    return lambda view: replace(view, world_from_camera=correct(view.world_from_camera))
