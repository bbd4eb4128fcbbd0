"""Poses, times and covariances of ROS messages."""

from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np

from mapless.geometry import Array, Quaternion, RigidTransform, cross_matrix


def stamp_ns_of(stamp: Any) -> int:
    """Nanoseconds of a builtin_interfaces/Time."""
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def time_of(stamp_ns: int) -> datetime:
    """The moment of a stamp, to the microsecond."""
    seconds, rest_ns = divmod(stamp_ns, 1_000_000_000)
    return datetime.fromtimestamp(seconds, timezone.utc) + timedelta(microseconds=rest_ns // 1000)


def transform_from_pose(pose: Any) -> RigidTransform:
    """Converts a geometry_msgs/Pose; ValueError if its numbers are not a pose."""
    return _transform(pose.position, pose.orientation)


def transform_from_message(transform: Any) -> RigidTransform:
    """Converts a geometry_msgs/Transform; ValueError if its numbers are not a transform."""
    return _transform(transform.translation, transform.rotation)


def pose_of_body(
    map_from_camera: RigidTransform, covariance: Array, body_from_camera: RigidTransform
) -> tuple[RigidTransform, Array]:
    """The pose of the body that carries a camera, and its covariance (6, 6).

    Both covariances are in ROS's order: x, y, z, then rotations about the map's fixed x, y, z; metres and radians.
    With `body_from_camera` inverted, it computes the camera's pose from the body's.
    """
    map_from_body = map_from_camera.compose(body_from_camera.inverse())
    # A body that stands r away from the camera moves by dt + w x r when the camera moves by dt and turns by w.
    moved = np.eye(6)
    moved[:3, 3:] = -cross_matrix(map_from_body.translation - map_from_camera.translation)
    return map_from_body, moved @ np.asarray(covariance, float) @ moved.T


def _transform(position: Any, orientation: Any) -> RigidTransform:
    translation = np.array([position.x, position.y, position.z], float)
    if not np.isfinite(translation).all():
        raise ValueError(f"position {translation.tolist()} is not finite")
    quaternion = Quaternion(orientation.x, orientation.y, orientation.z, orientation.w)
    return RigidTransform(quaternion.matrix(), translation)
