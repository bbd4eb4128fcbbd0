"""A photograph's EXIF: its camera, the way up, the place, and the focal length that follows.

EXIF is written by anyone: each value that is missing or impossible is as none. Its orientation is not applied to the
raster (see `decode`), and the size that it states is that of the photograph as it was taken: programs that resize or
turn a file leave it as it is.

The focal length in 35 mm film (CIPA DC-008, tag 0xA405) has the diagonal angle of view of the sensor's whole frame,
whose sides are 4:3 or 3:2. A photograph of other sides, 16:9 or 1:1, is a part of that frame; whether a maker means the
frame or the part, nothing says. A digital zoom (0xA404) is a part of the frame, too, enlarged; most makers leave the
focal length as it is without zoom.
"""

import io
import math
import struct
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags, Image

# Pillow warns of each damaged tag, of which a file of a stranger may have thousands.
warnings.filterwarnings("ignore", category=UserWarning, module=r"PIL\.TiffImagePlugin")

_FORMATS = ("JPEG", "PNG", "WEBP")
_DAMAGED = (
    ArithmeticError,
    Image.DecompressionBombError,
    KeyError,
    OSError,
    SyntaxError,
    TypeError,
    ValueError,
    struct.error,
)
"""Errors of Pillow for files whose header or EXIF it cannot read."""
_MAX_TEXT = 200
_MAX_BYTES = 2**16
"""EXIF fits into a segment of a JPEG. A PNG or WebP may have more: 1.5 MB of tags take 0.9 s, this at most 0.1 s."""
_APP1, _SCAN = 0xE1, 0xDA
_MOST_SEGMENTS = 1000
"""EXIF after more segments is not read: cameras write it first, and 2 million empty ones take seconds to pass over."""
_SEGMENTS = {*range(0xC0, 0xD0), *range(0xDA, 0xFF)}  # markers of a JPEG that a length follows
_FILM_DIAGONAL_MM = math.hypot(36, 24)
_FILM_MM = (5.0, 1000.0)
_FOCAL_MM = (0.5, 10_000.0)
_MAX_ZOOM = 100.0
_FRAMES = (4 / 3, 3 / 2)
_SAME_SIDES = 0.02
"""Relative: sides are multiples of 8 or 16 pixels."""
_SIGMA = 0.03
"""Relative: whole millimetres of a wide lens, the breathing of lenses, and borders that cameras cut off."""
_ZOOM_INCLUDED = ("apple",)
"""Makers whose focal length in 35 mm film is that with the digital zoom."""


@dataclass(frozen=True)
class GpsPosition:
    """A position on WGS84, degrees; height above the sea and horizontal accuracy in metres, None if they are not given.

    The accuracy is the tag GPSHPositioningError, which phones write; it has no stated probability.
    """

    latitude_deg: float
    longitude_deg: float
    height_m: float | None = None
    accuracy_m: float | None = None


@dataclass(frozen=True)
class Exif:
    """The values of EXIF; texts are empty and numbers 0 where it says nothing.

    `orientation` is 1 to 8: how the stored raster has to be turned to be upright, 1 as it is. `taken_px` is width and
    height of the photograph as it was taken. `direction_deg` is the direction of view, degrees clockwise from north.
    """

    make: str = ""
    model: str = ""
    lens: str = ""
    focal_mm: float = 0.0
    film_focal_mm: float = 0.0
    digital_zoom: float = 0.0
    orientation: int = 1
    taken_px: tuple[float, float] = (0.0, 0.0)
    taken_at: str = ""
    position: GpsPosition | None = None
    direction_deg: float | None = None

    @property
    def optics(self) -> tuple[object, ...]:
        """The values that photographs of one camera, lens and focal length share; empty if EXIF lacks them."""
        if not (self.make and self.model and (self.focal_mm or self.film_focal_mm)):
            return ()
        return self.make, self.model, self.lens, self.focal_mm, self.film_focal_mm, self.digital_zoom


NO_EXIF = Exif()


@dataclass(frozen=True)
class Upright:
    """How a stored raster becomes upright: its columns are reversed if it is mirrored, then it is turned clockwise."""

    is_mirrored: bool = False
    clockwise_deg: float = 0.0


_UPRIGHT = {
    2: Upright(is_mirrored=True),
    3: Upright(clockwise_deg=180.0),
    4: Upright(is_mirrored=True, clockwise_deg=180.0),
    5: Upright(is_mirrored=True, clockwise_deg=270.0),
    6: Upright(clockwise_deg=90.0),
    7: Upright(is_mirrored=True, clockwise_deg=90.0),
    8: Upright(clockwise_deg=270.0),
}
"""By EXIF's orientation; as it is for all others."""


@dataclass(frozen=True)
class ExifFocal:
    """A focal length of a raster with its standard deviation, pixels."""

    focal_px: float
    sigma_px: float


def read_exif(image: bytes) -> Exif:
    """Reads the EXIF of a JPEG, PNG or WebP file; damaged EXIF, or that of another format, is as none."""
    try:
        return exif_of(_tags(image))
    except _DAMAGED:
        return NO_EXIF


def upright_of(image: bytes) -> Upright:
    """How a JPEG, PNG or WebP file becomes upright by its EXIF; as it is without, or with damaged EXIF."""
    try:
        return _UPRIGHT.get(_tags(image).get(ExifTags.Base.Orientation, 1), Upright())
    except _DAMAGED:
        return Upright()


def _tags(image: bytes) -> Image.Exif:
    """The tags of a file; those of a PNG are read only where they precede the pixels, which would be decoded."""
    if _is_plain_jpeg(image):
        return Image.Exif()
    with Image.open(io.BytesIO(image), formats=_FORMATS) as opened:
        if opened.format == "PNG" and "exif" not in opened.info:
            return Image.Exif()
        if len(opened.info.get("exif", b"")) > _MAX_BYTES:
            return Image.Exif()
        return opened.getexif()


def _is_plain_jpeg(image: bytes) -> bool:
    """Whether a JPEG has no segment APP1, where EXIF and XMP are, before its pixels; Pillow takes 30 times as long."""
    position = 2
    for _ in range(_MOST_SEGMENTS):
        if not image.startswith(b"\xff\xd8") or position + 4 > len(image) or image[position] != 0xFF:
            return False
        kind, length = image[position + 1], int.from_bytes(image[position + 2 : position + 4], "big")
        if kind == _SCAN:
            return True
        if kind == _APP1 or kind not in _SEGMENTS or length < 2:
            return False
        position += 2 + length
    return True


def exif_of(tags: Image.Exif) -> Exif:
    """Converts EXIF that Pillow has read."""
    about, gps = tags.get_ifd(ExifTags.IFD.Exif), tags.get_ifd(ExifTags.IFD.GPSInfo)
    orientation = _number(tags, ExifTags.Base.Orientation)
    return Exif(
        make=_text(tags, ExifTags.Base.Make),
        model=_text(tags, ExifTags.Base.Model),
        lens=_text(about, ExifTags.Base.LensModel),
        focal_mm=_within(_number(about, ExifTags.Base.FocalLength), _FOCAL_MM),
        film_focal_mm=_within(_number(about, ExifTags.Base.FocalLengthIn35mmFilm), _FILM_MM),
        digital_zoom=_number(about, ExifTags.Base.DigitalZoomRatio),
        orientation=int(orientation) if orientation in range(1, 9) else 1,
        taken_px=(_number(about, ExifTags.Base.ExifImageWidth), _number(about, ExifTags.Base.ExifImageHeight)),
        taken_at=_text(about, ExifTags.Base.DateTimeOriginal),
        position=_position(gps),
        direction_deg=_direction_deg(gps),
    )


def focal_of(exif: Exif, width_px: int, height_px: int) -> ExifFocal | None:
    """The focal length of a raster of this size; None if its EXIF has no plausible one.

    ValueError if EXIF says that the raster is not the whole photograph, of which alone it has the focal length.
    """
    if not exif.film_focal_mm:
        return None
    _check_whole(exif, width_px, height_px)
    zoom = exif.digital_zoom
    if not 1 < zoom <= _MAX_ZOOM or exif.make.lower().startswith(_ZOOM_INCLUDED):  # 0, or 0/0: not used
        zoom = 1.0
    diagonal_px, spread_px = _frame_diagonal_px(width_px, height_px)
    focal_px = zoom * exif.film_focal_mm / _FILM_DIAGONAL_MM * diagonal_px
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


def _check_whole(exif: Exif, width_px: int, height_px: int) -> None:
    """Raises ValueError if the raster has other sides than the photograph had: a program has cut it."""
    taken = exif.taken_px
    if min(taken) < 1:
        return
    sides, raster = max(taken) / min(taken), max(width_px, height_px) / min(width_px, height_px)
    if abs(sides / raster - 1) > _SAME_SIDES:
        raise ValueError(
            f"the file has {width_px}x{height_px} pixels, by its EXIF the photograph had {taken[0]:g}x{taken[1]:g}: it "
            "was cut, and EXIF does not say where; send the whole photograph, or its intrinsics"
        )


def _position(gps: Mapping[int, Any]) -> GpsPosition | None:
    """The position; None if it is missing, impossible, or exactly 0, 0, which devices without a fix write."""
    latitude = _angle_deg(gps, ExifTags.GPS.GPSLatitude, "S" in _text(gps, ExifTags.GPS.GPSLatitudeRef).upper())
    longitude = _angle_deg(gps, ExifTags.GPS.GPSLongitude, "W" in _text(gps, ExifTags.GPS.GPSLongitudeRef).upper())
    if latitude is None or longitude is None or latitude == longitude == 0:
        return None
    if abs(latitude) > 90 or abs(longitude) > 180:
        return None
    height_m = _finite(gps, ExifTags.GPS.GPSAltitude)
    if height_m is not None and gps.get(ExifTags.GPS.GPSAltitudeRef) in (1, b"\x01"):
        height_m = -height_m
    accuracy_m = _number(gps, ExifTags.GPS.GPSHPositioningError)
    return GpsPosition(latitude, longitude, height_m, accuracy_m if accuracy_m > 0 else None)


def _angle_deg(gps: Mapping[int, Any], tag: int, is_negative: bool) -> float | None:
    """An angle of degrees, minutes and seconds."""
    try:
        degrees, minutes, seconds = (float(it) for it in gps[tag])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    angle = degrees + minutes / 60 + seconds / 3600
    return (-angle if is_negative else angle) if math.isfinite(angle) else None


def _direction_deg(gps: Mapping[int, Any]) -> float | None:
    """The direction of view by true north; None where it is missing or magnetic."""
    if "M" in _text(gps, ExifTags.GPS.GPSImgDirectionRef).upper():
        return None
    direction = _finite(gps, ExifTags.GPS.GPSImgDirection)
    return direction if direction is not None and 0 <= direction <= 360 else None


def _text(about: Mapping[int, Any], tag: int) -> str:
    value = about.get(tag, "")
    text = value.decode("utf-8", "replace") if isinstance(value, bytes) else str(value)
    return "".join(it for it in text if it.isprintable()).strip()[:_MAX_TEXT]


def _finite(about: Mapping[int, Any], tag: int) -> float | None:
    """A number of EXIF; None if it is missing, or is none, as 0/0."""
    try:
        value = float(about[tag])
    except (KeyError, TypeError, ValueError, ZeroDivisionError):
        return None
    return value if math.isfinite(value) else None


def _number(about: Mapping[int, Any], tag: int) -> float:
    """A number of EXIF; 0 if it is missing, or is none."""
    return _finite(about, tag) or 0.0


def _within(value: float, bounds: tuple[float, float]) -> float:
    return value if bounds[0] <= value <= bounds[1] else 0.0
