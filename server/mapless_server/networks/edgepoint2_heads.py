"""The last layers of EdgePoint2, outside of a runtime of networks: by compiled code, and where a map is sampled.

The networks are `edgepoint2` and `edgepoint2_onnx`; neither is needed here.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from mapless_server.kernels import edgepoint2

from .edgepoint2_sizes import DESCRIPTOR_STEP_PX, Widths

Float = NDArray[np.float32]

BATCH_EPSILON = 1e-5
"""Added to variances by batch normalization, as torch does."""

TRUNK = ("half", "quarter", "eighth", "last", "eighth_scores", "last_scores")
"""The maps that compiled heads take, by name: at 1/2, 1/4, 1/8 and 1/32 of the photograph's size; scores of two."""


class CompiledHeads:
    """The heads with the weights of a file, by `kernels.edgepoint2`, where that is available."""

    def __init__(self, widths: Widths, weights: Mapping[str, Float]) -> None:
        self._first = edgepoint2.layer(weights["conv1.weight"], weights["conv1.bias"])
        self._layers = [
            edgepoint2.layer(weights[f"score_head.{i}.weight"], weights[f"score_head.{i}.bias"]) for i in (0, 2, 4)
        ]
        of_quarter, self._of_eighth, self._of_last = parts(weights["desc_head.0.weight"], widths)
        self._of_quarter = edgepoint2.layer(of_quarter, weights["desc_head.0.bias"])
        self._grouped = edgepoint2.grouped(*fused(weights, "desc_head.1", 0))

    def logits(self, trunk: Sequence[Float]) -> Float:
        """Logits (H, W) of the padded photograph, from maps (C, H', W') in the order of `TRUNK`."""
        half, _, _, _, eighth_scores, last_scores = trunk
        return edgepoint2.scores(half, eighth_scores, last_scores, self._first, self._layers)

    def samples(self, trunk: Sequence[Float], keypoints: NDArray[np.float64]) -> Float:
        """Samples (N, C) of the descriptors' map at keypoints (N, 2), as `sampled`."""
        _, quarter, eighth, last, _, _ = trunk
        others = _by_pixel(eighth, self._of_eighth), _by_pixel(last, self._of_last)
        return edgepoint2.samples(quarter, *others, self._of_quarter, self._grouped, keypoints)


def _by_pixel(values: Float, weight: Float) -> Float:
    """A 1x1 convolution with weights (J, C, 1, 1) of a map (C, H, W), with channels last: (H, W, J)."""
    channels, height, width = values.shape
    product = values.reshape(channels, -1).T @ weight[:, :, 0, 0].T
    return np.asarray(product.reshape(height, width, -1))


def parts(weight: Float, widths: Widths) -> list[Float]:
    """Weights of a 1x1 convolution of joined maps, as those of one of each, whose results are added.

    It commutes with enlarging the maps.
    """
    return np.split(weight, np.cumsum([widths.half, widths.eighth]), axis=1)


def fused(weights: Mapping[str, Float], name: str, layer: int) -> tuple[Float, Float]:
    """Weight and bias of a convolution with the batch normalization after it."""
    of, weight = f"{name}.layer.{layer + 1}", weights[f"{name}.layer.{layer}.weight"]
    mean, variance = weights[f"{of}.running_mean"], weights[f"{of}.running_var"]
    factor = weights[f"{of}.weight"] / np.sqrt(variance + np.float32(BATCH_EPSILON))
    return weight * factor[:, None, None, None], weights[f"{of}.bias"] - mean * factor


def sampled(feature_map: Float, keypoints: NDArray[np.float64]) -> Float:
    """Samples a map (D, H, W) at keypoints, (N, D), between its pixels, which lie side by side from the image's corner.

    Beyond the outermost pixels' centres it falls to zero.
    """
    places = (keypoints + 0.5) / DESCRIPTOR_STEP_PX - 0.5
    first = np.floor(places).astype(np.intp)
    right, low = (places - first).astype(np.float32).T
    _, height, width = feature_map.shape
    flat, found = feature_map.reshape(len(feature_map), -1), np.zeros((len(feature_map), len(places)), np.float32)
    for down, across in (0, 0), (0, 1), (1, 0), (1, 1):
        column, row = first[:, 0] + across, first[:, 1] + down
        weight = (right if across else 1 - right) * (low if down else 1 - low)
        weight *= (column >= 0) & (column < width) & (row >= 0) & (row < height)
        pixel = row.clip(0, height - 1) * width + column.clip(0, width - 1)
        found += np.take(flat, pixel, axis=1) * weight
    return found.T
