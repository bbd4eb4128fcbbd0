"""The input and the result of a reconstruction: photographs without poses, and their cameras and poses."""

from dataclasses import dataclass
from pathlib import Path

from mapless.geodesy import Datum
from mapless.geometry import Array, Camera, RigidTransform
from mapless.scenes import Vector
from mapless_server.images.exif import NO_EXIF, Exif


@dataclass(frozen=True)
class VideoTime:
    """The place of a frame in a video: its index among the decoded frames, and its presentation time."""

    video: str
    frame: int
    time_s: float


@dataclass(frozen=True, eq=False)
class Picture:
    """A photograph whose pose is not known; `name` is a legal reference id, unique in the reconstruction.

    `path` is the file that the reconstruction will have: a JPEG, PNG or WebP of `width_px` times `height_px` pixels as
    stored. `orientation` says how the raster has to be turned to be upright, as in EXIF; it is not applied. `source` is
    the file that it was given in, a video or a photograph. The mask, a PNG of the same size, is 0 at the pixels to
    ignore; None without one.
    """

    name: str
    path: Path
    width_px: int
    height_px: int
    source: Path
    exif: Exif = NO_EXIF
    time: VideoTime | None = None
    mask_path: Path | None = None

    @property
    def orientation(self) -> int:
        """EXIF's orientation, 1 to 8."""
        return self.exif.orientation


@dataclass(frozen=True)
class Omitted:
    """A photograph, or so many frames of a video, that take no part, and a clause with the reason."""

    name: str
    reason: str
    count: int = 1


@dataclass(frozen=True)
class Pictures:
    """The photographs that take part, in the order in which they were taken, and those that do not.

    `photographs` and `frames` are the numbers of photographs, and of frames of videos, that the sources have.
    """

    chosen: tuple[Picture, ...]
    omitted: tuple[Omitted, ...] = ()
    notes: tuple[str, ...] = ()
    photographs: int = 0
    frames: int = 0


@dataclass(frozen=True, eq=False)
class PosedPicture:
    """A photograph with its computed camera and pose, and how many points of the reconstruction it sees."""

    picture: Picture
    camera: Camera
    world_from_camera: RigidTransform
    point_count: int


@dataclass(frozen=True, eq=False)
class Part:
    """Photographs that were reconstructed together, in one frame of arbitrary origin, orientation and unit.

    Points are (N, 3), their colours (N, 3) 0 to 255; `reprojection_px` is the mean error of their observations.
    """

    posed: tuple[PosedPicture, ...]
    points_in_world: Array
    colours: Array
    reprojection_px: float


@dataclass(frozen=True, eq=False)
class WorldFrame:
    """The unit, origin and up of a reconstruction after what was known was applied, and how they were found.

    `down_in_world` is a unit vector, None if nothing says which way is down. `scale_sigma` is the relative standard
    deviation of lengths; meaningful where `is_metric`. `datum` is None if the place or north is not known.
    """

    is_metric: bool
    scale_sigma: float
    down_in_world: Vector | None
    notes: tuple[str, ...]
    warnings: tuple[str, ...] = ()
    datum: Datum | None = None
