"""SuperPoint (DeTone et al. 2018), the network of transformers; what the paper uses. Its weights: research only."""

from copy import copy
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from transformers import SuperPointConfig

from mapless.geometry import Camera
from mapless_server.networks.local_features import load_superpoint

from ..masks import are_usable, usable_pixels
from ..views import Ignored, View, reduce_image, view_of
from .network import array_of, image_tensor
from .options import LearnedOptions

WINDOW_PX = 9
"""Side of the window in which a keypoint is the strongest pixel: transformers' default and LightGlue's training."""


class SuperPointExtractor:
    """SuperPoint. A score is the probability of a pixel among its cell's 64; the authors' threshold is 0.005.

    `weights` is a safetensors file with transformers' names; CheckpointError if they do not fit. `config` is that of
    the authors' weights by default.
    """

    def __init__(
        self,
        weights: Path,
        device: str = "cpu",
        options: LearnedOptions | None = None,
        config: SuperPointConfig | None = None,
    ) -> None:
        self.options = options or LearnedOptions(min_score=0.005)
        config = config or SuperPointConfig()
        config.keypoint_threshold, config.max_keypoints = self.options.min_score, self.options.max_keypoints
        config.nms_radius = WINDOW_PX // 2
        self._network, sha256 = load_superpoint(weights, config)
        self._device = torch.device(device)
        self._network.to(self._device).eval()
        # With a mask the strongest keypoints are chosen after it, so a network that keeps all is needed: 5 MB.
        unlimited = copy(config)
        unlimited.max_keypoints = -1
        self._unlimited, _ = load_superpoint(weights, unlimited)
        self._unlimited.to(self._device).eval()
        self.name = self.options.label("superpoint", sha256)

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        """See FeatureExtractor.extract; the strongest keypoint first."""
        grey = np.asarray(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), np.uint8)
        reduced, reduced_camera = reduce_image(grey, camera, self.options.max_side_px)
        network = self._network if ignored is None else self._unlimited
        found = network(image_tensor(reduced, self._device))
        # Relative to the image's size, of whole pixels counted from the centre of the top-left one.
        size = np.array([reduced.shape[1], reduced.shape[0]])
        pixels = np.rint(array_of(found.keypoints[0]).astype(np.float64) * size)
        order = np.argsort(-array_of(found.scores[0]), kind="stable")
        if ignored is not None:
            usable = usable_pixels(ignored, reduced.shape[1], reduced.shape[0])
            order = order[are_usable(usable, pixels[order])][: self.options.max_keypoints]
        sizes_px = np.full(len(order), WINDOW_PX / 2, np.float32)
        return view_of(reduced_camera, pixels[order], array_of(found.descriptors[0])[order], sizes_px)
