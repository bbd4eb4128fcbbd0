"""Masks: 0 is ignored, in whatever form a PNG has it; what is no exact mask of the image is refused with its reason."""

import io
from collections.abc import Callable

import numpy as np
import pytest
from PIL import Image
from support.images import png_claiming

from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, check_mask, decode_mask

SIZE = 64, 48
GREY = np.full((48, 64), 255, np.uint8)
GREY[:24, :32] = 0
LIMITS = ImageLimits()


def png(image: Image.Image, **options: object) -> bytes:
    stream = io.BytesIO()
    image.save(stream, "PNG", **options)
    return stream.getvalue()


def palette(colours: list[int], **options: object) -> bytes:
    indexed = Image.fromarray((GREY > 0).astype(np.uint8), "P")
    indexed.putpalette(colours)
    return png(indexed, **options)


def grey() -> Image.Image:
    return Image.fromarray(GREY)


FORMS: dict[str, Callable[[], bytes]] = {
    "grey": lambda: png(grey()),
    "grey, 0 and 1": lambda: png(Image.fromarray((GREY > 0).astype(np.uint8))),
    "1 bit": lambda: png(grey().convert("1")),
    "colour": lambda: png(grey().convert("RGB")),
    "colour, one channel": lambda: png(Image.fromarray(np.dstack([GREY * 0, GREY * 0, GREY]))),
    "opaque alpha": lambda: png(grey().convert("RGBA")),
    "grey, opaque alpha": lambda: png(grey().convert("LA")),
    "palette": lambda: palette([0, 0, 0, 128, 0, 0]),
}


@pytest.mark.parametrize("form", FORMS)
def test_pixels_of_black_are_ignored(form: str) -> None:
    ignored = decode_mask(FORMS[form](), SIZE, LIMITS)
    assert ignored is not None
    np.testing.assert_array_equal(ignored, GREY == 0)


def test_a_palette_counts_by_its_colours_not_by_its_indices() -> None:
    ignored = decode_mask(palette([255, 255, 255, 0, 0, 0]), SIZE, LIMITS)
    assert ignored is not None
    np.testing.assert_array_equal(ignored, GREY != 0)


def test_a_mask_that_ignores_nothing_is_none() -> None:
    assert decode_mask(png(Image.fromarray(np.full_like(GREY, 7))), SIZE, LIMITS) is None


def jpeg() -> bytes:
    stream = io.BytesIO()
    grey().save(stream, "JPEG")
    return stream.getvalue()


REFUSED: dict[str, tuple[Callable[[], bytes], str, str]] = {
    "empty": (lambda: b"", "MASK_EMPTY", "empty"),
    "jpeg": (jpeg, "MASK_NOT_PNG", "black is not exactly 0"),
    "text": (lambda: b"P5 64 48 255", "MASK_NOT_PNG", "must be a PNG"),
    "other size": (lambda: png(grey().resize((32, 24))), "MASK_SIZE", "32x24 pixels, the image 64x48$"),
    "turned": (lambda: png(grey().rotate(90, expand=True)), "MASK_SIZE", "48x64.*EXIF"),
    "a size that decodes to gigabytes": (lambda: png_claiming(60000, 60000), "MASK_SIZE", "60000x60000"),
    "16 bits": (lambda: png(Image.fromarray(GREY.astype(np.uint16) * 100)), "MASK_UNSUPPORTED", "16 bits"),
    "animated": (
        lambda: png(grey(), save_all=True, append_images=[Image.fromarray(255 - GREY)]),
        "MASK_UNSUPPORTED",
        "animated",
    ),
    "transparent": (
        lambda: png(Image.fromarray(np.dstack([GREY] * 4), "RGBA")),
        "MASK_UNSUPPORTED",
        "transparent",
    ),
    "transparent palette": (
        lambda: palette([0, 0, 0, 9, 9, 9], transparency=0),
        "MASK_UNSUPPORTED",
        "transparent",
    ),
    "cut": (lambda: png(grey())[:-30], "IMAGE_UNDECODABLE", "cut off"),
    "cut in its header": (lambda: png(grey())[:24], "IMAGE_TRUNCATED", "within its header"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_mask_of_the_image_is_refused_with_its_reason(case: str) -> None:
    make, reason, words = REFUSED[case]
    with pytest.raises(InvalidArgument, match=words) as raised:
        decode_mask(make(), SIZE, LIMITS, "images[1].mask")
    assert (raised.value.reason, raised.value.field) == (reason, "images[1].mask")


def test_a_mask_of_too_many_bytes_is_refused_before_it_is_read() -> None:
    with pytest.raises(InvalidArgument, match="at most 100") as raised:
        check_mask(png(grey()) + bytes(200), SIZE, ImageLimits(max_bytes=100))
    assert raised.value.reason == "MASK_TOO_LARGE"
