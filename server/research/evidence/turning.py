"""Photographs turned about the optical axis, as a camera that is held at another roll takes them.

The raster is that of a pinhole with square pixels whose optical axis is the photograph's: lens distortion and unequal
focal lengths are resampled away with the turn. It is enlarged so that nothing is cut off; what the photograph does not
show is black. At multiples of 90 degrees, a pinhole with square pixels keeps its pixels' values.
"""

import math
from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless import Camera, RigidTransform
from mapless.geometry import Array, rotation_from_vector
from mapless_server.method.features.views import undistort_pixels


def turned(camera: Camera, world_from_camera: RigidTransform, angle_deg: float) -> tuple[Camera, RigidTransform]:
    """Camera and pose of a raster turned counterclockwise, as it is seen, about its optical axis."""
    seen = turned_camera(camera, angle_deg)
    rotation = world_from_camera.rotation @ turned_from_camera(angle_deg).T
    return seen, RigidTransform(rotation, world_from_camera.translation)


def turned_from_camera(angle_deg: float) -> Array:
    """(3, 3) camera axes of the turned raster from those of the photograph; at 90 degrees x' = y and y' = -x."""
    return rotation_from_vector([0.0, 0.0, -math.radians(angle_deg)])


@cache
def turned_camera(camera: Camera, angle_deg: float) -> Camera:
    """The pinhole with square pixels and the smallest size that shows all of a turned photograph."""
    focal_px = math.sqrt(camera.focal_x_px * camera.focal_y_px)
    x_in_turned = camera.rays(undistort_pixels(_edge(camera), camera)) @ turned_from_camera(angle_deg).T
    edge_px = focal_px * x_in_turned[:, :2]
    # Rounded, so that an error of the last digit adds no column at multiples of 90 degrees.
    (left, top), (right, bottom) = edge_px.min(axis=0).round(6), edge_px.max(axis=0).round(6)
    width_px, height_px = math.ceil(right - left), math.ceil(bottom - top)
    return Camera(width_px, height_px, focal_px, focal_px, float(-left - 0.5), float(-top - 0.5))


def turned_image(photograph: Path, camera: Camera, angle_deg: float) -> bytes:
    """The turned photograph of a file, as PNG."""
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    pixels = np.asarray(cv2.imdecode(np.frombuffer(photograph.read_bytes(), np.uint8), flags), np.uint8)
    return bytes(cv2.imencode(".png", turned_pixels(pixels, camera, angle_deg))[1].tobytes())


def turned_pixels(pixels: NDArray[np.uint8], camera: Camera, angle_deg: float) -> NDArray[np.uint8]:
    """The raster (H', W', C) of `turned_camera`, from the photograph's (H, W, C)."""
    seen = turned_camera(camera, angle_deg)
    columns, rows = np.meshgrid(np.arange(seen.width_px), np.arange(seen.height_px))
    source = camera.project(seen.rays(np.stack([columns, rows], axis=-1)) @ turned_from_camera(angle_deg))
    # Rounded to a thousandth of a pixel: nearer to a pixel's centre, its value is taken as it is.
    at_x, at_y = np.moveaxis(source.round(3).astype(np.float32), -1, 0)
    return np.asarray(cv2.remap(pixels, at_x, at_y, cv2.INTER_CUBIC, borderMode=cv2.BORDER_CONSTANT), np.uint8)


def _edge(camera: Camera) -> Array:
    """(N, 2) pixels along the edge of a raster, half a pixel outside the centres of its outermost pixels."""
    size = np.array([camera.width_px, camera.height_px])
    along = np.linspace(0.0, 1.0, 65)
    sides = [np.stack(np.broadcast_arrays(*it), axis=-1) for end in (0.0, 1.0) for it in ((along, end), (end, along))]
    return np.asarray(np.concatenate(sides) * size - 0.5)
