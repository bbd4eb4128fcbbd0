"""The focal length of a photograph by its EXIF, and how well it is known.

The focal length in 35 mm film (CIPA DC-008, tag 0xA405) has the diagonal angle of view of the sensor's whole frame,
whose sides are 4:3 or 3:2. A photograph of other sides, 16:9 or 1:1, is a part of that frame; whether a maker means the
frame or the part, nothing says. A digital zoom (0xA404) is a part of the frame, too, enlarged; most makers leave the
focal length as it is without zoom.
"""

import io
import math
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags, Image

_FILM_DIAGONAL_MM = math.hypot(36, 24)
_FILM_MM = (5.0, 1000.0)
_MAX_ZOOM = 100.0
_FRAMES = (4 / 3, 3 / 2)
_SAME_SIDES = 0.02
"""Relative: sides are multiples of 8 or 16 pixels."""
_SIGMA = 0.03
"""Relative: whole millimetres of a wide lens, the breathing of lenses, and borders that cameras cut off."""
_ZOOM_INCLUDED = ("apple",)
"""Makers whose focal length in 35 mm film is that with the digital zoom."""


@dataclass(frozen=True)
class ExifFocal:
    """A focal length of a raster with its standard deviation, pixels."""

    focal_px: float
    sigma_px: float


def focal_of(image: bytes, width_px: int, height_px: int) -> ExifFocal | None:
    """The focal length of a file, whose raster has this size; None if its EXIF has no plausible one.

    ValueError if EXIF says that the raster is not the whole photograph, of which alone it has the focal length.
    """
    try:
        with Image.open(io.BytesIO(image)) as opened:
            tags = opened.getexif()
            about, maker = dict(tags.get_ifd(ExifTags.IFD.Exif)), str(tags.get(ExifTags.Base.Make, ""))
    except (OSError, SyntaxError, ValueError, TypeError, KeyError, struct.error):  # damaged EXIF is as none
        return None
    film_mm = _number(about, ExifTags.Base.FocalLengthIn35mmFilm)
    if not _FILM_MM[0] <= film_mm <= _FILM_MM[1]:
        return None
    _check_whole(about, width_px, height_px)
    zoom = _number(about, ExifTags.Base.DigitalZoomRatio)
    if not 1 < zoom <= _MAX_ZOOM or maker.strip().lower().startswith(_ZOOM_INCLUDED):  # 0, or 0/0: not used
        zoom = 1.0
    diagonal_px, spread_px = _frame_diagonal_px(width_px, height_px)
    focal_px = zoom * film_mm / _FILM_DIAGONAL_MM * diagonal_px
    return ExifFocal(focal_px, focal_px * math.hypot(_SIGMA, spread_px / diagonal_px))


def _frame_diagonal_px(width_px: int, height_px: int) -> tuple[float, float]:
    """The diagonal of the sensor's frame in pixels of the raster, and how far it may be another."""
    long_px, short_px = max(width_px, height_px), min(width_px, height_px)
    own_px = math.hypot(long_px, short_px)
    sides = long_px / short_px
    if any(abs(sides / frame - 1) <= _SAME_SIDES for frame in _FRAMES):
        return own_px, 0.0
    frames_px = [
        math.hypot(long_px, long_px / frame) if sides > frame else math.hypot(short_px * frame, short_px)
        for frame in _FRAMES
    ]
    # Most cameras of all are phones, whose sensors are 4:3.
    return frames_px[0], max(abs(it - frames_px[0]) for it in (own_px, *frames_px))


def _check_whole(about: Mapping[int, Any], width_px: int, height_px: int) -> None:
    """Raises ValueError if the raster has other sides than the photograph had: a program has cut it."""
    taken = _number(about, ExifTags.Base.ExifImageWidth), _number(about, ExifTags.Base.ExifImageHeight)
    if min(taken) < 1:
        return
    sides, raster = max(taken) / min(taken), max(width_px, height_px) / min(width_px, height_px)
    if abs(sides / raster - 1) > _SAME_SIDES:
        raise ValueError(
            f"the file has {width_px}x{height_px} pixels, by its EXIF the photograph had {taken[0]:g}x{taken[1]:g}: it "
            "was cut, and EXIF does not say where; send the whole photograph, or its intrinsics"
        )


def _number(about: Mapping[int, Any], tag: int) -> float:
    """A number of EXIF; 0 if it is missing, or is none, as 0/0."""
    try:
        value = float(about.get(tag, 0))
    except (TypeError, ValueError, ZeroDivisionError):
        return 0.0
    return value if math.isfinite(value) else 0.0
