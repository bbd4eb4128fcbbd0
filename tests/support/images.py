"""Image files of unusual kinds, made byte by byte where no available encoder makes them."""

import struct
import zlib
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray


def textured(width: int = 96, height: int = 64, channels: int = 3, seed: int = 0) -> NDArray[np.uint8]:
    """A smooth random image (H, W, channels)."""
    noise = np.random.default_rng(seed).integers(0, 256, (height, width, channels)).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(noise, (0, 0), 2.0), np.uint8).reshape(height, width, channels)


def encode(extension: str, rgb: NDArray[np.uint8] | NDArray[np.uint16], *parameters: int) -> bytes:
    """A file of an image: grey (H, W), RGB or RGBA."""
    order = {2: [0], 3: [2, 1, 0], 4: [2, 1, 0, 3]}[rgb.shape[2] if rgb.ndim == 3 else 2]
    ok, data = cv2.imencode(extension, rgb[..., order] if rgb.ndim == 3 else rgb, parameters)
    assert ok
    return bytes(data)


def with_exif_orientation(jpeg: bytes, orientation: int) -> bytes:
    """The JPEG with an EXIF segment that asks viewers to turn it."""
    entry = struct.pack("<HHIHH", 0x0112, 3, 1, orientation, 0)
    tiff = b"II*\0" + struct.pack("<I", 8) + struct.pack("<H", 1) + entry + struct.pack("<I", 0)
    segment = b"Exif\0\0" + tiff
    return jpeg[:2] + b"\xff\xe1" + struct.pack(">H", len(segment) + 2) + segment + jpeg[2:]


def png_claiming(width: int, height: int) -> bytes:
    """A valid one-bit PNG of this size, black: 900 megapixels are about 110 kB."""
    packer = zlib.compressobj(9)
    row = bytes(1 + (width + 7) // 8)
    body = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    return (
        b"\x89PNG\r\n\x1a\n"
        + _png_chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 1, 0, 0, 0, 0))
        + _png_chunk(b"IDAT", body)
        + _png_chunk(b"IEND", b"")
    )


def _png_chunk(kind: bytes, body: bytes) -> bytes:
    return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))


def cmyk_jpeg(blocks: NDArray[np.uint8]) -> bytes:
    """A baseline JPEG in Adobe's (inverted) CMYK, one flat colour for each 8x8 block.

    Args:
        blocks: (rows, columns, 4), the samples as stored: 255 is no ink.
    """
    rows, columns, _ = blocks.shape
    # One Huffman code of 4 bits for each of the 12 lengths of a DC difference, and "end of block" as the only AC code.
    dc_table = bytes([0, 0, 0, 12, *[0] * 12, *range(12)])
    ac_table = bytes([1, *[0] * 15, 0])
    components = b"".join(bytes([i, 0x11, 0]) for i in range(1, 5))
    frame = struct.pack(">BHHB", 8, 8 * rows, 8 * columns, 4) + components
    scan = bytes([4, *(x for i in range(1, 5) for x in (i, 0)), 0, 63, 0])
    segments = [
        (0xEE, b"Adobe" + struct.pack(">HHHB", 100, 0, 0, 0)),
        (0xDB, bytes([0, *[8] * 64])),  # quantization by 8: a DC step is one grey level
        (0xC0, frame),
        (0xC4, b"\x00" + dc_table),
        (0xC4, b"\x10" + ac_table),
        (0xDA, scan),
    ]
    header = b"".join(b"\xff" + bytes([marker]) + struct.pack(">H", len(body) + 2) + body for marker, body in segments)
    return b"\xff\xd8" + header + _entropy_code(blocks.reshape(-1, 4).astype(int) - 128) + b"\xff\xd9"


def _entropy_code(levels: NDArray[np.int64]) -> bytes:
    """Flat blocks of four interleaved components: the difference to the block before, then nothing more."""
    bits = ""
    previous: Sequence[int] = (0, 0, 0, 0)
    for block in levels.tolist():
        for level, before in zip(block, previous, strict=True):
            difference = level - before
            length = abs(difference).bit_length()
            bits += f"{length:04b}"
            if length:
                bits += f"{difference if difference > 0 else difference + 2**length - 1:0{length}b}"
            bits += "0"
        previous = block
    bits += "1" * (-len(bits) % 8)
    data = int(bits, 2).to_bytes(len(bits) // 8, "big")
    return data.replace(b"\xff", b"\xff\0")
