"""EdgePoint2 (Yao et al. 2025) with the authors' weights."""

import math
from importlib.util import find_spec
from pathlib import Path
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.kernels import edgepoint2
from mapless_server.networks.edgepoint2_sizes import Describe

from ..masks import usable_pixels
from ..views import Ignored, View, reduce_image, view_of
from .options import WINDOW_PX, LearnedOptions

Float = NDArray[np.float32]
Pixels = tuple[NDArray[np.intp], NDArray[np.intp]]
"""Rows and columns (N,) of whole pixels."""

SIZE_OF_WIDTH = 12.0
"""Size of a keypoint over the width of its peak along the flatter axis, the square root of the inverse curvature of the
logit: as that of an equally precise SIFT keypoint, so that sizes times the slope of `KeypointNoise` are its noise."""

BORDER_PX = 4
"""Keypoints are at least so far from the image's border, where the network sees its padding."""


class EdgePoint2Network(Protocol):
    """The network: `OnnxEdgePoint2`, or with torch `TorchEdgePoint2`."""

    sha256: str
    """Identity of the weights."""

    def maps(self, grey: NDArray[np.uint8]) -> tuple[Float, Describe]:
        """Logits (H, W) of a grey image (H, W), and what returns descriptors at keypoints."""
        ...

    def release_memory(self) -> None:
        """Gives back the memory that is kept for the next image."""
        ...


class EdgePoint2Extractor:
    """EdgePoint2 "s64", "m64", "l64" or "e64". Scores are in 0 to 1; the authors' threshold is 0.0067, a logit of -5.

    The authors' keypoints are whole pixels; here a parabola through the logits finds them between pixels. `weights` is
    a safetensors file with the names of the authors' checkpoint; CheckpointError if they do not fit.
    """

    def __init__(self, variant: str, weights: Path, device: str = "cpu", options: LearnedOptions | None = None) -> None:
        self.options = options or LearnedOptions(min_score=0.0067)
        self._network = _network(variant, weights, device)
        self.name = self.options.label(f"edgepoint2-{variant}", self._network.sha256)

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        """See FeatureExtractor.extract; the strongest keypoint first."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        reduced, reduced_camera = reduce_image(grey, camera, self.options.max_side_px)
        logits, describe = self._network.maps(reduced)
        row, column = _strict_maxima(logits, _logit(self.options.min_score))
        if ignored is not None:
            usable = usable_pixels(ignored, reduced.shape[1], reduced.shape[0])[row, column]
            row, column = row[usable], column[usable]
        order = np.argsort(-logits[row, column], kind="stable")[: self.options.max_keypoints]
        offsets, curvatures = _peaks(logits, (row[order], column[order]))
        keypoints = (np.stack([column[order], row[order]], axis=1) + offsets).astype(np.float64)
        described = describe(keypoints)
        return view_of(
            reduced_camera,
            keypoints,
            described / np.maximum(np.linalg.norm(described, axis=1, keepdims=True), np.float32(1e-12)),
            SIZE_OF_WIDTH / np.sqrt(-curvatures.max(axis=1)),
        )

    def release_memory(self) -> None:
        """See KeepsMemory."""
        self._network.release_memory()


def _network(variant: str, weights: Path, device: str) -> EdgePoint2Network:
    """By ONNX Runtime on a CPU where it is installed, which loads sooner; else by torch.

    Where neither is, ImportError names ONNX Runtime on a CPU: it is the smaller.
    """
    if device == "cpu" and (all(map(find_spec, ("onnxruntime", "onnx"))) or not find_spec("torch")):
        from mapless_server.networks.edgepoint2_onnx import OnnxEdgePoint2

        return OnnxEdgePoint2(variant, weights)
    from mapless_server.networks.edgepoint2 import TorchEdgePoint2

    return TorchEdgePoint2(variant, weights, device)


def _logit(score: float) -> float:
    return math.log(score / (1 - score)) if score > 0 else -math.inf


def _strict_maxima(logits: Float, threshold: float) -> Pixels:
    """Pixels above the threshold and all others of their window, which lies in the image but for its border."""
    if edgepoint2.is_available():
        return edgepoint2.maxima(logits, threshold, BORDER_PX)
    margin = WINDOW_PX // 2
    others = np.ones((WINDOW_PX, WINDOW_PX), np.uint8)
    others[margin, margin] = 0
    inside = logits[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
    if not inside.size:
        return np.zeros(0, np.intp), np.zeros(0, np.intp)
    around = cv2.dilate(logits, others)[BORDER_PX:-BORDER_PX, BORDER_PX:-BORDER_PX]
    row, column = np.nonzero(inside > np.maximum(around, np.float32(threshold)))
    return row + BORDER_PX, column + BORDER_PX


def _peaks(logits: Float, at: Pixels) -> tuple[Float, Float]:
    """Offsets (N, 2) from strict maxima to the peaks of parabolas through their neighbours, at most half a pixel.

    Also the second derivatives (N, 2) of the parabolas, which are negative; both x and y.
    """
    row, column = at
    here = logits[row, column]
    before = np.stack([logits[row, column - 1], logits[row - 1, column]], axis=1)
    after = np.stack([logits[row, column + 1], logits[row + 1, column]], axis=1)
    curvatures = before + after - 2 * here[:, None]
    return np.asarray((before - after) / 2 / curvatures), np.asarray(curvatures)
