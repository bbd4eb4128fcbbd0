"""Usual mistakes in poses and intrinsics: what photographs' views would be if one of them had been made.

Each turns the views as they were given into what was meant. A pose with mirrored axes stays a rotation when both the
world and the camera are mirrored, which is how left-handed engines come through unnoticed.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from mapless.geometry import Array, Quaternion, RigidTransform
from mapless_server.method.views import PosedView

Correction = Callable[[RigidTransform], RigidTransform]

_OPENGL = np.diag([1.0, -1.0, -1.0])
_MIRROR = np.diag([1.0, -1.0, 1.0])
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def _turned_camera(rotation: Array) -> Correction:
    return lambda pose: RigidTransform(pose.rotation @ rotation, pose.translation)


def _inverse(pose: RigidTransform) -> RigidTransform:
    return pose.inverse()


def _mirrored(pose: RigidTransform) -> RigidTransform:
    return RigidTransform(_MIRROR @ pose.rotation @ _MIRROR, _MIRROR @ pose.translation)


def _reordered(order: tuple[int, int, int, int]) -> Correction:
    """The quaternion (x, y, z, w) of what was read, its parts taken in another order."""

    def correct(pose: RigidTransform) -> RigidTransform:
        q = pose.quaternion()
        parts = (q.x, q.y, q.z, q.w)
        return RigidTransform(Quaternion(*(parts[i] for i in order)).matrix(), pose.translation)

    return correct


def _within_inverse(correction: Correction) -> Correction:
    """The correction of camera_from_world."""
    return lambda pose: correction(pose.inverse()).inverse()


_W_FIRST = _reordered((1, 2, 3, 0))
_W_LAST = _reordered((3, 0, 1, 2))

CONVENTIONS: Mapping[str, Correction] = {
    "the camera axes are OpenGL's (x right, y up, z back)": _turned_camera(_OPENGL),
    "the poses are camera_from_world, not world_from_camera": _inverse,
    "the poses are camera_from_world with OpenGL's camera axes": lambda pose: _turned_camera(_OPENGL)(_inverse(pose)),
    "the quaternions are w x y z and were read as x y z w": _W_FIRST,
    "the quaternions are x y z w and were read as w x y z": _W_LAST,
    "the quaternions of camera_from_world are w x y z and were read as x y z w": _within_inverse(_W_FIRST),
    "the quaternions of camera_from_world are x y z w and were read as w x y z": _within_inverse(_W_LAST),
    "the poses are of images turned by 90 degrees (EXIF orientation)": _turned_camera(_QUARTER),
    "the poses are of images turned by 180 degrees (EXIF orientation)": _turned_camera(_QUARTER @ _QUARTER),
    "the poses are of images turned by 270 degrees (EXIF orientation)": _turned_camera(_QUARTER.T),
    "the axes are left-handed (y up, as in Unity)": _mirrored,
}
"""Corrections by what a person is told."""

FOCAL_SCALES = np.geomspace(0.2, 5.0, 33)
"""Wrong image sizes are usually wrong by a factor of up to four."""


def corrected(view: PosedView, correction: Correction) -> PosedView:
    """The view with the pose that was meant."""
    return replace(view, world_from_camera=correction(view.world_from_camera))


def focal_scaled(view: PosedView, scale: float) -> PosedView:
    """The view with another focal length."""
    camera = view.view.camera
    scaled = replace(camera, focal_x_px=scale * camera.focal_x_px, focal_y_px=scale * camera.focal_y_px)
    return replace(view, view=replace(view.view, camera=scaled))
