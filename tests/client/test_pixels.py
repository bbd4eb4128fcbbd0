"""A photograph's size, read from its header, is what decoding it gives."""

import contextlib
import struct

import cv2
import numpy as np
import pytest
from support.images import encode

from mapless.pixels import size_of_image


@pytest.mark.parametrize("size", [(33, 70), (640, 480), (1001, 37)])
@pytest.mark.parametrize(
    ("ending", "options"),
    [
        (".jpg", []),
        (".jpg", [cv2.IMWRITE_JPEG_PROGRESSIVE, 1]),
        (".png", []),
        (".webp", [cv2.IMWRITE_WEBP_QUALITY, 80]),
        (".webp", [cv2.IMWRITE_WEBP_QUALITY, 101]),
    ],
)
def test_every_format(ending: str, options: list[int], size: tuple[int, int]) -> None:
    width, height = size
    noise = np.random.default_rng(1).integers(0, 255, (height, width, 3), np.uint8)
    written, data = cv2.imencode(ending, noise, options)
    assert written
    assert size_of_image(data.tobytes()) == size


def test_an_extended_webp() -> None:
    chunk = b"VP8X" + struct.pack("<I", 10) + bytes(4) + (639).to_bytes(3, "little") + (479).to_bytes(3, "little")
    assert size_of_image(b"RIFF" + struct.pack("<I", 4 + len(chunk)) + b"WEBP" + chunk) == (640, 480)


def test_thumbnails_and_padding_are_passed_over() -> None:
    """The thumbnail that a camera puts into EXIF is a JPEG of its own, with a size of its own."""
    small, large = (encode(".jpg", np.zeros((height, 2 * height, 3), np.uint8)) for height in (40, 100))
    exif = b"\xff\xe1" + struct.pack(">H", 2 + 6 + len(small)) + b"Exif\0\0" + small
    assert size_of_image(large[:2] + exif + b"\xff\xff\xff" + large[3:]) == (200, 100)


@pytest.mark.parametrize("ending", [".jpg", ".png", ".webp"])
def test_truncated_and_other_files_are_refused_by_name(ending: str) -> None:
    data = encode(ending, np.zeros((40, 50, 3), np.uint8))
    for length in range(32 if ending != ".jpg" else 150):
        with contextlib.suppress(ValueError):
            assert size_of_image(data[:length]) == (50, 40)
    for junk in (b"", b"GIF89a", b"\xff\xd8" + bytes(100), b"\xff\xd8\xff\xe0\0\0", b"RIFF\0\0\0\0WEBPXXXX"):
        with pytest.raises(ValueError, match="photograph"):
            size_of_image(junk)
