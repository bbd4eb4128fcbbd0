"""Recordings of robots, hand-built by `rosbags` from planted truth."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless.lenses import Fisheye, RadialTangential
from mapless.ros import Messages, Outcome

TYPES = get_typestore(Stores.ROS2_HUMBLE)
BEGIN_NS = 1_700_000_000_123_456_789
BASE_FROM_CAMERA = RigidTransform(
    np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]) @ rotation_from_vector([0.1, -0.2, 0.05]),
    np.array([0.31, -0.07, 0.42]),
)
"""A camera that looks forward, a little askew."""

Recorded = tuple[str, int, Any]
"""Topic, time of recording in nanoseconds, message."""


def class_of(name: str) -> Any:
    return TYPES.types[name]


def make(name: str, **fields: Any) -> Any:
    return class_of(name)(**fields)


MESSAGES = Messages(class_of)


def write_bag(path: Path, recorded: Iterable[Recorded], mcap: bool = True) -> Path:
    """A folder of rosbag2 with these messages, written in their order."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP if mcap else StoragePlugin.SQLITE3) as writer:
        connections: dict[str, Any] = {}
        for topic, time_ns, message in recorded:
            kind = message.__msgtype__
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=TYPES)
            writer.write(connections[topic], time_ns, TYPES.serialize_cdr(message, kind))
    return path


def image(stamp_ns: int, pixels: NDArray[Any], encoding: str, frame: str = "camera", padding: int = 0) -> Any:
    """A sensor_msgs/Image; `pixels` are rows as the encoding has them, (rows, values) or (H, W, channels)."""
    rows = pixels.reshape(len(pixels), -1).view(np.uint8)
    height = len(rows) * 2 // 3 if encoding in ("nv12", "nv21") else len(rows)
    width = pixels.shape[1]
    data = np.pad(rows, ((0, 0), (0, padding)), constant_values=77)
    return make(
        "sensor_msgs/msg/Image",
        header=MESSAGES.header(stamp_ns, frame),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(pixels.dtype.byteorder == ">"),
        step=data.shape[1],
        data=data.ravel(),
    )


def compressed(stamp_ns: int, file: bytes, kind: str = "jpeg", frame: str = "camera") -> Any:
    """A sensor_msgs/CompressedImage."""
    data = np.frombuffer(file, np.uint8)
    header = MESSAGES.header(stamp_ns, frame)
    return make("sensor_msgs/msg/CompressedImage", header=header, format=kind, data=data)


def info(camera: Camera, stamp_ns: int = BEGIN_NS, **given: Any) -> Any:
    """The sensor_msgs/CameraInfo of a camera; fields that are `given` replace its own."""
    lens = camera.distortion
    roi = {"x_offset": 0, "y_offset": 0, "height": 0, "width": 0, "do_rectify": False}
    fields: dict[str, Any] = {
        "header": MESSAGES.header(stamp_ns, "camera"),
        "height": camera.height_px,
        "width": camera.width_px,
        "distortion_model": "equidistant" if isinstance(lens, Fisheye) else "plumb_bob",
        "d": np.array(list(vars(lens).values()) if lens is not None else [0.0] * 5),
        "k": camera.matrix().ravel(),
        "r": np.eye(3).ravel(),
        "p": np.c_[camera.matrix(), np.zeros(3)].ravel(),
        "binning_x": 0,
        "binning_y": 0,
        "roi": make("sensor_msgs/msg/RegionOfInterest", **roi),
    }
    return make("sensor_msgs/msg/CameraInfo", **(fields | given))


def pose_with_covariance(stamp_ns: int, frame: str, pose: RigidTransform, covariance: ArrayLike | None = None) -> Any:
    """A geometry_msgs/PoseWithCovarianceStamped."""
    filled = np.zeros((6, 6)) if covariance is None else np.asarray(covariance, float)
    return MESSAGES.pose(Outcome(stamp_ns, "OK", "", map_from_body=pose, covariance=filled, map_frame=frame))


def pose_stamped(stamp_ns: int, frame: str, pose: RigidTransform) -> Any:
    """A geometry_msgs/PoseStamped."""
    full = pose_with_covariance(stamp_ns, frame, pose)
    return make("geometry_msgs/msg/PoseStamped", header=full.header, pose=full.pose.pose)


def odometry(stamp_ns: int, pose: RigidTransform, frame: str = "odom", child: str = "base_link") -> Any:
    """A nav_msgs/Odometry that stands still."""
    zero = {"x": 0.0, "y": 0.0, "z": 0.0}
    still = make("geometry_msgs/msg/Vector3", **zero)
    twist = make("geometry_msgs/msg/Twist", linear=still, angular=still)
    full = pose_with_covariance(stamp_ns, frame, pose)
    return make(
        "nav_msgs/msg/Odometry",
        header=full.header,
        child_frame_id=child,
        pose=full.pose,
        twist=make("geometry_msgs/msg/TwistWithCovariance", twist=twist, covariance=np.zeros(36)),
    )


def transforms(stamp_ns: int, *edges: tuple[str, str, RigidTransform]) -> Any:
    """A tf2_msgs/TFMessage of parents, children and parent_from_child."""
    made = [MESSAGES.transform(stamp_ns, parent, child, pose) for parent, child, pose in edges]
    return make("tf2_msgs/msg/TFMessage", transforms=made)


def drive(time_s: float) -> RigidTransform:
    """Where the base is: straight on at 1 m/s and turning at 0.5 rad/s, so that both are linear in time."""
    return RigidTransform(rotation_from_vector([0.0, 0.0, 0.5 * time_s]), np.array([1.0 * time_s, 0.2, 0.0]))


def at(time_s: float) -> int:
    """The stamp of a time after the beginning."""
    return BEGIN_NS + round(time_s * 1e9)


def recorded_drive(
    camera: Camera,
    pictures: Sequence[NDArray[np.uint8]],
    period_s: float = 0.1,
    pose_period_s: float = 0.05,
    encoding: str = "bgr8",
) -> list[Recorded]:
    """A drive with odometry, the camera's place on the base in /tf_static, CameraInfo, and an image every period."""
    edges = ("base_link", "mount", RigidTransform.identity()), ("mount", "camera", BASE_FROM_CAMERA)
    found: list[Recorded] = [("/tf_static", at(0), transforms(at(0), *edges))]
    end_s = period_s * len(pictures)
    times_s = np.arange(-pose_period_s, end_s + pose_period_s, pose_period_s)
    found += [("/odom", at(time_s), odometry(at(time_s), drive(time_s))) for time_s in times_s]
    for number, picture in enumerate(pictures):
        stamp_ns = at(number * period_s)
        found.append(("/front/camera_info", stamp_ns, info(camera, stamp_ns)))
        bgr = cv2.cvtColor(picture, cv2.COLOR_RGB2BGR)
        found.append(("/front/image_raw", stamp_ns, image(stamp_ns, np.asarray(bgr, np.uint8), encoding)))
    return sorted(found, key=lambda it: it[1])


PLUMB_BOB = RadialTangential(-0.28, 0.07, 0.0002, -0.0001, 0.01)
EQUIDISTANT = Fisheye(0.02, -0.01, 0.003, -0.0005)
