"""Images are refused by their header, read as they are stored, and never half read."""

import re
import resource
import time
from contextlib import suppress

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from support.images import cmyk_jpeg, encode, png_claiming, textured, with_exif_orientation

from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, decode_image, image_size

LIMITS = ImageLimits()
RGB = textured()
LOSSLESS_WEBP = (int(cv2.IMWRITE_WEBP_QUALITY), 101)
FILES = {
    "jpeg": encode(".jpg", RGB, int(cv2.IMWRITE_JPEG_QUALITY), 100),
    "progressive jpeg": encode(".jpg", RGB, int(cv2.IMWRITE_JPEG_PROGRESSIVE), 1),
    "restarts jpeg": encode(".jpg", RGB, int(cv2.IMWRITE_JPEG_RST_INTERVAL), 1),
    "png": encode(".png", RGB),
    "lossless webp": encode(".webp", RGB, *LOSSLESS_WEBP),
    "lossy webp": encode(".webp", RGB, int(cv2.IMWRITE_WEBP_QUALITY), 90),
    "extended webp": encode(".webp", np.dstack([RGB, RGB[..., :1]]), int(cv2.IMWRITE_WEBP_QUALITY), 90),
}


def with_scans(jpeg: bytes, count: int) -> bytes:
    """The file with its one scan written again and again."""
    start = jpeg.index(b"\xff\xda")
    return jpeg[:start] + jpeg[start:-2] * count + b"\xff\xd9"


def refusal(data: bytes, limits: ImageLimits = LIMITS, field: str = "image") -> InvalidArgument:
    with pytest.raises(InvalidArgument) as caught:
        decode_image(data, limits, field)
    assert caught.value.field == field
    return caught.value


def decoded_or_none(data: bytes) -> NDArray[np.uint8] | None:
    with suppress(InvalidArgument):
        return decode_image(data, LIMITS)
    return None


@pytest.mark.parametrize("name", FILES)
def test_size_and_pixels_of_every_format(name: str) -> None:
    assert image_size(FILES[name], LIMITS) == (96, 64)
    pixels = decode_image(FILES[name], LIMITS)
    assert pixels.shape == (64, 96, 3)
    assert pixels.dtype == np.uint8
    lossy = "png" not in name and "lossless" not in name
    assert np.abs(pixels.astype(int) - RGB).mean() <= (6 if lossy else 0)


@pytest.mark.parametrize("interval", [0, 1, 4, 40])
@pytest.mark.parametrize("image", ["textured", "grey", "white"])
def test_a_jpeg_may_lack_its_end_marker_and_nothing_else(interval: int, image: str) -> None:
    """As some cameras with MJPEG write it. Cut anywhere else, even between two restarts, it is refused."""
    raster = {"textured": RGB, "grey": RGB[..., 0], "white": np.full_like(RGB, 255)}[image]
    data = encode(".jpg", raster, int(cv2.IMWRITE_JPEG_RST_INTERVAL), interval)
    pixels = decode_image(data, LIMITS)
    start = data.index(b"\xff\xda")
    cuts = {*range(len(data) - 60, len(data)), *range(start, len(data), 41)}
    restarts = [found.start() for found in re.finditer(rb"\xff[\xd0-\xd7]", data[start:])]
    for length in sorted(cuts | {start + it + moved for it in restarts[-30:] for moved in (0, 2)}):
        decoded = decoded_or_none(data[:length])
        if decoded is None:
            assert length < len(data) - 2, length
        else:
            assert np.array_equal(decoded, pixels), length


@pytest.mark.parametrize("name", FILES)
def test_truncation_at_every_length_is_refused(name: str) -> None:
    data = FILES[name]
    ends_early = len(data) - 2 if name in ("jpeg", "restarts jpeg") else len(data)
    for length in [*range(64), *range(64, len(data) - 64, 37), *range(len(data) - 64, ends_early)]:
        assert refusal(data[:length]).reason.startswith("IMAGE_")


@pytest.mark.parametrize("orientation", range(1, 9))
def test_exif_reverses_mirrored_columns_and_turns_nothing(orientation: int) -> None:
    data = with_exif_orientation(FILES["jpeg"], orientation)
    if orientation == 6:  # the file is one that does turn elsewhere
        turned = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR)
        assert turned is not None
        assert turned.shape == (96, 64, 3)
    assert image_size(data, LIMITS) == (96, 64)
    stored = decode_image(FILES["jpeg"], LIMITS)
    expected = stored[:, ::-1] if orientation in (2, 4, 5, 7) else stored
    np.testing.assert_array_equal(decode_image(data, LIMITS), expected)


def test_alpha_is_dropped_and_not_blended() -> None:
    transparent = np.dstack([RGB, np.zeros_like(RGB[..., :1])])
    np.testing.assert_array_equal(decode_image(encode(".png", transparent), LIMITS), RGB)


@pytest.mark.parametrize("extension", [".png", ".jpg"])
def test_grey_is_repeated(extension: str) -> None:
    grey = RGB[..., 0].copy()
    pixels = decode_image(encode(extension, grey), LIMITS)
    np.testing.assert_array_equal(pixels[..., 0], pixels[..., 1])
    np.testing.assert_array_equal(pixels[..., 0], pixels[..., 2])
    assert np.abs(pixels[..., 0].astype(int) - grey).mean() < 6


def test_cmyk_becomes_rgb() -> None:
    blocks = np.full((4, 5, 4), 255, np.uint8)
    blocks[0, 0] = 0, 255, 255, 255  # full cyan ink
    blocks[1, 1] = 255, 255, 255, 0  # full black
    pixels = decode_image(cmyk_jpeg(blocks), LIMITS).astype(int)
    assert pixels.shape == (32, 40, 3)
    np.testing.assert_allclose(pixels[4, 4], [0, 255, 255], atol=8)
    np.testing.assert_allclose(pixels[12, 12], [0, 0, 0], atol=8)
    np.testing.assert_allclose(pixels[28, 28], [255, 255, 255], atol=8)


def test_a_claim_of_900_megapixels_is_refused_from_the_header() -> None:
    bomb = png_claiming(30_000, 30_000)
    assert len(bomb) < 2**20
    peak_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start_s = time.perf_counter()
    error = refusal(bomb, ImageLimits(max_side_px=2**31))
    assert time.perf_counter() - start_s < 0.1
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - peak_kib < 50 * 1024
    assert error.reason == "IMAGE_TOO_LARGE"
    assert "30000x30000" in str(error)


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"", "IMAGE_EMPTY"),
        (b"GIF89a" + bytes(100), "IMAGE_UNKNOWN_FORMAT"),
        (b"hello", "IMAGE_UNKNOWN_FORMAT"),
        (b"\xff\xd8\xff", "IMAGE_TRUNCATED"),
        (b"\xff\xd8\xff\xd9", "IMAGE_UNDECODABLE"),
        (b"\xff\xd8\xff\xe0\x00\x00" * 20, "IMAGE_UNDECODABLE"),
        (b"\xff\xd8" + b"\xff" * 2**23, "IMAGE_TOO_COMPLEX"),
        (b"\xff\xd8" + b"\xff\xfe\x00\x02" * 2**21, "IMAGE_TOO_COMPLEX"),
        (b"\xff\xd8" + b"\xff\xd0" * 2**22, "IMAGE_TOO_COMPLEX"),
        (FILES["png"][:20], "IMAGE_TRUNCATED"),
        (FILES["png"][:24], "IMAGE_TRUNCATED"),
        (FILES["lossy webp"][:28], "IMAGE_TRUNCATED"),
        (FILES["png"].replace(b"IHDR", b"IHDX", 1), "IMAGE_UNDECODABLE"),
        (with_scans(FILES["jpeg"], 200), "IMAGE_TOO_COMPLEX"),
        (encode(".png", textured(31, 64)), "IMAGE_TOO_SMALL"),
        (png_claiming(16385, 32), "IMAGE_TOO_LARGE"),
        (png_claiming(0, 64), "IMAGE_TOO_SMALL"),
    ],
)
def test_reasons(data: bytes, reason: str) -> None:
    assert refusal(data, field="requests[2].reference.image").reason == reason


@pytest.mark.parametrize("brand", [b"heic", b"heix", b"mif1", b"hevc"])
def test_a_heic_file_is_named_with_what_to_send(brand: bytes) -> None:
    error = refusal(b"\x00\x00\x00\x24ftyp" + brand + bytes(100))
    assert error.reason == "IMAGE_UNKNOWN_FORMAT"
    assert "HEIC is not accepted: send a JPEG" in str(error)
    assert "not a JPEG, PNG or WebP file" in str(refusal(b"\x00\x00\x00\x20ftypisom" + bytes(100)))


def test_limits_are_inclusive() -> None:
    data = encode(".png", textured(32, 40))
    exact = ImageLimits(max_bytes=len(data), max_pixels=32 * 40, min_side_px=32, max_side_px=40)
    assert decode_image(data, exact).shape == (40, 32, 3)
    for smaller in (
        ImageLimits(max_bytes=len(data) - 1),
        ImageLimits(max_pixels=32 * 40 - 1),
        ImageLimits(max_side_px=39),
        ImageLimits(min_side_px=33),
    ):
        assert refusal(data, smaller).reason in {"IMAGE_TOO_LARGE", "IMAGE_TOO_SMALL"}


def test_a_header_that_lies_about_the_size_is_refused() -> None:
    png = bytearray(FILES["png"])
    png[19] = 95
    assert refusal(bytes(png)).reason == "IMAGE_UNDECODABLE"


@settings(max_examples=300, deadline=None)
@given(st.data())
def test_damaged_files_are_decoded_or_refused(data: st.DataObject) -> None:
    damaged = bytearray(FILES[data.draw(st.sampled_from(list(FILES)))])
    for _ in range(data.draw(st.integers(1, 4))):
        damaged[data.draw(st.integers(0, len(damaged) - 1))] = data.draw(st.integers(0, 255))
    try:
        pixels = decode_image(bytes(damaged), ImageLimits(max_pixels=1_000_000))
    except InvalidArgument:
        return
    assert pixels.shape[2] == 3
    assert pixels.dtype == np.uint8


def test_what_follows_a_jpeg_is_not_looked_at() -> None:
    """Phones append films to photographs; their bytes contain every marker."""
    film = b"\xff\xda" * 1000 + bytes(range(256)) * 100
    assert np.array_equal(decode_image(FILES["jpeg"] + film, ImageLimits()), decode_image(FILES["jpeg"], ImageLimits()))
