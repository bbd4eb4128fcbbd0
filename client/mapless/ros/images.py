"""ROS messages to what mapless takes and back: duck-typed, so that they are tested without ROS.

ROS (REP 103) has bodies with x forward, y left and z up, and cameras twice: `camera_link` in those axes, and
`camera_optical_frame` with x right, y down and z forward, which is OpenCV's and mapless's own. Images and their
intrinsics belong to the optical frame. The world is the scene's; for ROS it should have z up (REP 105's `map`).
"""

from __future__ import annotations

from datetime import datetime, timedelta, timezone
from typing import Any

import cv2
import numpy as np

import mapless
from mapless.axes import Axes, pose_to
from mapless.geometry import Array, cross_matrix

JPEG_QUALITY = 90

# Bytes a pixel, and what turns them into what OpenCV writes.
_ENCODINGS: dict[str, tuple[int, int | None]] = {
    "mono8": (1, None),
    "8UC1": (1, None),
    "bgr8": (3, None),
    "8UC3": (3, None),
    "rgb8": (3, cv2.COLOR_RGB2BGR),
    "bgra8": (4, cv2.COLOR_BGRA2BGR),
    "rgba8": (4, cv2.COLOR_RGBA2BGR),
}


def photo_from_image(message: Any) -> bytes:
    """The file that a sensor_msgs/CompressedImage holds, or the JPEG of a sensor_msgs/Image.

    Raises:
        ValueError: an unsupported encoding, or fewer bytes than the size needs.
    """
    if not hasattr(message, "encoding"):
        return bytes(message.data)
    if message.encoding not in _ENCODINGS:
        raise ValueError(f"encoding {message.encoding!r} is none of {', '.join(sorted(_ENCODINGS))}")
    channels, conversion = _ENCODINGS[message.encoding]
    if message.step < message.width * channels or len(message.data) < message.height * message.step:
        raise ValueError(f"an image of {message.width} x {message.height} needs more than {len(message.data)} bytes")
    rows = np.frombuffer(bytes(message.data), np.uint8)[: message.height * message.step].reshape(message.height, -1)
    pixels = rows[:, : message.width * channels].reshape(message.height, message.width, channels)
    image = pixels if conversion is None else cv2.cvtColor(pixels, conversion)
    encoded, jpeg = cv2.imencode(".jpg", np.ascontiguousarray(image), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    assert encoded
    return jpeg.tobytes()


def camera_from_info(message: Any) -> mapless.Camera:
    """The camera of a sensor_msgs/CameraInfo, for the image before rectification.

    Raises:
        ValueError: not calibrated, a lens that mapless does not know, or an image that is binned or a part.
    """
    if not message.k[0] > 0:
        raise ValueError("the camera is not calibrated: CameraInfo.k is zero")
    if message.binning_x > 1 or message.binning_y > 1 or message.roi.width or message.roi.height:
        raise ValueError("the image is binned, or a part of the sensor's: CameraInfo is not its own")
    return mapless.Camera(
        message.width,
        message.height,
        message.k[0],
        message.k[4],
        message.k[2],
        message.k[5],
        _lens(message.distortion_model, list(message.d)),
    )


def _lens(model: str, d: list[float]) -> mapless.RadialTangential | mapless.Fisheye | None:
    if not any(d):
        return None
    if model in ("plumb_bob", "rational_polynomial") and len(d) >= 5 and not any(d[5:]):
        return mapless.RadialTangential(*d[:5])
    if model == "equidistant" and len(d) == 4:
        return mapless.Fisheye(*d)
    raise ValueError(
        f"a lens {model!r} with {len(d)} coefficients: mapless has plumb_bob's five and equidistant's four"
    )


def time_from_stamp(stamp: Any) -> datetime:
    """The moment of a builtin_interfaces/Time, to the microsecond."""
    return datetime.fromtimestamp(stamp.sec, timezone.utc) + timedelta(microseconds=stamp.nanosec // 1000)


def body_pose(
    answer: mapless.LocalizationResult, body_from_camera_link: mapless.RigidTransform
) -> tuple[mapless.RigidTransform, Array | None]:
    """Pose of the body in the map, and its covariance (6, 6), both in ROS's axes and order.

    Args:
        answer: of the camera.
        body_from_camera_link: how the camera sits on the body, both with x forward, y left, z up: what
            `ros2 run tf2_ros tf2_echo base_link camera_link` shows. The identity: the camera is the body.
    """
    map_from_link = pose_to(Axes.ROS, answer.world_from_camera)
    map_from_body = map_from_link.compose(body_from_camera_link.inverse())
    if answer.covariance is None:
        return map_from_body, None
    # A body that stands r away from the camera moves by dt + w x r when the camera moves by dt and turns by w.
    moved = np.eye(6)
    moved[:3, 3:] = -cross_matrix(map_from_body.translation - map_from_link.translation)
    return map_from_body, moved @ answer.covariance @ moved.T


def fill_pose(message: Any, map_from_body: mapless.RigidTransform, covariance: Array, stamp: Any, frame_id: str) -> Any:
    """Fills a geometry_msgs/PoseWithCovarianceStamped; the stamp is the image's, not now's."""
    message.header.stamp = stamp
    message.header.frame_id = frame_id
    q = map_from_body.quaternion()
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    position.x, position.y, position.z = map(float, map_from_body.translation)
    orientation.x, orientation.y, orientation.z, orientation.w = q.x, q.y, q.z, q.w
    message.pose.covariance = np.array(covariance, np.float64).ravel()  # serializers want an array
    return message
