"""The cameras of photographs without poses: which photographs share one, and what it is before it is refined.

Pixels are mapless's, (0, 0) the centre of the first pixel, except for cameras of pycolmap, whose (0, 0) is its corner.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import pycolmap

from mapless.cameras import read_camera
from mapless.geometry import Camera
from mapless.lenses import Fisheye
from mapless_server.images.exif import focal_of
from mapless_tools.ingest.formats.colmap.cameras import ColmapCamera, from_camera

from .pictures import Picture

FISHEYE = "fisheye"
"""The lens for which `LensOptions` wants no file: its coefficients are estimated."""
GUESSED_FOCAL = 1.2
"""Focal length over the longer side where nothing is known of it, COLMAP's: 45 degrees of view."""
GUESSED_FISHEYE_FOCAL = 0.5
"""The same of fisheyes: 115 degrees across."""


@dataclass(frozen=True)
class LensOptions:
    """The knowledge of the cameras beside EXIF.

    Attributes:
        fisheye: all lenses are fisheyes, whose coefficients are estimated.
        known: calibrated cameras, used as they are for the photographs of their size.
    """

    fisheye: bool = False
    known: tuple[Camera, ...] = ()

    def __post_init__(self) -> None:
        sizes = [(it.width_px, it.height_px) for it in self.known]
        if len(set(sizes)) < len(sizes):
            raise ValueError("known has two cameras of one size: photographs are distinguished by their size alone")

    @staticmethod
    def of(texts: Sequence[str]) -> LensOptions:
        """Reads the values of --lens: `fisheye`, or files with the intrinsics of a camera; ValueError names one."""
        return LensOptions(FISHEYE in texts, tuple(_calibrated(it) for it in texts if it != FISHEYE))


@dataclass(frozen=True)
class StartingCamera:
    """A camera that photographs share, as it is before it is refined with their poses.

    Attributes:
        camera: its intrinsics to begin with; its lens is a `Fisheye` where `LensOptions` says so.
        names: the photographs.
        origin: a clause that says where its focal length is from.
        has_focal: whether the focal length is known to some per cent.
        is_known: whether the camera is calibrated, and not refined.
    """

    camera: Camera
    names: tuple[str, ...]
    origin: str
    has_focal: bool = False
    is_known: bool = False

    def to_colmap(self, camera_id: int) -> pycolmap.Camera:
        """The camera in the model in which it is refined: one radial coefficient, more for a fisheye.

        Pairs of fisheyes are verified by their rays, which need a focal length: the guess counts as one.
        """
        it = from_camera(camera_id, self.camera)
        model, parameters = it.model, list(it.parameters)
        if not self.is_known:
            _, focal, x, y = parameters[:4]
            model = "RADIAL_FISHEYE" if isinstance(self.camera.distortion, Fisheye) else "SIMPLE_RADIAL"
            parameters = [focal, x, y, *([0.0, 0.0] if model == "RADIAL_FISHEYE" else [0.0])]
        return pycolmap.Camera(
            camera_id=camera_id,
            model=model,
            width=it.width_px,
            height=it.height_px,
            params=parameters,
            has_prior_focal_length=self.has_focal or model == "RADIAL_FISHEYE",
        )


def _calibrated(file: str) -> Camera:
    try:
        return read_camera(file)
    except OSError as error:
        raise ValueError(f"--lens {file}: must be {FISHEYE}, or a file with a camera: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"--lens {error}") from error


def from_colmap(camera: pycolmap.Camera) -> Camera:
    """A refined camera as mapless has it."""
    return ColmapCamera(
        camera.camera_id, camera.model_name, camera.width, camera.height, camera.params.tolist()
    ).camera()


def starting_cameras(pictures: Sequence[Picture], options: LensOptions) -> tuple[StartingCamera, ...]:
    """One camera for each make, model, lens, focal length and size, and one for each video.

    ValueError if no photograph has the size of a known camera.
    """
    sizes = {(it.width_px, it.height_px) for it in pictures}
    for camera in options.known:
        if (camera.width_px, camera.height_px) not in sizes:
            shown = ", ".join(f"{width}x{height}" for width, height in sorted(sizes))
            raise ValueError(
                f"--lens: no photograph has {camera.width_px}x{camera.height_px} pixels, as the camera has; they have "
                f"{shown}"
            )
    groups: dict[tuple[object, ...], list[Picture]] = {}
    for picture in pictures:
        groups.setdefault(_key(picture), []).append(picture)
    return tuple(_starting_camera(it, options) for it in groups.values())


def _key(picture: Picture) -> tuple[object, ...]:
    size, exif = (picture.width_px, picture.height_px), picture.exif
    if picture.time is not None:
        return (picture.source, *size)
    return exif.make, exif.model, exif.lens, exif.focal_mm, exif.film_focal_mm, exif.digital_zoom, *size


def _starting_camera(pictures: Sequence[Picture], options: LensOptions) -> StartingCamera:
    picture = pictures[0]
    width, height = picture.width_px, picture.height_px
    names = tuple(it.name for it in pictures)
    for camera in options.known:
        if (camera.width_px, camera.height_px) == (width, height):
            return StartingCamera(camera, names, "calibrated, by --lens", has_focal=True, is_known=True)
    try:
        by_exif, refusal = focal_of(picture.exif, width, height), ""
    except ValueError as error:
        by_exif, refusal = None, f"; EXIF is not used: {error}"
    guess = GUESSED_FISHEYE_FOCAL if options.fisheye else GUESSED_FOCAL
    focal_px = guess * max(width, height) if by_exif is None else by_exif.focal_px
    lens = Fisheye() if options.fisheye else None
    camera = Camera(width, height, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, lens)
    origin = f"nothing says its focal length{refusal}" if by_exif is None else "focal length by EXIF"
    return StartingCamera(camera, names, origin, has_focal=by_exif is not None)
