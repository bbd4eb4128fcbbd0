"""The sizes of EdgePoint2's maps, for the implementations by torch (`edgepoint2`) and ONNX (`edgepoint2_onnx`)."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Describe = Callable[[NDArray[np.float64]], NDArray[np.float32]]
"""Returns descriptors (N, D), not normalized, at keypoints (N, 2) of a photograph, x and y in pixels."""

MULTIPLE_PX = 32
"""Sides of the images that the layers take; `EdgePoint2` pads others."""

DESCRIPTOR_STEP_PX = 4
"""Side of the pixels of the map that descriptors are computed from."""

GROUP = 16
"""Channels of a group of the descriptors' 3x3 convolution."""


@dataclass(frozen=True)
class Widths:
    """Channels of the maps.

    Attributes:
        first: channels after the first convolution, at half resolution.
        half, eighth, last: channels of the maps at 1/2, 1/8 and 1/32 of the resolution.
        score: channels in which the scores of the three maps are added.
        descriptor: numbers of a descriptor.
    """

    first: int
    half: int
    eighth: int
    last: int
    score: int
    descriptor: int = 64


VARIANTS: Mapping[str, Widths] = {
    "s64": Widths(8, 8, 24, 32, 8),
    "m64": Widths(8, 16, 32, 48, 8),
    "l64": Widths(8, 16, 48, 64, 8),
    "e64": Widths(16, 16, 48, 64, 16),
}
"""Widths of the official weights' networks, the cheapest first."""
