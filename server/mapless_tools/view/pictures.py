"""Photographs as the viewer shows them: small ones on frustums, and a query's with what was matched in it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, resized_pixel
from mapless_server.images import ImageLimits, decode_image

from .queries import Query

THUMBNAIL_PX = 160
OVERLAY_PX = 1200
INLIER, OUTLIER, RESIDUAL = (46, 230, 166), (255, 107, 43), (255, 225, 77)
"""Red, green and blue of what agrees with the pose, of what does not, and of how far it is off."""
_LIMITS = ImageLimits(max_bytes=1 << 30, max_pixels=200_000_000)
"""The server has checked the photograph; its limits may be higher than its defaults."""

Picture = NDArray[np.uint8]


def read_picture(image: bytes, max_side_px: int) -> Picture:
    """A photograph (H, W, 3) RGB, its longer side at most so long; InvalidArgument if it cannot be read."""
    pixels = decode_image(image, _LIMITS)
    scale = max_side_px / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def colours_at(picture: Picture, camera: Camera, pixels: Array) -> NDArray[np.uint8]:
    """Colours (N, 3) of a reduced photograph at pixels (N, 2) of the whole one."""
    height, width = picture.shape[:2]
    at = _reduced(pixels, camera, picture).round().astype(int)
    return np.asarray(picture[np.clip(at[:, 1], 0, height - 1), np.clip(at[:, 0], 0, width - 1)], np.uint8)


def overlay(query: Query) -> Picture:
    """The photograph with its matches: where points are seen, and lines to where the pose puts them."""
    picture = _enlarged(read_picture(query.image, OVERLAY_PX))
    debug = query.answer.debug
    if debug is None:
        return picture
    seen = _reduced(debug.query_px, query.camera, picture)
    if query.pose is not None:
        placed = _projected(query.camera, query.pose, debug.x_in_world)
        _lines(picture, seen, _reduced(placed, query.camera, picture), debug.is_inlier)
    size = max(2, round(picture.shape[1] / 350))
    for is_good, colour in ((False, OUTLIER), (True, INLIER)):
        for x, y in seen[debug.is_inlier == is_good]:
            centre = round(float(x)), round(float(y))
            cv2.circle(picture, centre, size + 1, (12, 20, 24), -1, cv2.LINE_AA)
            cv2.circle(picture, centre, size, colour, -1, cv2.LINE_AA)
    return picture


def _enlarged(picture: Picture) -> Picture:
    """A small photograph made larger, so that what is drawn in it does not hide it."""
    factor = OVERLAY_PX // max(picture.shape[:2])
    if factor < 2:
        return picture
    return np.asarray(cv2.resize(picture, None, fx=factor, fy=factor, interpolation=cv2.INTER_CUBIC), np.uint8)


def _projected(camera: Camera, world_from_camera: RigidTransform, x_in_world: Array) -> Array:
    return camera.project(world_from_camera.inverse().apply(x_in_world))


def _lines(picture: Picture, seen: Array, placed: Array, is_inlier: NDArray[np.bool_]) -> None:
    """Wrong matches first, and none longer than a tenth of the picture, so that they hide nothing."""
    step = placed - seen
    length = np.linalg.norm(step, axis=1, keepdims=True)
    end = seen + step * np.minimum(1.0, 0.1 * picture.shape[1] / np.maximum(length, 1e-9))
    for is_good, colour in ((False, OUTLIER), (True, RESIDUAL)):
        for i in np.flatnonzero((is_inlier == is_good) & np.isfinite(end).all(axis=1)):
            (x, y), (u, v) = seen[i], end[i]
            cv2.line(picture, (round(x), round(y)), (round(u), round(v)), colour, 1, cv2.LINE_AA)


def _reduced(pixels: Array, camera: Camera, picture: Picture) -> Array:
    """Pixels (N, 2) of the whole photograph in the reduced one."""
    scale_x, scale_y = picture.shape[1] / camera.width_px, picture.shape[0] / camera.height_px
    return np.stack([resized_pixel(pixels[:, 0], scale_x), resized_pixel(pixels[:, 1], scale_y)], axis=-1)
