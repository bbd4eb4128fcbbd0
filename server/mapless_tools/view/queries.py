"""Queries, and photographs as the viewer shows them, with the colours of their pixels."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.answers import LocalizationResult, Rejected
from mapless.geometry import Array, Camera, RigidTransform, resized_pixel
from mapless_server.images import ImageLimits, decode_image


@dataclass(frozen=True, eq=False)
class Query:
    """A photograph, its camera, and the answer; numbered in order of arrival."""

    number: int
    image: bytes
    camera: Camera
    answer: LocalizationResult | Rejected

    @property
    def pose(self) -> RigidTransform | None:
        """The answered pose; None for a rejection."""
        return self.answer.world_from_camera if isinstance(self.answer, LocalizationResult) else None

    @property
    def label(self) -> str:
        """One line for a list."""
        if isinstance(self.answer, Rejected):
            return f"#{self.number} not localized: {self.answer.reason.lower().replace('_', ' ')}"
        radius = self.answer.accuracy
        return f"#{self.number} localized" + (f" to {_length(radius.position_95_m)}" if radius is not None else "")


def _length(metres: float) -> str:
    return (
        f"{metres:.2f} m" if metres >= 1 else f"{100 * metres:.1f} cm" if metres >= 0.01 else f"{1000 * metres:.1f} mm"
    )


THUMBNAIL_PX = 160
_LIMITS = ImageLimits(max_bytes=1 << 30, max_pixels=200_000_000)
"""The server has checked the photograph; its limits may be higher than its defaults."""

Picture = NDArray[np.uint8]


def read_picture(image: bytes, max_side_px: int) -> Picture:
    """Reads a photograph (H, W, 3) RGB and limits its longer side; InvalidArgument if it cannot be read."""
    pixels = decode_image(image, _LIMITS)
    scale = max_side_px / max(pixels.shape[:2])
    if scale >= 1:
        return pixels
    size = (max(1, round(pixels.shape[1] * scale)), max(1, round(pixels.shape[0] * scale)))
    return np.asarray(cv2.resize(pixels, size, interpolation=cv2.INTER_AREA), np.uint8)


def colours_at(picture: Picture, camera: Camera, pixels: Array) -> NDArray[np.uint8]:
    """Colours (N, 3) of a reduced photograph at pixels (N, 2) of the whole one."""
    height, width = picture.shape[:2]
    scale_x, scale_y = width / camera.width_px, height / camera.height_px
    column = resized_pixel(pixels[:, 0], scale_x).round().astype(int)
    row = resized_pixel(pixels[:, 1], scale_y).round().astype(int)
    return np.asarray(picture[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)], np.uint8)
