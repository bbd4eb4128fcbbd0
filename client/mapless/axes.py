"""Conversion of poses between the axes of OpenCV, ARKit, ARCore, Unity and ROS.

mapless itself uses OpenCV's: a camera's x points right, y down and z forward, in a right-handed world.

=========  ==============================  =============================================================
axes       a camera's x, y, z              the world
=========  ==============================  =============================================================
`OPENCV`   right, down, forward            as the scene has it
`ARKIT`    right, up, backward             as the scene has it (ARKit's own has y up)
`ARCORE`   right, up, backward (OpenGL)    as the scene has it (ARCore's own has y up)
`UNITY`    right, up, forward              left-handed: the scene's with the sign of z changed (y up)
`ROS`      forward, left, up (REP 103)     as the scene has it (REP 103's has z up)
=========  ==============================  =============================================================

World axes are never rotated, only mirrored for Unity, since the operator chooses the orientation of a scene's world:
one for headsets and phones should have y up, one for robots z up. A scene with z up is answered to ARKit as a pose in a
world with z up. The mirror leaves a world with y up one with y up.

Right, down and forward are those of the pixel raster as it was sent, whatever the device's posture: the photograph of a
phone that is held upright lies in the file, and is answered, as its landscape sensor saw it. That is what `ARFrame`'s
`capturedImage` and `camera.transform`, and ARCore's `acquireCameraImage` and `getPose`, refer to, too. For a raster
that was rotated before sending, or poses that rotate with the display (ARCore's `getDisplayOrientedPose`, Unity's
camera), `turned_raster` converts between the two.

Quaternions need no rule of their own: in each of these, Unity included, (x, y, z, w) stands for the same matrix.
"""

from enum import Enum

import numpy as np
from numpy.typing import ArrayLike

from .geometry import Array, RigidTransform


class Axes(Enum):
    """The axes of a platform; the table of this module defines them."""

    OPENCV = "opencv"
    ARKIT = "arkit"
    ARCORE = "arcore"
    UNITY = "unity"
    ROS = "ros"


def _constant(rows: ArrayLike) -> Array:
    matrix = np.array(rows, float)
    matrix.setflags(write=False)
    return matrix


_RIGHT_UP_BACKWARD = _constant(np.diag([1, -1, -1]))

CV_FROM_CAMERA = {
    Axes.OPENCV: _constant(np.eye(3)),
    Axes.ARKIT: _RIGHT_UP_BACKWARD,
    Axes.ARCORE: _RIGHT_UP_BACKWARD,
    Axes.UNITY: _constant(np.diag([1, -1, 1])),
    Axes.ROS: _constant([[0, -1, 0], [0, 0, -1], [1, 0, 0]]),
}
"""Each column is one of the camera's axes, in OpenCV's camera axes: ROS's x, forward, is OpenCV's (0, 0, 1)."""

WORLD_FROM_RIGHT_HANDED = {axes: _constant(np.diag([1, 1, -1 if axes is Axes.UNITY else 1])) for axes in Axes}
"""From the scene's world, or any other right-handed one, to the same in these axes. Its own inverse."""


def pose_to(axes: Axes, world_from_camera: RigidTransform) -> RigidTransform:
    """Converts a camera's pose from OpenCV's axes and a right-handed world to other axes.

    For Unity, too, the rotation has determinant 1, since world and camera are both mirrored.
    """
    if axes is Axes.OPENCV:
        return world_from_camera
    world = WORLD_FROM_RIGHT_HANDED[axes]
    rotation = world @ world_from_camera.rotation @ CV_FROM_CAMERA[axes]
    return RigidTransform(rotation, world @ world_from_camera.translation)


def pose_from(axes: Axes, world_from_camera: RigidTransform) -> RigidTransform:
    """Inverse of `pose_to`. It also converts a device's `session_from_camera`; its session is then right-handed."""
    world = WORLD_FROM_RIGHT_HANDED[axes]
    rotation = world @ world_from_camera.rotation @ CV_FROM_CAMERA[axes].T
    return RigidTransform(rotation, world @ world_from_camera.translation)


def world_from_session_in(
    axes: Axes, world_from_camera: RigidTransform, session_from_camera: RigidTransform
) -> RigidTransform:
    """Transform from a device's session to the world, both frames in these axes.

    Multiplied by the device's `session_from_camera` of a later moment, it gives the camera's pose in the world then.

    Args:
        axes: the axes of the device.
        world_from_camera: the pose of the answer, in OpenCV's axes.
        session_from_camera: the device's pose at the moment of capture, in the device's axes.
    """
    return pose_to(axes, world_from_camera).compose(session_from_camera.inverse())


def points_to(axes: Axes, x_in_world: ArrayLike) -> Array:
    """Converts points or directions (..., 3) from a right-handed world to the world of these axes."""
    return np.asarray(x_in_world, float) @ WORLD_FROM_RIGHT_HANDED[axes].T


def points_from(axes: Axes, x_in_world: ArrayLike) -> Array:
    """Inverse of `points_to`."""
    return np.asarray(x_in_world, float) @ WORLD_FROM_RIGHT_HANDED[axes]


def camera_points_to(axes: Axes, x_in_camera: ArrayLike) -> Array:
    """Converts points or directions (..., 3) from OpenCV's camera frame to the camera frame of these axes."""
    return np.asarray(x_in_camera, float) @ CV_FROM_CAMERA[axes]


def camera_points_from(axes: Axes, x_in_camera: ArrayLike) -> Array:
    """Inverse of `camera_points_to`."""
    return np.asarray(x_in_camera, float) @ CV_FROM_CAMERA[axes].T


def covariance_to(axes: Axes, covariance: ArrayLike) -> Array:
    """Converts the covariance (6, 6) of a pose to these axes; order x y z rx ry rz about fixed world axes (ROS's).

    A rotation by the vector w, R' = Exp(w) R, is in a mirrored world M R' = Exp(det(M) M w) M R: a mirror also reverses
    the sense of a rotation vector. The conversion is its own inverse.
    """
    signs = np.diag(WORLD_FROM_RIGHT_HANDED[axes])
    both = np.concatenate([signs, signs.prod() * signs])
    changed: Array = np.outer(both, both) * np.asarray(covariance, float)
    return changed


def covariance_from(axes: Axes, covariance: ArrayLike) -> Array:
    """Inverse of `covariance_to`."""
    return covariance_to(axes, covariance)


def turned_raster(world_from_camera: RigidTransform, clockwise_quarter_turns: int) -> RigidTransform:
    """Pose of the camera whose pixel raster is the given camera's, turned clockwise; both in OpenCV's axes.

    Args:
        world_from_camera: pose of the camera whose raster is turned.
        clockwise_quarter_turns: number of turns by 90 degrees; negative numbers turn counterclockwise. After one turn,
            a raster of W x H pixels has H x W, and its former left edge is its top.
    """
    turns = clockwise_quarter_turns % 4
    # What was up is now right, and what was right is now down.
    old_from_turned = np.linalg.matrix_power(np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]), turns)
    return RigidTransform(world_from_camera.rotation @ old_from_turned, world_from_camera.translation)
