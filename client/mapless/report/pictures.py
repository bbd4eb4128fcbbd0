"""Photographs inside a page: unchanged if small, else reduced, and always without metadata.

A viewer rotates a picture by its EXIF orientation, but intrinsics and pixels belong to the raster in the file. So
metadata, and data after the picture, are removed; with them goes the position that phones record.
"""

import base64
import io
import re
from dataclasses import dataclass

import numpy as np

from ..deep_pixels import eight_bits
from ..pixels import format_of_image

REDUCED_SIDE_PX = 1600
_SEGMENTS_WITHOUT_LENGTH = {0x01, *range(0xD0, 0xD9)}
_START_OF_SCAN, _END_OF_IMAGE, _COMMENT = 0xDA, 0xD9, 0xFE
_KEPT_SEGMENTS = {0xE0: b"JFIF\0", 0xE2: b"ICC_PROFILE\0", 0xEE: b"Adobe"}
"""Application segments that decoders need, with their first bytes; a phone's index of further pictures is E2, too."""
_AFTER_SCAN = re.compile(rb"\xff[^\x00\xff\xd0-\xd7]")
"""A marker that ends the coded data of a scan; FF 00 is an escaped byte, D0 to D7 are restarts within the data."""
_PNG_METADATA = (b"eXIf", b"tEXt", b"zTXt", b"iTXt", b"tIME")
_WEBP_METADATA = (b"EXIF", b"XMP ")
_EXIF_AND_XMP = 0x0C
"""Bits of a WebP's extended header."""


@dataclass(frozen=True)
class Picture:
    """A photograph in a page; without a `uri` it is omitted, for the reason in `note`."""

    uri: str = ""
    note: str = ""


def picture(image: bytes, max_bytes: int) -> Picture:
    """A JPEG, PNG or WebP for a page, of at most `max_bytes` before its encoding as text."""
    kind = format_of_image(image)
    if not kind:
        return Picture(note="The photograph is not a JPEG, PNG or WebP file, and is omitted.")
    try:
        data = {"jpeg": _clean_jpeg, "png": _clean_png, "webp": _clean_webp}[kind](image)
    except IndexError:
        return Picture(note="The photograph's file is damaged, and is omitted.")
    if len(data) > max_bytes:
        reduced = _reduced(data)
        if reduced is None or len(reduced) > max_bytes:
            return Picture(
                note=f"The photograph has {len(data) / 1e6:.1f} MB, too much for a page, and is "
                "omitted; with the Python package pillow installed it is reduced."
            )
        kind, data = "jpeg", reduced
    return Picture(f"data:image/{kind};base64,{base64.b64encode(data).decode('ascii')}")


def _clean_jpeg(image: bytes) -> bytes:
    """Cuts a JPEG after its end, and removes comments and application segments that a decoder does not need.

    A missing end marker, which decoders accept, is added. IndexError if the structure is damaged, as of the others.
    """
    parts, position = [image[:2]], 2
    while True:
        if image[position] != 0xFF:
            raise IndexError
        marker = image[position + 1]
        if marker == _END_OF_IMAGE:
            return b"".join([*parts, b"\xff\xd9"])
        size = 2 if marker in _SEGMENTS_WITHOUT_LENGTH else 2 + int.from_bytes(_take(image, position + 2, 2), "big")
        segment = b"\xff" if marker == 0xFF else _take(image, position, size)
        if marker == _START_OF_SCAN:  # of which a progressive file has several, with tables between them
            after = _AFTER_SCAN.search(image, position + size)
            segment = image[position : after.start() if after else len(image)]
        is_application = 0xE0 <= marker <= 0xEF
        if marker in _KEPT_SEGMENTS:
            is_application = not segment[4:].startswith(_KEPT_SEGMENTS[marker])
        if not is_application and marker != _COMMENT:
            parts.append(segment)
        position += len(segment)
        if marker == _START_OF_SCAN and position == len(image):
            return b"".join([*parts, b"\xff\xd9"])


def _clean_png(image: bytes) -> bytes:
    parts, position, kind = [image[:8]], 8, b""
    while position < len(image) and kind != b"IEND":
        chunk = _take(image, position, 12 + int.from_bytes(_take(image, position, 4), "big"))
        kind = chunk[4:8]
        if kind not in _PNG_METADATA:
            parts.append(chunk)
        position += len(chunk)
    return b"".join(parts)


def _clean_webp(image: bytes) -> bytes:
    """Keeps only the chunks within the size that the file states."""
    parts, position = [], 12
    image = image[: 8 + int.from_bytes(image[4:8], "little")]
    while position < len(image):
        size = int.from_bytes(_take(image, position + 4, 4), "little")
        chunk = _take(image, position, 8 + size) + b"\0" * (size % 2)
        if chunk[:4] == b"VP8X":
            chunk = chunk[:8] + bytes([chunk[8] & ~_EXIF_AND_XMP]) + chunk[9:]
        if chunk[:4] not in _WEBP_METADATA:
            parts.append(chunk)
        position += len(chunk)
    body = b"WEBP" + b"".join(parts)
    return b"RIFF" + len(body).to_bytes(4, "little") + body


def _take(data: bytes, position: int, size: int) -> bytes:
    if size <= 0 or position + size > len(data):
        raise IndexError
    return data[position : position + size]


def _reduced(image: bytes) -> bytes | None:
    """A smaller JPEG; None if pillow is not installed or cannot read the image."""
    try:
        from PIL import Image
    except ImportError:
        return None
    out = io.BytesIO()
    try:
        with Image.open(io.BytesIO(image)) as opened:
            opened.draft("RGB", (REDUCED_SIDE_PX, REDUCED_SIDE_PX))
            is_deep = opened.mode.startswith("I")  # pillow would cut 16 bits off at 255
            small = (Image.fromarray(eight_bits(np.asarray(opened))) if is_deep else opened).convert("RGB")
            small.thumbnail((REDUCED_SIDE_PX, REDUCED_SIDE_PX))
            small.save(out, "JPEG", quality=85)
    except (OSError, ValueError, Image.DecompressionBombError):
        return None
    return out.getvalue()
