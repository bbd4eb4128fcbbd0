"""Options of the readers."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from mapless.geometry import Camera
from mapless_tools.bags.options import BagOptions


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera given by the user because the layout has none; (0, 0) is the centre of the top-left pixel."""

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
class KeyframeOptions:
    """Options of choosing keyframes: the sharpest of a few images, each time the camera has moved or turned.

    The distance is a tenth of the depth of a room, so that neighbours overlap; the angle a third of a narrow lens's
    field of view.
    """

    distance_m: float = 0.3
    angle_deg: float = 15.0

    def __post_init__(self) -> None:
        if not (0 <= self.distance_m < np.inf and 0 <= self.angle_deg <= 180):
            raise ValueError(
                "keyframes: the distance must be 0 m or more and the angle 0 to 180 degrees, they are "
                f"{self.distance_m:g} and {self.angle_deg:g}"
            )

    @property
    def takes_all(self) -> bool:
        """Whether every image is a keyframe."""
        return self.distance_m == 0 or self.angle_deg == 0


@dataclass(frozen=True)
class ReadOptions:
    """Options of reading.

    Attributes:
        images: folder of the images, if it is not the layout's usual one; only for `colmap`.
        ground_truth: poses that replace the layout's own: a file or folder of SfM pseudo ground truth, for `7scenes`
            and `12scenes`.
        intrinsics: for layouts without them (`7scenes`, `tum`, recordings); None for the layout's usual ones.
        bag, keyframes: which topics, frames and images of a recording are used; only for `rosbag`.
    """

    images: Path | None = None
    ground_truth: Path | None = None
    intrinsics: Intrinsics | None = None
    bag: BagOptions = field(default_factory=BagOptions)
    keyframes: KeyframeOptions = field(default_factory=KeyframeOptions)
