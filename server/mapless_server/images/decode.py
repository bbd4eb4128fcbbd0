"""Decodes the bytes of an image file to pixels, and names what is wrong with a file.

The header is read first, by the parsers below: decoders allocate for whatever size a header claims, and a file of 1 MB
can claim 900 megapixels. Only JPEG, PNG and WebP are accepted, by their first bytes: a decoder library reads many
more formats than have been hardened.

Pixels are returned as the file stores them. EXIF orientation is meant for viewers; intrinsics and poses refer to the
sensor. Only the columns of a raster that is mirrored by its EXIF are reversed: no camera with a pose sees such a one.
"""

import re
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.deep_pixels import eight_bits
from mapless.pixels import JPEG_FRAMES, BadHeader, size_of_image
from mapless_server.errors import InvalidArgument

from .exif import upright_of
from .png_chunks import essential_png

# IMREAD_UNCHANGED would also ignore the orientation, but keeps alpha. Asked for colour, the decoder drops alpha,
# repeats grey and converts CMYK.
_DECODE_FLAGS = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
# The high byte of a PNG with 16 bits, which the decoder would keep, is almost black for cameras of 10 or 12.
_DEEP_FLAGS = _DECODE_FLAGS | cv2.IMREAD_ANYDEPTH
_PNG_DEPTH = 24  # position of the bits of a channel
_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG_MARKER = re.compile(rb"\xff[\x01-\xcf\xd9-\xfe]", re.DOTALL)
_MAX_JPEG_SCANS = 100  # a progressive file has about ten; thousands make a small file decode for minutes

_JPEG_END = b"\xff\xd9"
_JPEG_RESTART = re.compile(rb"\xff[\xd0-\xd7]")
# The data that could follow a scan that is cut off; several, since few bits may be missing.
_JPEG_DATA = (b"\x5a\x96\x35\xc7" * 64, b"\xaa\x35\xe1" * 64, b"\xff\x00\xc7" * 64)
_MAX_UNENDED_PIXELS = 16_000_000  # are decoded four times


@dataclass(frozen=True)
class ImageLimits:
    """Limits of the images that are accepted; those of the sides are inclusive. No depth sensor has as many pixels."""

    max_bytes: int = 16 * 2**20
    max_pixels: int = 66_000_000
    min_side_px: int = 32
    max_side_px: int = 16384
    max_depth_pixels: int = 4_000_000


ANY_SIZE = ImageLimits(max_bytes=2**40, max_pixels=2**40, min_side_px=1, max_side_px=2**30, max_depth_pixels=2**40)
"""For images whose header alone is read, and for stored ones, which were accepted with the limits of their time."""


def image_size(data: bytes, limits: ImageLimits, field: str = "image", what: str = "image") -> tuple[int, int]:
    """Width and height of an image, pixels, from its header alone; messages say `what` it is.

    InvalidArgument, naming `field`, if the file is empty, has too many bytes, is not a JPEG, PNG or WebP, is cut within
    its header, or has a size that is not accepted.
    """
    if not data:
        raise InvalidArgument(f"the {what} is empty", reason="IMAGE_EMPTY", field=field)
    if len(data) > limits.max_bytes:
        raise InvalidArgument(
            f"the {what} has {len(data)} bytes, at most {limits.max_bytes} are accepted",
            reason="IMAGE_TOO_LARGE",
            field=field,
        )
    try:
        width, height = size_of_image(data, what)
    except BadHeader as error:
        raise InvalidArgument(str(error), reason=error.reason, field=field) from None
    if min(width, height) < limits.min_side_px:
        raise InvalidArgument(
            f"the {what} is {width}x{height} pixels, its sides must be at least {limits.min_side_px}",
            reason="IMAGE_TOO_SMALL",
            field=field,
        )
    if max(width, height) > limits.max_side_px or width * height > limits.max_pixels:
        raise InvalidArgument(
            f"the {what} is {width}x{height} pixels; at most {limits.max_pixels} in all and {limits.max_side_px} a "
            "side are accepted: reduce it, by half for instance, and its intrinsics with it",
            reason="IMAGE_TOO_LARGE",
            field=field,
        )
    return width, height


def decode_image(data: bytes, limits: ImageLimits, field: str = "image") -> NDArray[np.uint8]:
    """Pixels of an image, (H, W, 3) RGB, as the file stores them: EXIF orientation is not applied.

    The columns are reversed where it says that they are mirrored. Pixels of 16 bits are stretched to 8, see
    `mapless.deep_pixels`.

    InvalidArgument as of `image_size`, or if the decoder cannot read the file to its end.
    """
    width, height = image_size(data, limits, field)
    if data.startswith(b"\xff\xd8") and _has_many_scans(data):
        raise InvalidArgument("the JPEG has too many scans", reason="IMAGE_TOO_COMPLEX", field=field)
    is_mirrored = upright_of(data).is_mirrored
    if data.startswith(_PNG):
        data = essential_png(data, field)
    pixels = _decoded(data)
    if pixels is None and width * height <= _MAX_UNENDED_PIXELS:
        pixels = _decoded_without_end(data)
    if pixels is None:
        raise InvalidArgument(
            "the image cannot be decoded: truncated or damaged", reason="IMAGE_UNDECODABLE", field=field
        )
    if pixels.shape != (height, width, 3):
        raise InvalidArgument(
            f"the image decodes to {pixels.shape[1]}x{pixels.shape[0]} pixels, its header says {width}x{height}",
            reason="IMAGE_UNDECODABLE",
            field=field,
        )
    pixels = eight_bits(pixels) if pixels.dtype == np.uint16 else np.asarray(pixels, np.uint8)
    return np.ascontiguousarray(pixels[:, ::-1]) if is_mirrored else pixels


def _decoded(data: bytes) -> NDArray[Any] | None:
    """The decoder's pixels; None if it cannot read the file."""
    is_deep = data.startswith(_PNG) and data[_PNG_DEPTH] == 16
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), _DEEP_FLAGS if is_deep else _DECODE_FLAGS)
    except cv2.error:
        return None


def _decoded_without_end(file: bytes) -> NDArray[Any] | None:
    """Decodes a JPEG that lacks only its end marker; None for any other file.

    Some cameras with MJPEG write such files. If anything else is missing, the pixels depend on what follows the data.
    """
    scan_start = _unended_scan(file)
    kept = file.rstrip(b"\xff")
    pixels = _decoded(kept + _JPEG_END) if scan_start else None
    if pixels is None:
        return None
    # Each interval that may be missing begins with the next of eight markers. After a whole scan all of it is ignored.
    restarts = _JPEG_RESTART.findall(kept, scan_start)
    markers = [bytes([0xFF, 0xD0 + (len(restarts) + i) % 8]) for i in range(8)]
    continued = (_decoded(kept + data.join([b"", *markers, b""]) + _JPEG_END) for data in _JPEG_DATA)
    return pixels if all(it is not None and np.array_equal(it, pixels) for it in continued) else None


def _unended_scan(data: bytes) -> int:
    """Position at which the only, sequential scan of a JPEG without an end marker begins; 0 for any other file."""
    if not data.startswith(b"\xff\xd8"):
        return 0
    position, components, scan_start = 2, 0, 0
    while marker := _JPEG_MARKER.search(data, position):
        kind, start = marker[0][-1], marker.end()
        if kind == 0xD9 or scan_start or start + 8 > len(data):
            return 0
        if kind in JPEG_FRAMES:
            if kind > 0xC1:  # progressive: later scans may be missing, too
                return 0
            components = data[start + 7]
        if kind == 0xDA:
            if data[start + 2] != components:
                return 0
            scan_start = start
        position = start + int.from_bytes(data[start : start + 2], "big")
    return scan_start


def _has_many_scans(data: bytes) -> bool:
    """Whether a JPEG has more than _MAX_JPEG_SCANS scans, counted by its markers up to the end of its image."""
    position, scans = 2, 0
    while scans <= _MAX_JPEG_SCANS:
        # Within a scan's data FF is always followed by 00 or a restart marker.
        marker = _JPEG_MARKER.search(data, position)
        if marker is None or marker[0][-1] == 0xD9:
            return False
        scans += marker[0][-1] == 0xDA
        position = marker.end() + int.from_bytes(data[marker.end() : marker.end() + 2], "big")
    return True
