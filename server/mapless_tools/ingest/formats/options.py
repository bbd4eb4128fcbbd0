"""Options of the readers."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mapless.geometry import Camera


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole that a person gives because the layout has none; (0, 0) is the centre of the top-left pixel."""

    focal_x_px: float
    focal_y_px: float
    principal_x_px: float
    principal_y_px: float

    def __post_init__(self) -> None:
        if not (self.focal_x_px > 0 and self.focal_y_px > 0):
            raise ValueError("intrinsics: focal lengths must be above 0")

    def camera(self, width_px: int, height_px: int) -> Camera:
        """The camera of an image of this size."""
        return Camera(width_px, height_px, self.focal_x_px, self.focal_y_px, self.principal_x_px, self.principal_y_px)


@dataclass(frozen=True)
class ReadOptions:
    """Options of reading.

    Attributes:
        images: folder of the images where that of the layout is not the usual one; only for `colmap`.
        ground_truth: poses to take instead of the layout's own: a file or folder of SfM pseudo ground truth, for
            `7scenes` and `12scenes`.
        intrinsics: for layouts without them (`7scenes`, `tum`); None for the layout's usual ones.
    """

    images: Path | None = None
    ground_truth: Path | None = None
    intrinsics: Intrinsics | None = None
