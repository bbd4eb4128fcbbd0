"""An image of a COLMAP model as its file has it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class ImageRecord:
    """An image.

    Attributes:
        image_id: COLMAP's.
        pose: qw qx qy qz tx ty tz of camera_from_world.
        camera_id: of its camera.
        name: its path from the images' folder.
    """

    image_id: int
    pose: Sequence[float]
    camera_id: int
    name: str
