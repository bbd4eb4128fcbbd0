"""EdgePoint2 (Yao et al. 2025) with the authors' weights."""

import math
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch.nn.functional import grid_sample, normalize

from mapless.geometry import Camera
from mapless_server.networks.edgepoint2 import DESCRIPTOR_STEP_PX, fuse
from mapless_server.networks.local_features import load_edgepoint2

from ..masks import usable_pixels
from ..views import Ignored, View, reduce_image, view_of
from .network import WINDOW_PX, LearnedOptions, among_usable, array_of, image_tensor, peaks, strict_maxima

SIZE_OF_WIDTH = 12.0
"""Size of a keypoint over the width of its peak along the flatter axis, the square root of the inverse curvature of the
logit: as that of an equally precise SIFT keypoint, so that sizes times the slope of `KeypointNoise` are its noise."""

BORDER_PX = 4
"""Keypoints are at least so far from the image's border, where the network sees its padding."""


class EdgePoint2Extractor:
    """EdgePoint2 "s64", "m64", "l64" or "e64". Scores are in 0 to 1; the authors' threshold is 0.0067, a logit of -5.

    The authors' keypoints are whole pixels; here a parabola through the logits finds them between pixels. `weights` is
    a safetensors file with the names of the authors' checkpoint; CheckpointError if they do not fit.
    """

    def __init__(self, variant: str, weights: Path, device: str = "cpu", options: LearnedOptions | None = None) -> None:
        self.options = options or LearnedOptions(min_score=0.0067)
        network, sha256 = load_edgepoint2(variant, weights)
        self._device = torch.device(device)
        self._network = fuse(network.eval()).to(self._device)
        self.name = self.options.label(f"edgepoint2-{variant}", sha256)

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        """See FeatureExtractor.extract; the strongest keypoint first."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        reduced, reduced_camera = reduce_image(grey, camera, self.options.max_side_px)
        all_logits, feature_map = self._network(image_tensor(reduced, self._device))
        logits = all_logits[0, 0]
        margin = BORDER_PX - WINDOW_PX // 2
        inner = logits[margin:-margin, margin:-margin]
        pixels = strict_maxima(inner, WINDOW_PX, _logit(self.options.min_score)) + margin
        if ignored is not None:
            pixels = among_usable(pixels, usable_pixels(ignored, reduced.shape[1], reduced.shape[0]))
        order = torch.argsort(logits[pixels[:, 1], pixels[:, 0]], descending=True, stable=True)
        pixels = pixels[order[: self.options.max_keypoints]]
        offsets, curvatures = peaks(logits, pixels)
        keypoints = pixels + offsets
        return view_of(
            reduced_camera,
            array_of(keypoints).astype(np.float64),
            array_of(normalize(self._network.describe(_sampled(feature_map, keypoints)), dim=1)),
            array_of(SIZE_OF_WIDTH / (-curvatures.amax(dim=1)).sqrt()),
        )


def _logit(score: float) -> float:
    return math.log(score / (1 - score)) if score > 0 else -math.inf


def _sampled(feature_map: torch.Tensor, keypoints: torch.Tensor) -> torch.Tensor:
    """Samples a map (1, D, H, W) at keypoints, (N, D); the map's pixels lie side by side from the image's corner on."""
    height, width = feature_map.shape[2:]
    size_px = DESCRIPTOR_STEP_PX * keypoints.new_tensor([width, height])
    places = (2 * keypoints + 1) / size_px - 1  # -1 and 1 are the outer edges of the outermost pixels
    sampled = grid_sample(feature_map, places[None, None], mode="bilinear", align_corners=False)
    return sampled[0, :, 0].T
