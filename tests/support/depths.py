"""Depth images as sensors write them, and a planted surface that each of them must show."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.images import ImageLimits, decode_depth
from mapless_tools.dataset import Frame

_CENTRE, _SEMI_AXES_M = np.array([0.3, -0.2, 1.1]), np.array([2.2, 1.7, 3.1])
"""An ellipsoid around each photograph's camera, in its frame: no turn or shift leaves it as it is."""


def png(values: NDArray[np.integer]) -> bytes:
    """A PNG of these values, of as many bits."""
    return bytes(cv2.imencode(".png", values)[1].tobytes())


def planted_depth_m(camera: Camera, camera_from_depth_camera: RigidTransform | None = None) -> Array:
    """Depths (H, W) of the planted surface, seen by a pinhole camera beside the photograph's; metres."""
    pose = camera_from_depth_camera or RigidTransform.identity()
    columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = camera.rays(np.stack([columns, rows], axis=-1)) @ pose.rotation.T / _SEMI_AXES_M
    start = (pose.translation - _CENTRE) / _SEMI_AXES_M
    a, b, c = (rays**2).sum(-1), rays @ start, start @ start - 1
    return np.asarray((np.sqrt(b**2 - a * c) - b) / a)


def planted_png(
    camera: Camera, camera_from_depth_camera: RigidTransform | None = None, unit_m: float = 0.001, hole: int = 0
) -> bytes:
    """The planted surface as a PNG of 16 bits, whose first pixel has no value."""
    values = np.rint(planted_depth_m(camera, camera_from_depth_camera) / unit_m).astype(np.uint16)
    values[0, 0] = hole
    return png(values)


def assert_planted(frame: Frame, error_m: float = 0.001) -> None:
    """All points of a frame's depth but the first pixel's lie on the planted surface, to rounding."""
    assert frame.depth is not None
    image, photo = frame.depth.read(), frame.camera
    depth = decode_depth(image, (photo.width_px, photo.height_px), ImageLimits())
    assert np.isnan(depth[0, 0])
    assert np.isfinite(depth.ravel()[1:]).all()
    camera = image.camera or photo.resized(*depth.shape[::-1])
    rows, columns = np.nonzero(np.isfinite(depth))
    points = camera.rays(np.stack([columns, rows], axis=1)) * depth[rows, columns, None].astype(float)
    if image.camera_from_depth_camera is not None:
        points = image.camera_from_depth_camera.apply(points)
    off = np.linalg.norm((points - _CENTRE) / _SEMI_AXES_M, axis=1) - 1
    assert np.abs(off).max() * _SEMI_AXES_M.max() < error_m
