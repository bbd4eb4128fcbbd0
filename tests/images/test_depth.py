"""Depth images of callers: what is a value, and what is refused, by the field that is wrong."""

import re
from dataclasses import replace

import numpy as np
import pytest
from support.depths import png

from mapless import Camera, DepthImage
from mapless_server.errors import InvalidArgument
from mapless_server.images import ImageLimits, decode_depth

PHOTO = (640, 480)
STEPS = np.full((240, 320), 1500, np.uint16)
DEPTH = DepthImage(png(STEPS), 0.001)
METRES = np.full((240, 320), 1.5, np.float32)


def decoded(depth: DepthImage) -> np.ndarray:
    return decode_depth(depth, PHOTO, ImageLimits(), "reference.depth")


def fault(depth: DepthImage) -> tuple[str, str]:
    with pytest.raises(InvalidArgument) as raised:
        decoded(depth)
    return raised.value.reason, str(raised.value.field).removeprefix("reference.depth")


def test_steps_are_of_the_unit_but_0_and_65535_are_none() -> None:
    steps = STEPS.copy()
    steps[0, 0], steps[0, 1], steps[0, 2] = 0, 65535, 65534
    found = decoded(replace(DEPTH, data=png(steps)))
    np.testing.assert_array_equal(np.isnan(found[0, :3]), [True, True, False])
    np.testing.assert_allclose(found[1], 1.5)


def test_float32_values_may_be_nan_infinite_or_0_for_none() -> None:
    metres = METRES.copy()
    metres[0, :3] = np.nan, np.inf, 0
    found = decoded(DepthImage.of_metres(metres))
    np.testing.assert_array_equal(np.isfinite(found[0, :4]), [False, False, False, True])


@pytest.mark.parametrize(("unit_m", "value"), [(1e-6, 1e-45), (1e-6, 1e-35), (100.0, 3e38)])
def test_a_value_whose_length_is_no_finite_number_is_none(unit_m: float, value: float) -> None:
    metres = METRES.copy()
    metres[0, 0] = value
    found = decoded(replace(DepthImage.of_metres(metres), unit_m=unit_m))
    assert np.isnan(found[0, 0])
    assert np.isnan(found).sum() == 1
    metres[:] = value
    assert fault(replace(DepthImage.of_metres(metres), unit_m=unit_m)) == ("DEPTH_EMPTY", "")


def test_depths_of_less_confidence_are_not_used() -> None:
    confidence = np.full(STEPS.shape, 2, np.uint8)
    confidence[0], confidence[1] = 0, 1
    found = decoded(replace(DEPTH, confidence=png(confidence), min_confidence=2))
    assert np.isnan(found[:2]).all()
    assert np.isfinite(found[2:]).all()


BAD = {
    "all zero": (replace(DEPTH, data=png(np.zeros_like(STEPS))), "DEPTH_EMPTY", ""),
    "of few pixels": (replace(DEPTH, data=png(STEPS[:3, :4])), "IMAGE_TOO_SMALL", ".png"),
    "all 65535": (replace(DEPTH, data=png(np.full_like(STEPS, 65535))), "DEPTH_EMPTY", ""),
    "all NaN": (DepthImage.of_metres(np.full_like(METRES, np.nan)), "DEPTH_EMPTY", ""),
    "negative": (DepthImage.of_metres(-METRES), "DEPTH_NEGATIVE", ".float32"),
    "8 bits": (replace(DEPTH, data=png(np.zeros((240, 320), np.uint8))), "DEPTH_UNSUPPORTED", ".png"),
    "colours": (replace(DEPTH, data=png(np.zeros((240, 320, 3), np.uint16))), "DEPTH_UNSUPPORTED", ".png"),
    "no PNG": (replace(DEPTH, data=b"\xff\xd8\xff"), "DEPTH_NOT_PNG", ".png"),
    "empty": (replace(DEPTH, data=b""), "DEPTH_NOT_PNG", ".png"),
    "cut": (replace(DEPTH, data=DEPTH.data[:-30]), "IMAGE_UNDECODABLE", ".png"),
    "a bomb": (replace(DEPTH, data=png(np.zeros((9000, 9000), np.uint16))), "DEPTH_TOO_LARGE", ".png"),
    "a long side": (replace(DEPTH, data=png(np.ones((32, 16385), np.uint16))), "DEPTH_TOO_LARGE", ".png"),
    "many pixels": (replace(DEPTH, data=png(np.ones((1600, 2560), np.uint16))), "DEPTH_TOO_LARGE", ".png"),
    "many values": (DepthImage.of_metres(np.ones((1600, 2560), np.float32)), "DEPTH_TOO_LARGE", ".float32"),
    "another aspect": (replace(DEPTH, data=png(np.ones((240, 240), np.uint16))), "DEPTH_SIZE", ".intrinsics"),
    "another camera": (replace(DEPTH, camera=Camera.centred(640, 480, 500.0)), "DEPTH_SIZE", ".intrinsics"),
    "confidence of another size": (
        replace(DEPTH, confidence=png(np.ones((120, 160), np.uint8))),
        "DEPTH_SIZE",
        ".confidence",
    ),
    "no confidence at all": (replace(DEPTH, confidence=png(np.zeros((240, 320), np.uint8))), "DEPTH_EMPTY", ""),
    "confidence of 16 bits": (replace(DEPTH, confidence=DEPTH.data), "DEPTH_UNSUPPORTED", ".confidence"),
}


@pytest.mark.parametrize(("depth", "reason", "field"), BAD.values(), ids=BAD)
def test_a_bad_depth_is_refused_by_its_field(depth: DepthImage, reason: str, field: str) -> None:
    assert fault(depth) == (reason, field)


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"", "16 bits, is empty"),
        (b"\xff\xd8\xff\xe0", "is a JPEG"),
        (b"II*\0\x08", "is a TIFF"),
        (b"<html>\n<body>not found", "is text, which begins with '<html>"),
        (METRES.tobytes(), "begins with the bytes 00 00 c0 3f: float32 values need their width and height"),
        (png(STEPS)[:20], "the depth ends within its header"),
        (png(STEPS[:31]), "the depth is 320x31 pixels, its sides must be at least 32"),
        (png(np.ones((1600, 2560), np.uint16)), "the depth is 2560x1600 pixels; at most 4000000 in all"),
    ],
    ids=lambda it: it if isinstance(it, str) else "",
)
def test_a_message_says_what_the_depth_is_instead(data: bytes, said: str) -> None:
    with pytest.raises(InvalidArgument, match=re.escape(said)):
        decoded(replace(DEPTH, data=data))
