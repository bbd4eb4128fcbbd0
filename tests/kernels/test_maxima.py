"""Strict maxima of a score map by compiled code: those of the plain version, ties included."""

import cv2
import numpy as np
import pytest
from support.scenes import random_for

from mapless_server.kernels import edgepoint2 as kernel
from mapless_server.method.features.extractors.edgepoint2 import _strict_maxima

pytestmark = pytest.mark.skipif(not kernel.is_available(), reason="not compiled, or no AVX2")


@pytest.mark.parametrize("shape", [(120, 160), (9, 9), (7, 30), (40, 8)])
def test_maxima_are_those_of_the_plain_version(shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    noise = random_for("maxima", shape).normal(0, 3, shape).astype(np.float32)
    logits = np.round(cv2.GaussianBlur(noise, (3, 3), 0), 1).astype(np.float32)  # so that some are equal
    ours = kernel.maxima(logits, -0.5, 4)
    monkeypatch.setattr(kernel, "is_available", lambda: False)
    for found, expected in zip(ours, _strict_maxima(logits, -0.5), strict=True):
        np.testing.assert_array_equal(found, expected)


def test_a_map_of_another_size_or_no_border_is_an_error() -> None:
    with pytest.raises(ValueError, match="do not fit"):
        kernel.maxima(np.zeros((20, 20), np.float32), 0.0, 1)
