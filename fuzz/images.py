"""Image decoding: header checks and pixels of JPEG, PNG and WebP.

Laws: every refusal is an InvalidArgument that names the field; what is accepted has the size that its header says, and
the same pixels whatever the memory held before, so that nothing half read passes for a photograph.

The decoders are native and give no coverage, so that only our own reading of headers guides what is tried. The mutator
corrects the checksums of PNG chunks, which would otherwise be rejected first.
"""

from __future__ import annotations

import ctypes
import struct
import zlib
from functools import cache
from random import Random

import cv2
import numpy as np
from support.images import cmyk_jpeg, encode, textured, with_exif_orientation

from mapless_server.errors import InvalidArgument
from mapless_server.images import ANY_SIZE, ImageLimits, decode_image, image_size

from .target import MutateBytes, Target

FIELD = "photo"
LIMITS = ImageLimits(max_pixels=128 * 128)
"""Small, so that a million are decoded; what is larger takes the same way."""

_PNG = b"\x89PNG\r\n\x1a\n"
_M_PERTURB = -6  # of glibc's mallopt: what fresh memory is filled with


def check(data: bytes) -> bool:
    """See Target."""
    size = _size(data, LIMITS)
    anyhow = _size(data, ANY_SIZE)
    assert size is None or size == anyhow, (size, anyhow)
    pixels = _pixels(data, 0x55)
    if pixels is None:
        return False
    assert size is not None
    assert pixels.shape == (size[1], size[0], 3)
    assert pixels.dtype == np.uint8
    again = _pixels(data, 0xAA)
    assert again is not None
    assert np.array_equal(pixels, again), "pixels that nothing was decoded to"
    return True


def _size(data: bytes, limits: ImageLimits) -> tuple[int, int] | None:
    try:
        width, height = image_size(data, limits, FIELD)
    except InvalidArgument as error:
        _check_refusal(error)
        return None
    assert limits.min_side_px <= min(width, height) <= max(width, height) <= limits.max_side_px
    assert width * height <= limits.max_pixels
    return width, height


def _pixels(data: bytes, fill: int) -> np.ndarray | None:
    _fill_fresh_memory(fill)
    try:
        return decode_image(data, LIMITS, FIELD)
    except InvalidArgument as error:
        _check_refusal(error)
        return None
    finally:
        _fill_fresh_memory(0)


def _check_refusal(error: InvalidArgument) -> None:
    assert error.field == FIELD
    assert error.reason.startswith("IMAGE_"), error.reason
    assert len(str(error)) < 300


@cache
def _mallopt() -> ctypes._FuncPointer | None:
    return getattr(ctypes.CDLL(None), "mallopt", None)


def _fill_fresh_memory(fill: int) -> None:
    mallopt = _mallopt()
    if mallopt is not None:
        mallopt(_M_PERTURB, fill)


@cache
def seeds() -> tuple[bytes, ...]:
    """Files of every kind that is accepted, as small as they are accepted."""
    rgb = textured(32, 33)
    jpeg = encode(".jpg", rgb)
    deep = np.random.default_rng(1).integers(0, 65536, (32, 32, 3)).astype(np.uint16)
    return (
        jpeg,
        encode(".jpg", rgb, int(cv2.IMWRITE_JPEG_PROGRESSIVE), 1),
        encode(".jpg", rgb, int(cv2.IMWRITE_JPEG_RST_INTERVAL), 1),
        encode(".jpg", rgb[..., 0]),
        with_exif_orientation(jpeg, 6),
        cmyk_jpeg(np.random.default_rng(2).integers(0, 256, (4, 4, 4)).astype(np.uint8)),
        encode(".png", rgb),
        encode(".png", rgb[..., 0]),
        encode(".png", deep),
        encode(".png", np.dstack([rgb, rgb[..., :1]])),
        _with_chunk(encode(".png", rgb[..., 0]), b"tEXt", b"Comment\0what for"),
        _with_chunk(encode(".png", rgb), b"acTL", struct.pack(">II", 2, 0)),
        encode(".webp", rgb, int(cv2.IMWRITE_WEBP_QUALITY), 101),
        encode(".webp", rgb, int(cv2.IMWRITE_WEBP_QUALITY), 60),
        encode(".webp", np.dstack([rgb, rgb[..., :1]]), int(cv2.IMWRITE_WEBP_QUALITY), 60),
    )


def chunk(kind: bytes, body: bytes) -> bytes:
    """A chunk of a PNG."""
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def _with_chunk(png: bytes, kind: bytes, body: bytes) -> bytes:
    return png[:33] + chunk(kind, body) + png[33:]


def mutate(data: bytes, random: Random, mutate_bytes: MutateBytes) -> bytes:
    """Changes bytes in up to three places; a PNG's checksums are mostly corrected."""
    for _ in range(random.randrange(1, 4)):
        data = mutate_bytes(data)
    return with_mended_checksums(data) if data.startswith(_PNG) and random.random() < 0.8 else data


def with_mended_checksums(png: bytes) -> bytes:
    """The file with the right checksum behind each chunk that lies within it."""
    corrected, position = bytearray(png), len(_PNG)
    while position + 12 <= len(corrected):
        end = position + 8 + int.from_bytes(corrected[position : position + 4], "big")
        if end + 4 > len(corrected):
            break
        corrected[end : end + 4] = struct.pack(">I", zlib.crc32(corrected[position + 4 : end]))
        position = end + 4
    return bytes(corrected)


TARGET = Target(
    seeds,
    check,
    mutate,
    words=(b"IHDR", b"IDAT", b"IEND", b"PLTE", b"tRNS", b"tEXt", b"zTXt", b"iTXt", b"iCCP", b"eXIf", b"acTL", b"fcTL")
    + (b"fdAT", b"gAMA", b"cICP", b"RIFF", b"WEBP", b"VP8 ", b"VP8L", b"VP8X", b"ALPH", b"ANIM", b"ANMF", b"EXIF")
    + (b"\xff\xd8\xff", b"\xff\xc0", b"\xff\xc2", b"\xff\xc4", b"\xff\xda", b"\xff\xdb", b"\xff\xdd", b"\xff\xd9"),
)
