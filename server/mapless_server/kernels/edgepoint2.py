"""The heads of EdgePoint2 by compiled code: scores of all pixels, and descriptors' samples where there are keypoints.

It takes less than half of the time of a runtime of networks, which computes each layer for all pixels. What is computed
is in `networks.edgepoint2`, the plain version; results differ by rounding.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

try:
    from . import _edgepoint2
except ImportError:  # not compiled
    _IS_FAST = False
else:
    _IS_FAST = _edgepoint2.is_fast()

Float = NDArray[np.float32]

LANES = 16
"""Channels of a group, and results that are computed at a time."""


def is_available() -> bool:
    """Whether it is compiled, for this processor: without wide vectors a runtime of networks is faster."""
    return _IS_FAST


@dataclass(frozen=True, eq=False)
class Layer:
    """A convolution of K results and C sources. Attributes: weights (C, K) or (C, 9, K), bias (K,)."""

    weights: Float
    bias: Float


def layer(weight: Float, bias: Float) -> Layer:
    """Makes a layer from weights (K, C, side, side) and bias (K,)."""
    results, sources = weight.shape[:2]
    taps = np.moveaxis(weight.reshape(results, sources, -1), 0, -1)
    return Layer(np.ascontiguousarray(taps[:, 0] if taps.shape[1] == 1 else taps), np.ascontiguousarray(bias))


def grouped(weight: Float, bias: Float) -> Layer:
    """Makes a layer of groups from weights (J, 16, 3, 3) and bias (J,); its weights are (J / 16, 9, 16, 16)."""
    taps = weight.reshape(-1, LANES, LANES, 9).transpose(0, 3, 2, 1)
    return Layer(np.ascontiguousarray(taps), np.ascontiguousarray(bias))


def scores(half: Float, eighth: Float, last: Float, first: Layer, layers: Sequence[Layer]) -> Float:
    """Logits (2 H, 2 W) from the half-sized map (C, H, W) and scores (S, H / 4, W / 4), (S, H / 16, W / 16) of others.

    `first` makes S scores of the map; the three `layers` of 3x3 taps follow, the last with four results. ValueError
    where sizes do not fit: H and W are multiples of 16, S of 8.
    """
    channels, height, width = half.shape
    logits = np.empty((2 * height, 2 * width), np.float32)
    given = [half, first.weights, first.bias, eighth, last]
    for it in layers:
        given += [it.weights, it.bias]
    _edgepoint2.scores(channels, len(eighth), height, width, *map(np.ascontiguousarray, given), logits)
    return logits


def samples(
    quarter: Float, eighth: Float, last: Float, first: Layer, second: Layer, keypoints: NDArray[np.float64]
) -> Float:
    """Samples (N, J) of the map of descriptors at keypoints (N, 2), x and y in pixels of the photograph.

    The map is the sum of `first`, applied to the quarter-sized map (C, H, W), and of maps (H / 2, W / 2, J) and
    (H / 8, W / 8, J), enlarged; through the grouped layer `second` and ReLU. ValueError where sizes do not fit: H and W
    are multiples of 8, J of 16, and C is at most 16.
    """
    channels, height, width = quarter.shape
    found = np.empty((len(keypoints), eighth.shape[-1]), np.float32)
    given = quarter, first.weights, first.bias, eighth, last, second.weights, second.bias, keypoints
    _edgepoint2.samples(channels, found.shape[1], height, width, *map(np.ascontiguousarray, given), found)
    return found


def maxima(logits: Float, threshold: float, border: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Rows and columns (N,) of pixels above the threshold and all others of their 5x5 window, row by row.

    Those within `border` pixels of the map's border, at least 2, are left out. ValueError where sizes do not fit.
    """
    height, width = logits.shape
    found = np.empty((2, (height // 3 + 1) * (width // 3 + 1)), np.int32)  # no two are in a square of 3x3
    count = _edgepoint2.maxima(height, width, border, threshold, np.ascontiguousarray(logits), found)
    row, column = found[:, :count].astype(np.intp)
    return row, column
