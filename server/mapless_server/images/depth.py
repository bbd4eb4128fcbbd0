"""Decodes depth images: PNG files with one channel of 16 bits, or values of 32 bits.

The header is checked when a request is read, the values when they are decoded.
"""

from dataclasses import replace
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.depth import DepthImage
from mapless_server.errors import InvalidArgument

from .decode import ANY_SIZE, ImageLimits, image_size
from .png_chunks import essential_png, png_chunk_names

T = TypeVar("T", np.uint8, np.uint16)

_PNG = b"\x89PNG\r\n\x1a\n"
_BITS, _COLOUR = 24, 25
"""Positions of the bits of a channel, and of the colour type, in a PNG."""
_GREY = 0
_OTHERS = {
    b"\xff\xd8": "a JPEG, whose values are not exact",
    b"II*\0": "a TIFF",
    b"MM\0*": "a TIFF",
    b"RIFF": "a WebP",
    b"\x76\x2f\x31\x01": "an OpenEXR file",
    b"\x93NUMPY": "a file of NumPy",
    b"P5": "a PGM",
}
"""Files that are no PNG, by their first bytes."""
_SATURATED = 65535


def check_depth(depth: DepthImage, photo: tuple[int, int], limits: ImageLimits, field: str = "depth") -> None:
    """Checks what a depth image says of itself, for a photograph of this size, (width, height) pixels.

    InvalidArgument, naming the field, if the bytes are no PNG with one channel of 16 bits, too large, animated, or of
    another size than the depth camera, or without one than the photograph's aspect; likewise its confidence, of 8 bits.
    """
    path = f"{field}.png" if depth.size is None else f"{field}.float32"
    _check_bytes(depth.data, limits, path, "depth")
    size = depth.size or _checked_png(depth.data, 16, limits.min_side_px, path, "depth")
    if size[0] * size[1] > limits.max_depth_pixels or max(size) > limits.max_side_px:
        message = (
            f"the depth is {size[0]}x{size[1]} pixels; at most {limits.max_depth_pixels} in all and "
            f"{limits.max_side_px} a side are accepted: reduce it, and its intrinsics with it"
        )
        raise InvalidArgument(message, reason="DEPTH_TOO_LARGE", field=path)
    camera = depth.camera
    if camera is not None and (camera.width_px, camera.height_px) != size:
        message = (
            f"the depth is {size[0]}x{size[1]} pixels, its intrinsics are for {camera.width_px}x{camera.height_px}"
        )
        raise InvalidArgument(message, reason="DEPTH_SIZE", field=f"{field}.intrinsics")
    if camera is None and abs(size[0] * photo[1] - size[1] * photo[0]) > max(*photo, *size):
        message = (
            f"the depth is {size[0]}x{size[1]} pixels, the photograph {photo[0]}x{photo[1]}, which is another aspect: "
            "give the intrinsics of the depth camera"
        )
        raise InvalidArgument(message, reason="DEPTH_SIZE", field=f"{field}.intrinsics")
    if depth.confidence:
        path = f"{field}.confidence"
        _check_bytes(depth.confidence, limits, path, "confidence")
        if (found := _checked_png(depth.confidence, 8, 1, path, "confidence")) != size:
            message = f"the confidence is {found[0]}x{found[1]} pixels, the depth {size[0]}x{size[1]}"
            raise InvalidArgument(message, reason="DEPTH_SIZE", field=path)


def decode_depth(
    depth: DepthImage, photo: tuple[int, int], limits: ImageLimits, field: str = "depth"
) -> NDArray[np.float32]:
    """Depths (H, W) of a depth image, in the unit of poses; NaN where there is none.

    InvalidArgument as of `check_depth`, or if the bytes are damaged, a value is below 0, or there is no value.
    """
    check_depth(depth, photo, limits, field)
    if depth.size is None:
        steps = _decoded(depth.data, np.uint16, f"{field}.png")
        values = steps.astype(np.float32)
        values[(steps == 0) | (steps == _SATURATED)] = np.nan
    else:
        values = np.frombuffer(depth.data, "<f4").reshape(depth.size[::-1])
        if (values < 0).any():
            message = f"depths must not be below 0, the least is {np.nanmin(values):g}; is its camera's z backward?"
            raise InvalidArgument(message, reason="DEPTH_NEGATIVE", field=f"{field}.float32")
        values = values.copy()
    if depth.confidence:
        confidence = _decoded(depth.confidence, np.uint8, f"{field}.confidence")
        values[confidence < depth.min_confidence] = np.nan
    with np.errstate(over="ignore", under="ignore"):
        values *= np.float32(depth.unit_m)
    # Of smaller ones the inverse is not finite.
    values[~(np.isfinite(values) & (values >= np.finfo(np.float32).tiny))] = np.nan
    if np.isnan(values).all():
        message = "no pixel of the depth has a value that is used"
        raise InvalidArgument(message, reason="DEPTH_EMPTY", field=field)
    return values


def _check_bytes(data: bytes, limits: ImageLimits, field: str, what: str) -> None:
    if len(data) > limits.max_bytes:
        message = f"the {what} has {len(data)} bytes, at most {limits.max_bytes} are accepted"
        raise InvalidArgument(message, reason="DEPTH_TOO_LARGE", field=field)


def _checked_png(data: bytes, bits: int, min_side_px: int, field: str, what: str) -> tuple[int, int]:
    """Width and height, of any size from the least, of a PNG with one channel of so many bits, by its header."""
    if not data.startswith(_PNG):
        message = f"must be a PNG with one channel of {bits} bits, {_found_instead(data)}"
        raise InvalidArgument(message, reason="DEPTH_NOT_PNG", field=field)
    size = image_size(data, replace(ANY_SIZE, min_side_px=min_side_px), field, what)
    if data[_BITS] != bits or data[_COLOUR] != _GREY:
        message = (
            f"the PNG must have one channel of {bits} bits, has {data[_BITS]} bits and colour type {data[_COLOUR]}"
        )
        raise InvalidArgument(message, reason="DEPTH_UNSUPPORTED", field=field)
    if b"acTL" in png_chunk_names(data):
        raise InvalidArgument("the PNG is animated; it must have one picture", reason="DEPTH_UNSUPPORTED", field=field)
    return size


def _found_instead(data: bytes) -> str:
    """A clause that says what a file is that is no PNG, by its first bytes."""
    if not data:
        return "is empty"
    known = (kind for start, kind in _OTHERS.items() if data.startswith(start))
    if kind := next(known, ""):
        return f"is {kind}"
    first = data[:16]
    if first.isascii() and first.decode().replace("\n", "").isprintable():
        return f"is text, which begins with {first.decode()!r}"
    return f"begins with the bytes {first[:4].hex(' ')}: float32 values need their width and height"


def _decoded(data: bytes, kind: type[T], field: str) -> NDArray[T]:
    essential = essential_png(data, field, "depth")
    try:
        pixels = cv2.imdecode(np.frombuffer(essential, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.ndim != 2 or pixels.dtype != kind:
        message = "the PNG cannot be decoded: truncated or damaged"
        raise InvalidArgument(message, reason="IMAGE_UNDECODABLE", field=field)
    return np.asarray(pixels, kind)
