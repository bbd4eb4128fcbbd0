"""Depth images of sensor_msgs/Image and CompressedImage, and the one that belongs to a photograph.

`16UC1` is millimetres and `32FC1` metres (REP 118), 0 or NaN where there is none. image_transport's `compressedDepth`
has a header of 12 bytes and a PNG: of millimetres, or of quantized inverse depths for `32FC1`.
"""

import struct
import threading
from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.depth import DepthImage, DepthSensor
from mapless.geometry import RigidTransform

from .camera_infos import CameraInfos
from .cameras import RosCamera
from .images import PNG_COMPRESSION
from .poses import stamp_ns_of

MILLIMETRES, METRES = "16UC1", "32FC1"
_VALUES = {MILLIMETRES: "u2", "mono16": "u2", METRES: "f4"}
_PNG = b"\x89PNG\r\n\x1a\n"
_TRANSPORT = "compressedDepth"
_HEADER = struct.Struct("<iff")
"""The header of `compressedDepth`: a format, and two numbers by which inverse depths were quantized."""

Values = NDArray[np.uint16] | NDArray[np.float32]


def depth_values(message: Any) -> Values:
    """Values (H, W) of an Image or CompressedImage: uint16 millimetres, or float32 metres.

    ValueError for another encoding, fewer bytes than the size needs, or a file that cannot be decoded.
    """
    if not hasattr(message, "encoding"):
        return _decompressed(message)
    kind = _VALUES.get(message.encoding)
    if kind is None:
        raise ValueError(f"encoding {message.encoding!r} is none of a depth: {', '.join(_VALUES)}")
    height, width, step = message.height, message.width, message.step
    row_bytes, data = width * int(kind[1]), np.frombuffer(bytes(message.data), np.uint8)
    if not (height > 0 and width > 0 and step >= row_bytes and len(data) >= height * step):
        raise ValueError(f"a depth of {width} x {height} with rows of {step} bytes cannot have {len(data)} bytes")
    rows = np.ascontiguousarray(data[: height * step].reshape(height, step)[:, :row_bytes])
    values = rows.view((">" if message.is_bigendian else "<") + kind)
    return np.asarray(values, values.dtype.newbyteorder("="))


def _decompressed(message: Any) -> Values:
    data, encoding = bytes(message.data), message.format.partition(";")[0].strip()
    first = second = 0.0
    if _TRANSPORT in message.format:
        if len(data) < _HEADER.size:
            raise ValueError(f"a depth of format {message.format!r} has {len(data)} bytes, fewer than its header")
        (_, first, second), data = _HEADER.unpack_from(data), data[_HEADER.size :]
    if encoding not in _VALUES or not data.startswith(_PNG):
        raise ValueError(
            f"a depth of format {message.format!r} is not read: known are PNGs of {', '.join(_VALUES)}, also as "
            f"{_TRANSPORT}"
        )
    values = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None or values.ndim != 2 or values.dtype != np.uint16:
        raise ValueError(f"a depth of format {message.format!r} is no PNG with one channel of 16 bits")
    if encoding != METRES:
        return np.asarray(values, np.uint16)
    steps = values.astype(np.float32) - np.float32(second)
    known = (values > 0) & (steps > 0)
    return np.where(known, np.float32(first) / np.where(known, steps, 1), 0).astype(np.float32)


def _undistorted(values: Values, maps: tuple[NDArray[Any], NDArray[Any]]) -> Values:
    """Values (H, W) moved by the maps of a camera; nearest, since between two surfaces there is none."""
    # With maps of fixed point, nearest would be the pixel below.
    columns, rows = cv2.convertMaps(*maps, cv2.CV_32FC1)
    moved = np.asarray(cv2.remap(values, columns, rows, cv2.INTER_NEAREST))
    return moved.astype(np.uint16) if values.dtype == np.uint16 else moved.astype(np.float32)


def depth_image(values: Values, sensor: DepthSensor = DepthSensor.UNKNOWN) -> DepthImage:
    """The depth image of values (H, W), uint16 millimetres as a PNG or float32 metres, of the photograph's camera."""
    if values.dtype != np.uint16:
        return DepthImage.of_metres(np.asarray(values, np.float32), sensor)
    done, file = cv2.imencode(".png", values, [cv2.IMWRITE_PNG_COMPRESSION, PNG_COMPRESSION])
    if not done:
        raise ValueError(f"OpenCV cannot encode a depth of shape {values.shape}")
    return DepthImage(file.tobytes(), 0.001, sensor=sensor)


def sensor_of(name: str) -> DepthSensor:
    """The kind of sensor that the parameter depth_sensor names; ValueError for another name."""
    known = {it.value: it for it in DepthSensor}
    if name not in known:
        raise ValueError(f"depth_sensor must be one of {', '.join(known)}, is {name!r}")
    return known[name]


@dataclass(frozen=True, eq=False)
class RosDepth:
    """A depth message, with the camera of its CameraInfo, or None if it has none.

    Attributes:
        message: sensor_msgs/Image or CompressedImage.
        camera: the depth camera; None for the photograph's, scaled.
        sensor: the kind of sensor.
    """

    message: Any
    camera: RosCamera | None = None
    sensor: DepthSensor = DepthSensor.UNKNOWN

    @property
    def frame(self) -> str:
        """The frame of the depth camera."""
        return str(self.message.header.frame_id).lstrip("/")

    def image(self, photo: RosCamera, camera_from_depth_camera: RigidTransform | None) -> DepthImage:
        """The depth image, of the photograph of a camera.

        The pose of the depth camera in the photograph's is None if both have one frame. ValueError if the message
        cannot be read, its size is not that of its camera, or it has another frame and no camera.
        """
        values = depth_values(self.message)
        size = values.shape[1], values.shape[0]
        camera = self.camera or (photo if camera_from_depth_camera is None else None)
        if camera is None:
            raise ValueError(f"the depth is of another frame, {self.frame}, and no camera_info of it has come")
        known = camera.camera.width_px, camera.camera.height_px
        if self.camera is not None and size != known:
            raise ValueError(f"the depth has {_by(size)} pixels, its CameraInfo {_by(known)}")
        if abs(size[0] * known[1] - size[1] * known[0]) > max(known):
            raise ValueError(f"the depth has {_by(size)} pixels, another aspect than the image's {_by(known)}")
        if camera.undistortion is not None:
            if size != known:
                raise ValueError(
                    f"the image is undistorted, so the depth needs its size, {_by(known)}: has {_by(size)}"
                )
            values = _undistorted(values, camera.undistortion)
        found = depth_image(values, self.sensor)
        if self.camera is None or (camera_from_depth_camera is None and self.camera.camera == photo.camera):
            return found
        return replace(found, camera=self.camera.camera, camera_from_depth_camera=camera_from_depth_camera)


class Depths:
    """The last messages of a depth topic, with their cameras. May be used by several threads."""

    def __init__(
        self, sensor: DepthSensor = DepthSensor.UNKNOWN, tolerance_s: float = 0.02, wait_s: float = 0.1, kept: int = 30
    ) -> None:
        """`tolerance_s` bounds how far depth and photograph may be apart; `wait_s`, how long one may come later.

        ValueError if a number is out of its range.
        """
        if not 0 <= tolerance_s <= 1:
            raise ValueError(f"depth_tolerance must be 0 to 1 s, is {tolerance_s:g}")
        self._sensor, self._tolerance_ns, self._wait_s = sensor, round(1e9 * tolerance_s), wait_s
        self._messages: deque[Any] = deque(maxlen=kept)
        self._infos = CameraInfos(kept=kept)
        self._has_come = threading.Condition()

    def add_camera(self, message: Any, time_ns: int = 0) -> None:
        """Adds a CameraInfo of the depth camera; ValueError as of `CameraInfos.add`."""
        self._infos.add(message, time_ns)

    def add(self, message: Any) -> None:
        """Adds a depth message."""
        with self._has_come:
            self._messages.append(message)
            self._has_come.notify_all()

    def at(self, stamp_ns: int) -> RosDepth:
        """The depth nearest in time to a photograph; it may come a little later.

        LookupError, with the time between them, if none is near enough.
        """

        def later() -> bool:
            return bool(self._messages) and _stamp(self._messages[-1]) >= stamp_ns

        with self._has_come:
            self._has_come.wait_for(later, self._wait_s)
            nearest = min(self._messages, key=lambda it: abs(_stamp(it) - stamp_ns), default=None)
        if nearest is None:
            raise LookupError("no depth has come yet")
        apart_ns = _stamp(nearest) - stamp_ns
        if abs(apart_ns) > self._tolerance_ns:
            when = "older" if apart_ns < 0 else "newer"
            raise LookupError(f"the nearest depth is {abs(apart_ns) / 1e6:.0f} ms {when} than the image")
        return RosDepth(nearest, self._infos.at(stamp_ns), self._sensor)


def _stamp(message: Any) -> int:
    return stamp_ns_of(message.header.stamp)


def _by(size: tuple[int, int]) -> str:
    return f"{size[0]} x {size[1]}"
