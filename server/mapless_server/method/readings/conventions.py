"""Common mistakes in poses and intrinsics, each with the correction from what was given to what was meant.

If both world and camera are mirrored, a rotation is still a rotation, so poses of left-handed engines pass all other
checks.
"""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from mapless.geometry import Array, Quaternion, RigidTransform

from ..views import PosedView

Correction = Callable[[RigidTransform], RigidTransform]
ViewCorrection = Callable[[PosedView], PosedView]


def _turned_camera(rotation: Array) -> Correction:
    return lambda pose: RigidTransform(pose.rotation @ rotation, pose.translation)


def _mirrored(pose: RigidTransform) -> RigidTransform:
    mirror = np.diag([1.0, -1.0, 1.0])
    return RigidTransform(mirror @ pose.rotation @ mirror, mirror @ pose.translation)


def _reordered(order: tuple[int, int, int, int]) -> Correction:
    """The correction for a quaternion (x, y, z, w) whose parts were read in a wrong order."""

    def correct(pose: RigidTransform) -> RigidTransform:
        q = pose.quaternion()
        parts = (q.x, q.y, q.z, q.w)
        return RigidTransform(Quaternion(*(parts[i] for i in order)).matrix(), pose.translation)

    return correct


def _within_inverse(correction: Correction) -> Correction:
    """Applies a correction to the inverse of a pose, camera_from_world."""
    return lambda pose: correction(pose.inverse()).inverse()


_OPENGL = _turned_camera(np.diag([1.0, -1.0, -1.0]))
_QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
_W_FIRST = _reordered((1, 2, 3, 0))
_W_LAST = _reordered((3, 0, 1, 2))

CONVENTIONS: Mapping[str, Correction] = {
    "the camera axes are OpenGL's (x right, y up, z back) where the format has OpenCV's, or the reverse": _OPENGL,
    "the poses are camera_from_world, not world_from_camera": RigidTransform.inverse,
    "the poses are camera_from_world with OpenGL's camera axes": lambda pose: _OPENGL(pose.inverse()),
    "the quaternions are w x y z and were read as x y z w": _W_FIRST,
    "the quaternions are x y z w and were read as w x y z": _W_LAST,
    "the quaternions of camera_from_world are w x y z and were read as x y z w": _within_inverse(_W_FIRST),
    "the quaternions of camera_from_world are x y z w and were read as w x y z": _within_inverse(_W_LAST),
    "the poses are of images turned by 90 degrees (EXIF orientation)": _turned_camera(_QUARTER),
    "the poses are of images turned by 180 degrees (EXIF orientation)": _turned_camera(_QUARTER @ _QUARTER),
    "the poses are of images turned by 270 degrees (EXIF orientation)": _turned_camera(_QUARTER.T),
    "the axes are left-handed (y up, as in Unity)": _mirrored,
}
"""Corrections by what the report says of the mistake."""


def _posed(correction: Correction) -> ViewCorrection:
    return lambda view: replace(view, world_from_camera=correction(view.world_from_camera))


def _turned(quarters: int) -> ViewCorrection:
    """Correction of a photograph that was turned so often to the left, without its pose and its intrinsics."""

    def correct(view: PosedView) -> PosedView:
        camera = view.view.camera
        fx, fy, x, y = camera.focal_x_px, camera.focal_y_px, camera.principal_x_px, camera.principal_y_px
        sides_px = [camera.width_px, camera.height_px]
        for remaining in range(quarters, 0, -1):
            fx, fy, x, y = fy, fx, y, sides_px[remaining % 2] - 1 - x
        camera = replace(camera, focal_x_px=fx, focal_y_px=fy, principal_x_px=x, principal_y_px=y)
        pose = _turned_camera(np.linalg.matrix_power(_QUARTER, quarters))(view.world_from_camera)
        return replace(view, view=replace(view.view, camera=camera), world_from_camera=pose)

    return correct


CORRECTIONS: Mapping[str, ViewCorrection] = {text: _posed(it) for text, it in CONVENTIONS.items()} | {
    f"poses and intrinsics are of images turned by {90 * it} degrees (EXIF orientation)": _turned(it)
    for it in (1, 2, 3)
}
