"""Depth images that were measured with photographs, and what is known of their sensors."""

import hashlib
import json
import math
import os
from dataclasses import asdict, dataclass, replace
from enum import Enum
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import wire
from .geometry import Camera, RigidTransform
from .lenses import lens_model_of
from .v1 import geometry_pb2 as pb
from .wire import FieldError, joined

Source = bytes | str | os.PathLike[str]
"""Bytes, or the path of their file."""

_SENSORS: wire.ProtoEnum = pb.DepthSensor

MIN_UNIT_M, MAX_UNIT_M = 1e-6, 100.0
"""Bounds of the values of depth images."""
PLAUSIBLE_DEPTHS = 0.05, 200.0
"""Bounds of the median depth of a photograph, metres: with others the unit is most likely wrong."""
MAX_NOISE = {"constant_m": 1000.0, "linear": 1.0, "quadratic_per_m": 1000.0, "common": 1.0}
"""Largest numbers of a `DepthNoise` that a server accepts."""
LEAST_SIGMA, MOST_SIGMA = 1e-6, 1.0
"""Bounds of the standard deviation of a depth, as a share, whose inverse square is then finite; `common` may be 0."""
MAX_APART_M, MAX_TURNED_DEG = 1.0, 45.0
"""From a photograph's camera to its depth camera, and between their viewing directions."""


def implausible_median(median_m: float) -> str:
    """The median depth of an image with the bounds that it is outside of, as it cannot be metres; empty if it can be.

    NaN, the median of an image without any depth, can be.
    """
    least, most = PLAUSIBLE_DEPTHS
    if not (median_m < least or median_m > most):
        return ""
    number = np.format_float_positional(median_m, 4, fractional=False, trim="-")
    return f"{number} m, outside {least:g} to {most:g} m"


class DepthSensor(str, Enum):
    """Kinds of depth sensors, whose noise differs."""

    UNKNOWN = "unknown"
    TIME_OF_FLIGHT = "time_of_flight"
    STRUCTURED_LIGHT = "structured_light"
    STEREO = "stereo"
    PHONE_LIDAR = "phone_lidar"
    RENDERED = "rendered"


@dataclass(frozen=True)
class DepthNoise:
    """Errors of a depth sensor: a depth z has the standard deviation constant_m + linear z + quadratic_per_m z^2.

    Attributes:
        constant_m: standard deviation at any distance, metres.
        linear: share of the depth that is added.
        quadratic_per_m: share of the squared depth that is added, per metre.
        common: standard deviation of the factor that all depths of an image share, as a share.

    A server accepts at most `MAX_NOISE`, and as `common` 0 or at least `LEAST_SIGMA`.
    ValueError if a number is negative or not finite, or the standard deviation is 0.
    """

    constant_m: float = 0.0
    linear: float = 0.0
    quadratic_per_m: float = 0.0
    common: float = 0.0

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if not 0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and at least 0, is {value:g}")
        if not self.constant_m + self.linear + self.quadratic_per_m > 0:
            raise ValueError("constant_m, linear or quadratic_per_m must be above 0: no sensor is exact")

    def sigma_m(self, depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of depths, metres."""
        return self.constant_m + self.linear * depth_m + self.quadratic_per_m * depth_m**2

    def relative_sigma(self, depth_m: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of depths as a share of them, `LEAST_SIGMA` to `MOST_SIGMA`."""
        return np.clip(self.sigma_m(depth_m) / depth_m, LEAST_SIGMA, MOST_SIGMA)

    def bounded(self) -> "DepthNoise":
        """The nearest noise that a server accepts: references may have been stored with any."""
        noise = DepthNoise(**{name: min(value, MAX_NOISE[name]) for name, value in asdict(self).items()})
        return replace(noise, common=max(noise.common, LEAST_SIGMA)) if noise.common else noise


NOISE = {
    DepthSensor.STRUCTURED_LIGHT: DepthNoise(0.0012, 0.0, 0.0019, 0.02),
    DepthSensor.STEREO: DepthNoise(0.001, 0.0, 0.0025, 0.01),
    DepthSensor.TIME_OF_FLIGHT: DepthNoise(0.008, 0.0, 0.0, 0.005),
    DepthSensor.PHONE_LIDAR: DepthNoise(0.01, 0.005, 0.0, 0.025),
    DepthSensor.RENDERED: DepthNoise(0.0, 0.001, 0.0, 0.001),
    DepthSensor.UNKNOWN: DepthNoise(0.01, 0.01, 0.0, 0.05),
}
"""Noise by the kind of sensor; docs/guides/depth.md has the sources."""


@dataclass(frozen=True, eq=False, init=False)
class DepthImage:
    """A depth image as its sensor gave it.

    A value is the distance along the viewing direction of the depth camera (z), not along the ray. No value is 0, in a
    PNG also 65535, and as float32 also NaN or infinity.

    Attributes:
        data: the bytes of a PNG with one channel of 16 bits; or float32 values, little-endian, row by row. Made from
            them, or from the path of their file, which is read.
        unit_m: length of 1 in these values, metres: 0.001 for millimetres.
        size: width and height of float32 values, pixels; None for a PNG.
        sensor: the kind of sensor, which gives the noise.
        camera: the depth camera, in pixels of the depth image; None: the photograph's own, scaled to its size.
        camera_from_depth_camera: pose of the depth camera in the photograph's camera, metres; None: they are the same.
        confidence: the bytes of a PNG with one channel of 8 bits, of the same size, or its path; empty for none.
        min_confidence: depths with a smaller confidence are not used.
        noise: the sensor's noise, in place of that of its kind.

    OSError if a file cannot be read; TypeError for pixels.
    """

    data: bytes
    unit_m: float
    size: tuple[int, int] | None = None
    sensor: DepthSensor = DepthSensor.UNKNOWN
    camera: Camera | None = None
    camera_from_depth_camera: RigidTransform | None = None
    confidence: bytes = b""
    min_confidence: int = 1
    noise: DepthNoise | None = None

    def __init__(
        self,
        data: Source,
        unit_m: float,
        size: tuple[int, int] | None = None,
        sensor: DepthSensor = DepthSensor.UNKNOWN,
        camera: Camera | None = None,
        camera_from_depth_camera: RigidTransform | None = None,
        confidence: Source = b"",
        min_confidence: int = 1,
        noise: DepthNoise | None = None,
    ) -> None:
        vars(self).update(data=_read(data, "data"), unit_m=unit_m, size=size, sensor=sensor, camera=camera)
        vars(self).update(camera_from_depth_camera=camera_from_depth_camera, noise=noise)
        vars(self).update(confidence=_read(confidence, "confidence"), min_confidence=min_confidence)

    @staticmethod
    def of_metres(depth_m: ArrayLike, sensor: DepthSensor = DepthSensor.UNKNOWN) -> "DepthImage":
        """The image of depths (H, W) in metres, of the photograph's own camera. ValueError for another shape."""
        values = np.ascontiguousarray(depth_m, "<f4")
        if values.ndim != 2:
            raise ValueError(f"depth_m must have rows and columns, has the shape {np.shape(depth_m)}")
        height, width = values.shape
        return DepthImage(values.tobytes(), 1.0, (width, height), sensor)

    @property
    def known_noise(self) -> DepthNoise:
        """Its noise: the given one, or that of its kind of sensor."""
        return self.noise or NOISE[self.sensor]

    @property
    def size_bytes(self) -> int:
        """Size of its values and confidence, bytes."""
        return len(self.data) + len(self.confidence)

    @property
    def sha256(self) -> str:
        """Hash of all that it consists of, hexadecimal; equal depths have equal ones."""
        pose = self.camera_from_depth_camera
        description = {
            "unit_m": float(self.unit_m),
            "size": self.size and list(self.size),
            "sensor": self.sensor.value,
            "camera": self.camera and _numbers_of(self.camera),
            "camera_from_depth_camera": pose and (pose.matrix().round(9) + 0.0).tolist(),
            "min_confidence": self.min_confidence,
            "noise": self.noise and {name: float(it) for name, it in asdict(self.noise).items()},
        }
        digest = hashlib.sha256(json.dumps(description).encode())
        for part in (self.data, self.confidence):
            digest.update(len(part).to_bytes(8, "little") + part)
        return digest.hexdigest()


class IgnoredDepth(UserWarning):
    """A server that is older than depth has ignored that of references, or of photographs."""

    def __init__(self, owner: str = "references") -> None:
        super().__init__(
            f"the server has ignored the depth of {owner}: it is older than depth, which 0.3 does not know"
        )


def _numbers_of(camera: Camera) -> dict[str, object]:
    """The numbers of a camera by fixed names, which checksums that are stored contain."""
    lens = camera.distortion
    return {
        "size_px": [camera.width_px, camera.height_px],
        "focal_px": [float(camera.focal_x_px), float(camera.focal_y_px)],
        "principal_px": [float(camera.principal_x_px), float(camera.principal_y_px)],
        "lens": None if lens is None else lens_model_of(lens),
        "coefficients": None if lens is None else [float(it) for it in vars(lens).values()],
    }


def depth_to_message(depth: DepthImage, field: str = "depth") -> pb.DepthImage:
    """Message of a depth image; TypeError, naming the field, for another type."""
    wire.require(depth, DepthImage, field, "one is made by DepthImage(data, unit_m)")
    message = pb.DepthImage(confidence=depth.confidence)
    wire.set_numbers(message, {"unit_m": depth.unit_m, "min_confidence": depth.min_confidence}, field)
    if depth.sensor is not DepthSensor.UNKNOWN:
        message.sensor = wire.enum_value(_SENSORS, depth.sensor)
    if depth.size is None:
        message.png = depth.data
    else:
        message.float32 = depth.data
        message.width_px, message.height_px = _checked_size(depth.size, joined(field, "size"))
    if depth.camera is not None:
        message.intrinsics.CopyFrom(wire.camera_to_message(depth.camera, joined(field, "camera")))
    if depth.camera_from_depth_camera is not None:
        pose = wire.transform_to_message(depth.camera_from_depth_camera, joined(field, "camera_from_depth_camera"))
        message.camera_from_depth_camera.CopyFrom(pose)
    if depth.noise is not None:
        message.noise.CopyFrom(pb.DepthNoise(**asdict(depth.noise)))
    return message


def depth_from_message(message: pb.DepthImage, field: str) -> DepthImage:
    """Depth image of a message, whose bytes are not read.

    FieldError if the values are missing, or a number is not finite or out of the range that geometry.proto states.
    """
    kind = message.WhichOneof("values")
    if kind is None:
        raise FieldError(joined(field, "png"), "is required, or float32")
    if not MIN_UNIT_M <= message.unit_m <= MAX_UNIT_M:
        text = f"must be {MIN_UNIT_M:g} to {MAX_UNIT_M:g}, is {message.unit_m:g}: 0.001 for millimetres"
        raise FieldError(joined(field, "unit_m"), text)
    if not 0 <= message.min_confidence <= 255:
        raise FieldError(joined(field, "min_confidence"), f"must be 0 to 255, is {message.min_confidence}")
    if message.sensor not in _SENSORS.values():
        raise FieldError(joined(field, "sensor"), f"must be one of DepthSensor's values, is {message.sensor}")
    name = _SENSORS.Name(message.sensor).removeprefix(wire.enum_prefix(_SENSORS))
    depth = DepthImage(
        getattr(message, kind),
        message.unit_m,
        _size_from_message(message, field) if kind == "float32" else None,
        DepthSensor[name] if message.sensor else DepthSensor.UNKNOWN,
        confidence=message.confidence,
        min_confidence=message.min_confidence or 1,
    )
    if message.HasField("intrinsics"):
        depth = replace(depth, camera=wire.camera_from_message(message.intrinsics, joined(field, "intrinsics")))
    if message.HasField("camera_from_depth_camera"):
        depth = replace(depth, camera_from_depth_camera=_extrinsics_from_message(message, field))
    if message.HasField("noise"):
        depth = replace(depth, noise=_noise_from_message(message.noise, joined(field, "noise")))
    return depth


def _read(source: Source, field: str) -> bytes:
    if isinstance(source, bytes):
        return source
    try:
        path = Path(source)
    except TypeError:
        text = f"{field} is bytes or the path of a file, not {type(source).__qualname__}: of_metres takes an array"
        raise TypeError(text) from None
    return path.read_bytes()


def _checked_size(size: tuple[int, int], field: str) -> tuple[int, int]:
    if len(size) != 2 or not all(isinstance(it, int | np.integer) for it in size):
        raise FieldError(field, f"must be width and height in whole pixels, is {size!r}")
    if not all(wire.MIN_SIDE_PX <= it <= wire.MAX_SIDE_PX for it in size):
        raise FieldError(field, f"must be {wire.MIN_SIDE_PX} to {wire.MAX_SIDE_PX} pixels a side, is {size!r}")
    return int(size[0]), int(size[1])


def _size_from_message(message: pb.DepthImage, field: str) -> tuple[int, int]:
    for side in ("width_px", "height_px"):
        value = getattr(message, side)
        if not wire.MIN_SIDE_PX <= value <= wire.MAX_SIDE_PX:
            raise FieldError(joined(field, side), f"must be {wire.MIN_SIDE_PX} to {wire.MAX_SIDE_PX}, is {value}")
    expected = 4 * message.width_px * message.height_px
    if len(message.float32) != expected:
        size = f"{message.width_px}x{message.height_px} values of 4 bytes are {expected}"
        raise FieldError(joined(field, "float32"), f"has {len(message.float32)} bytes, {size}")
    return message.width_px, message.height_px


def _extrinsics_from_message(message: pb.DepthImage, field: str) -> RigidTransform:
    path = joined(field, "camera_from_depth_camera")
    pose = wire.transform_from_message(message.camera_from_depth_camera, path)
    apart_m = float(np.linalg.norm(pose.translation))
    if apart_m > MAX_APART_M:
        text = f"must be at most {MAX_APART_M:g} m away, is {apart_m:g} m; are these millimetres?"
        raise FieldError(joined(path, "translation_m"), text)
    turned_deg = math.degrees(math.acos(min(1.0, max(-1.0, float(pose.rotation[2, 2])))))
    if turned_deg > MAX_TURNED_DEG:
        text = (
            f"must turn the viewing direction by at most {MAX_TURNED_DEG:g} degrees, turns it by {turned_deg:.0f}: the "
            "axes of both cameras are x right, y down, z forward"
        )
        raise FieldError(joined(path, "rotation"), text)
    return pose


def _noise_from_message(message: pb.DepthNoise, field: str) -> DepthNoise:
    for name, most in MAX_NOISE.items():
        value = getattr(message, name)
        if not 0 <= value <= most:
            raise FieldError(joined(field, name), f"must be 0 to {most:g}, is {value:g}")
    if 0 < message.common < LEAST_SIGMA:
        text = f"must be 0, or {LEAST_SIGMA:g} to {MAX_NOISE['common']:g}, is {message.common:g}"
        raise FieldError(joined(field, "common"), text)
    try:
        return DepthNoise(message.constant_m, message.linear, message.quadratic_per_m, message.common)
    except ValueError as error:
        raise FieldError(field, str(error)) from None
