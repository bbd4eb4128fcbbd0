"""Decodes masks: PNG files of a photograph's size, in which 0 means ignore.

A mask is a PNG because values must be exact: the black of a JPEG is seldom 0. The header is checked when a request is
read, the pixels when they are decoded.
"""

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless_server.errors import InvalidArgument

from .decode import ImageLimits, image_size
from .png_chunks import essential_png, png_chunk_names

_PNG = b"\x89PNG\r\n\x1a\n"
_DEPTH, _COLOUR = 24, 25
"""Positions of the bits of a channel, and of the colour type, in a PNG."""
_WITH_ALPHA = (4, 6)
"""Colour types."""


def check_mask(data: bytes, size: tuple[int, int], limits: ImageLimits, field: str = "mask") -> None:
    """Checks the header of a mask for an image of this size, (width, height) pixels.

    InvalidArgument, naming `field`, if the file is empty, no PNG, too large, animated, of 16 bits, or of another size.
    """
    if not data:
        message = "the mask is empty: leave it out to use the whole image"
        raise InvalidArgument(message, reason="MASK_EMPTY", field=field)
    if len(data) > limits.max_bytes:
        message = f"the mask has {len(data)} bytes, at most {limits.max_bytes} are accepted"
        raise InvalidArgument(message, reason="MASK_TOO_LARGE", field=field)
    if not data.startswith(_PNG):
        kind = "is a JPEG, whose black is not exactly 0: it must be" if data.startswith(b"\xff\xd8") else "must be"
        raise InvalidArgument(f"the mask {kind} a PNG, in which 0 means ignore", reason="MASK_NOT_PNG", field=field)
    # The image's own size was accepted, so the mask's is, too.
    any_size = replace(limits, min_side_px=1, max_side_px=2**31, max_pixels=2**62)
    found = image_size(data, any_size, field)
    if found != size:
        turned = "; one of the two has been turned by its EXIF orientation" if found == size[::-1] else ""
        message = f"the mask is {found[0]}x{found[1]} pixels, the image {size[0]}x{size[1]}{turned}"
        raise InvalidArgument(message, reason="MASK_SIZE", field=field)
    if data[_DEPTH] == 16:
        message = "the mask has 16 bits a channel, as depth has; at most 8 are accepted"
        raise InvalidArgument(message, reason="MASK_UNSUPPORTED", field=field)
    if b"acTL" in png_chunk_names(data):
        message = "the mask is an animated PNG; it must have one picture"
        raise InvalidArgument(message, reason="MASK_UNSUPPORTED", field=field)


def decode_mask(
    data: bytes, size: tuple[int, int], limits: ImageLimits, field: str = "mask"
) -> NDArray[np.bool_] | None:
    """The ignored pixels of a mask, (H, W), for an image of this size, (width, height); None if it ignores none.

    Grey values and colours of palettes and colour images count, not indices of palettes: a pixel is ignored if all its
    channels are 0. InvalidArgument as of `check_mask`, or if pixels are transparent, or the file is damaged.
    """
    check_mask(data, size, limits, field)
    essential = essential_png(data, field, "mask")
    try:
        pixels = cv2.imdecode(np.frombuffer(essential, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        pixels = None
    if pixels is None or pixels.shape[:2] != size[::-1] or pixels.dtype != np.uint8:
        message = "the mask cannot be decoded: truncated or damaged"
        raise InvalidArgument(message, reason="IMAGE_UNDECODABLE", field=field)
    colours = pixels if pixels.ndim == 3 else pixels[:, :, None]
    has_alpha = data[_COLOUR] in _WITH_ALPHA
    if b"tRNS" in png_chunk_names(data) or (has_alpha and colours[:, :, -1].min() < 255):
        message = "the mask has transparent pixels, which may mean either; black must mean ignore, without transparency"
        raise InvalidArgument(message, reason="MASK_UNSUPPORTED", field=field)
    ignored = ~np.any(colours[:, :, : 3 if has_alpha else None], axis=2)
    return ignored if ignored.any() else None
