"""Images of 10, 12, 14 and 16 bits, and thermal ones, show the same as 8 bits would."""

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from support.images import encode, textured

from mapless.deep_pixels import eight_bits
from mapless_server.images import ImageLimits, decode_image

_SHOWN = textured(200, 150)[..., 0].astype(float)
GREY = np.asarray((_SHOWN - _SHOWN.min()) * 255 / np.ptp(_SHOWN), np.uint8)
LIMITS = ImageLimits()


def assert_shows(found: NDArray[np.uint8], grey: NDArray[np.uint8] = GREY) -> None:
    """The same but for one gain and offset, to rounding."""
    gain, offset = np.polyfit(grey.ravel(), found.ravel(), 1)
    clipped = np.clip(gain * grey + offset, 0, 255)
    assert 0.95 < gain < 1.5
    assert np.median(np.abs(clipped - found)) <= 2


@pytest.mark.parametrize("bits", [10, 12, 14, 16])
@pytest.mark.parametrize("spoilt", ["", "hot pixel", "dead pixel", "black border", "saturated border"])
def test_every_depth_shows_what_eight_bits_show(bits: int, spoilt: str) -> None:
    deep = GREY.astype(np.uint16) * 2 ** (bits - 8) + 1
    if spoilt.endswith("pixel"):
        deep[70, 90] = 65535 if spoilt == "hot pixel" else 0
    if spoilt.endswith("border"):
        deep[:, :60] = 0 if spoilt == "black border" else 65535
    found = decode_image(encode(".png", deep), LIMITS)
    assert (found[..., 0] == found[..., 2]).all()
    assert_shows(found[:, 60:, 0], GREY[:, 60:])


def test_a_thermal_range_far_from_zero_is_stretched() -> None:
    deep = (7800 + GREY.astype(np.uint16) // 2).astype(np.uint16)
    deep[3, 3], deep[:, -9:] = 60_000, 0
    assert_shows(decode_image(encode(".png", deep), LIMITS)[:, :-9, 0], GREY[:, :-9])


def test_colour_keeps_its_hues_and_alpha_does_not_count() -> None:
    colour = textured(96, 64).astype(np.uint16) * 16
    opaque = np.dstack([colour, np.full(colour.shape[:2], 9000, np.uint16)])
    found = decode_image(encode(".png", colour), LIMITS)
    assert (decode_image(encode(".png", opaque), LIMITS) == found).all()
    slopes = [np.polyfit(colour[..., i].ravel(), found[..., i].ravel(), 1)[0] for i in range(3)]
    np.testing.assert_allclose(slopes, slopes[0], rtol=0.02)


@pytest.mark.parametrize(
    ("values", "shown"),
    [
        ([0, 0, 0, 0], [0, 0, 0, 0]),
        ([7800, 7800, 7800, 7800], [0, 0, 0, 0]),
        ([65535, 65535, 65535, 65535], [0, 0, 0, 0]),
        ([0, 65535, 0, 65535], [0, 255, 0, 255]),
        ([0, 1, 0, 1], [0, 255, 0, 255]),
        ([500, 600, 500, 600], [0, 255, 0, 255]),
    ],
)
def test_images_of_one_or_two_values(values: list[int], shown: list[int]) -> None:
    deep = np.repeat(np.array(values, np.uint16), 4096).reshape(128, 128)
    assert np.unique(eight_bits(deep)).tolist() == sorted(set(shown))
    assert eight_bits(deep).reshape(4, 4096)[:, 0].tolist() == shown


def test_a_star_on_black_is_seen() -> None:
    deep = np.zeros((128, 128), np.uint16)
    deep[5, 5] = 900
    assert eight_bits(deep)[5, 5] == 255


def test_eight_bits_are_what_the_decoder_gives() -> None:
    colour = textured(96, 64)
    assert (decode_image(encode(".png", colour), LIMITS) == colour).all()
    dark = (colour // 32).astype(np.uint8)
    assert (decode_image(encode(".png", dark), LIMITS) == dark).all()


def test_a_photograph_of_fifty_megapixels_is_accepted() -> None:
    from mapless_server.images import image_size

    black = np.zeros((6144, 8160), np.uint8)
    _, file = cv2.imencode(".png", black, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    assert image_size(file.tobytes(), LIMITS) == (8160, 6144)
