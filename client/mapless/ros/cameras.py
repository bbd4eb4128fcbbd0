"""Cameras of sensor_msgs/CameraInfo."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless.lenses import Distortion, Fisheye, RadialTangential

from .images import encoded, file_from_image, pixels_from_image

RATIONAL_COUNTS = (8, 12, 14)
"""Coefficients of rational_polynomial: eight, as OpenCV has them, and with thin prisms and a tilted sensor."""


@dataclass(frozen=True, eq=False)
class RosCamera:
    """A camera in mapless's form, and OpenCV's maps from its images to a pinhole; none where mapless has the lens."""

    camera: Camera
    undistortion: tuple[NDArray[Any], NDArray[Any]] | None = None

    def photo(self, message: Any, lossless: bool = False) -> bytes:
        """Makes the file to send for a sensor_msgs/Image or CompressedImage.

        ValueError if the image cannot be read, or has another size than the camera.
        """
        size = (self.camera.width_px, self.camera.height_px)
        if hasattr(message, "encoding") and (message.width, message.height) != size:
            raise ValueError(f"the image has {message.width} x {message.height} pixels, its CameraInfo {_by(size)}")
        if self.undistortion is None:
            return file_from_image(message, lossless)
        pixels = pixels_from_image(message)
        if pixels.shape[1::-1] != size:
            raise ValueError(f"the image has {_by(pixels.shape[1::-1])} pixels, its CameraInfo {_by(size)}")
        return encoded(np.asarray(cv2.remap(pixels, *self.undistortion, cv2.INTER_LINEAR), np.uint8), lossless)


def camera_from_info(message: Any, rectified: bool = False) -> RosCamera:
    """The camera of a sensor_msgs/CameraInfo; of rectified images it is P instead of K and D.

    The lenses `plumb_bob` and `equidistant` exist in mapless. A `rational_polynomial` with zeros after the fifth
    coefficient is a `plumb_bob`; images of other ones are undistorted to a pinhole, cropped to the lens's field.
    ValueError if the camera is not calibrated, its lens is unknown, or its image is binned or cropped.
    """
    # Drivers of rectified images without a lens often leave P empty: it is K then.
    has_p = any(message.p) or any(message.d)
    name, matrix, columns = ("p", list(message.p), 4) if rectified and has_p else ("k", list(message.k), 3)
    focal_x, focal_y, principal_x, principal_y = (float(matrix[i]) for i in (0, columns + 1, 2, columns + 2))
    if not (0 < focal_x < np.inf and 0 < focal_y < np.inf and np.isfinite([principal_x, principal_y]).all()):
        raise ValueError(
            f"the camera is not calibrated: CameraInfo.{name} has the focal lengths {focal_x:g}, {focal_y:g}"
        )
    width, height, region = message.width, message.height, message.roi
    is_part = (region.width or region.height) and (region.width, region.height) != (width, height)
    if message.binning_x > 1 or message.binning_y > 1 or is_part:
        raise ValueError("the image is binned, or a part of the sensor's: CameraInfo is not its own")
    if not (width > 0 and height > 0):
        raise ValueError(f"CameraInfo has an image size of {width} x {height}")
    camera = Camera(width, height, focal_x, focal_y, principal_x, principal_y)
    if rectified:
        return RosCamera(camera)
    model, d = message.distortion_model, [float(it) for it in message.d]
    if not np.isfinite(d).all():
        raise ValueError("CameraInfo.d is not finite")
    if model == "rational_polynomial" and len(d) in RATIONAL_COUNTS and any(d[5:]):
        return _undistorting(camera, d)
    return RosCamera(Camera(width, height, focal_x, focal_y, principal_x, principal_y, _lens(model, d)))


def _lens(model: str, d: list[float]) -> Distortion | None:
    if model == "equidistant" and len(d) == 4:  # with zeros, too: that is no pinhole
        return Fisheye(*d)
    if model != "equidistant" and not any(d):
        return None
    if model in ("plumb_bob", "rational_polynomial") and len(d) in (4, 5, *RATIONAL_COUNTS) and not any(d[5:]):
        return RadialTangential(*d[:5])
    raise ValueError(
        f"a lens {model!r} with {len(d)} coefficients: known are plumb_bob with 4 or 5, rational_polynomial with "
        f"{', '.join(map(str, RATIONAL_COUNTS))}, equidistant with 4"
    )


def _undistorting(camera: Camera, d: list[float]) -> RosCamera:
    size = (camera.width_px, camera.height_px)
    k, coefficients = camera.matrix(), np.array(d)
    pinhole, _ = cv2.getOptimalNewCameraMatrix(k, coefficients, size, 0)  # 0: no pixel that the lens did not see
    if not (np.isfinite(pinhole).all() and pinhole[0, 0] > 0 and pinhole[1, 1] > 0):
        raise ValueError(f"images of the lens rational_polynomial {d} cannot be undistorted to a pinhole")
    first, second = cv2.initUndistortRectifyMap(k, coefficients, np.eye(3), pinhole, size, cv2.CV_16SC2)
    ideal = Camera(*size, *pinhole[[0, 1, 0, 1], [0, 1, 2, 2]].tolist())
    return RosCamera(ideal, (first, second))


def _by(size: tuple[int, ...]) -> str:
    return f"{size[0]} x {size[1]}"
