"""EXIF of photographs: camera, way up, place and focal length.

Laws: damaged EXIF is as none, never an error; what is read is in the range that its type states; the focal length is
positive, and the two readings of the orientation agree.
"""

from __future__ import annotations

import io
import math
import struct
from functools import cache
from random import Random

from PIL import ExifTags, Image

from mapless_server.images import upright_of
from mapless_server.images.exif import NO_EXIF, GpsPosition, Upright, focal_of, read_exif

from .target import MutateBytes, Target

_SIZES = ((64, 48), (64, 36))
_MAX_CHARACTERS = 200
_START = b"Exif\0\0"


def check(data: bytes) -> bool:
    """See Target; the input is EXIF, which is put into a JPEG and a WebP."""
    found = [read_exif(it) for it in _files(data)]
    for exif, file in zip(found, _files(data), strict=True):
        for text in (exif.make, exif.model, exif.lens, exif.taken_at):
            assert text.isprintable()
            assert len(text) <= _MAX_CHARACTERS
        assert 1 <= exif.orientation <= 8
        assert (exif.orientation == 1) == (upright_of(file) == Upright()), exif.orientation
        assert all(map(math.isfinite, (exif.focal_mm, exif.film_focal_mm, exif.digital_zoom, *exif.taken_px)))
        assert exif.direction_deg is None or 0 <= exif.direction_deg <= 360
        _check_position(exif.position)
        for size in _SIZES:
            try:
                focal = focal_of(exif, *size)
            except ValueError as error:
                assert len(str(error)) < 300
                continue
            assert focal is None or 0 < focal.sigma_px < focal.focal_px < math.inf
    return any(it != NO_EXIF for it in found)


def _check_position(position: GpsPosition | None) -> None:
    if position is None:
        return
    assert abs(position.latitude_deg) <= 90
    assert abs(position.longitude_deg) <= 180
    assert position.height_m is None or math.isfinite(position.height_m)
    assert position.accuracy_m is None or 0 < position.accuracy_m < math.inf


def _files(exif: bytes) -> list[bytes]:
    """A JPEG and a WebP with this EXIF, by the segments and chunks that a file has it in."""
    jpeg, webp = _plain()
    segment = b"\xff\xe1" + struct.pack(">H", len(exif) + len(_START) + 2) + _START + exif
    chunk = b"EXIF" + struct.pack("<I", len(exif)) + exif + bytes(len(exif) % 2)
    extended = b"VP8X" + struct.pack("<I", 10) + bytes([8, 0, 0, 0]) + bytes([63, 0, 0, 47, 0, 0])
    body = b"WEBP" + extended + webp[12:] + chunk
    return [jpeg[:2] + segment + jpeg[2:], b"RIFF" + struct.pack("<I", len(body)) + body]


@cache
def _plain() -> tuple[bytes, bytes]:
    files = []
    for kind in ("JPEG", "WEBP"):
        file = io.BytesIO()
        Image.new("RGB", _SIZES[0]).save(file, kind)
        files.append(file.getvalue())
    return files[0], files[1]


@cache
def seeds() -> tuple[bytes, ...]:
    """EXIF of phones, held in all ways, with places of both hemispheres."""
    return tuple(_exif(orientation) for orientation in range(1, 9))


def _exif(orientation: int) -> bytes:
    tags = Image.Exif()
    tags[ExifTags.Base.Make], tags[ExifTags.Base.Model] = "Maker", f"Phone {orientation}"
    tags[ExifTags.Base.Orientation] = orientation
    about = tags.get_ifd(ExifTags.IFD.Exif)
    about[ExifTags.Base.FocalLength] = 5.7
    about[ExifTags.Base.FocalLengthIn35mmFilm] = 20 + orientation
    about[ExifTags.Base.DigitalZoomRatio] = 1.0 * (orientation % 3)
    about[ExifTags.Base.ExifImageWidth], about[ExifTags.Base.ExifImageHeight] = 640, 480
    about[ExifTags.Base.DateTimeOriginal] = "2026:11:29 12:00:00"
    place = tags.get_ifd(ExifTags.IFD.GPSInfo)
    place[ExifTags.GPS.GPSLatitudeRef], place[ExifTags.GPS.GPSLatitude] = "NS"[orientation % 2], (47.0, 22.0, 10.5)
    place[ExifTags.GPS.GPSLongitudeRef], place[ExifTags.GPS.GPSLongitude] = "EW"[orientation % 2], (8.0, 32.0, 0.0)
    place[ExifTags.GPS.GPSAltitude], place[ExifTags.GPS.GPSHPositioningError] = 410.0, 4.7
    place[ExifTags.GPS.GPSImgDirectionRef], place[ExifTags.GPS.GPSImgDirection] = "T", 123.0
    return tags.tobytes().removeprefix(_START)


def _mutated(data: bytes, random: Random, mutate: MutateBytes) -> bytes:
    """Changes the type, count or offset of an entry, or the bytes of a part: mutations of all mostly end the header."""
    start = random.randrange(max(1, len(data)))
    if random.random() < 0.5:
        changed = bytearray(data)
        at = min(start, max(0, len(data) - 4))
        changed[at : at + 4] = struct.pack(">I", random.choice((0, 1, 2, 3, 7, 10, 12, 0xFFFF, 0xFFFFFFFF)))[
            : len(data)
        ]
        return bytes(changed[: len(data)])
    end = start + random.randrange(1, 16)
    return data[:start] + mutate(data[start:end]) + data[end:]


TARGET = Target(
    seeds, check, _mutated, max_bytes=2048, words=(b"MM\0*", b"II*\0", b"\x87\x69", b"\x88\x25", b"\x01\x12")
)
