"""XFeat (Potje et al. 2024), the network of kornia with the authors' weights."""

from pathlib import Path

import numpy as np
import torch
from kornia.feature.xfeat import InterpolateSparse2d
from numpy.typing import NDArray
from torch.nn.functional import log_softmax, normalize, pixel_shuffle

from mapless.geometry import Camera
from mapless_server.networks.local_features import load_xfeat

from ..limits import MULTIPLE_PX
from ..masks import usable_pixels
from ..views import Ignored, View, reduce_image, view_of
from .network import among_usable, array_of, image_tensor, peaks, strict_maxima
from .options import WINDOW_PX, LearnedOptions

SHIFT_PX = 0.4
"""From a maximum of the keypoint map to the image point, right and down, pixels: the positions that the weights were
trained with are rounded down."""


class XfeatExtractor:
    """XFeat's sparse features. Scores are the keypoint map's, in 0 to 1; the authors' threshold is 0.05.

    The authors' keypoints are whole pixels; here a parabola through the logarithm of the map finds them between pixels.
    `weights` is a safetensors file with the names of the authors' checkpoint; CheckpointError if they do not fit.
    """

    def __init__(self, weights: Path, device: str = "cpu", options: LearnedOptions | None = None) -> None:
        self.options = options or LearnedOptions(min_score=0.05)
        self._network, sha256 = load_xfeat(weights)
        self._device = torch.device(device)
        self._network.to(self._device).eval()
        self.name = self.options.label("xfeat", sha256)

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        """See FeatureExtractor.extract; the strongest keypoint first."""
        reduced, reduced_camera = reduce_image(image, camera, self.options.max_side_px, MULTIPLE_PX)
        feature_map, logits, reliability = self._network(image_tensor(reduced, self._device))
        height, width = reduced.shape[:2]
        log_heat = pixel_shuffle(log_softmax(logits, dim=1)[:, :-1], 8)[0, 0]
        heat = log_heat.exp()
        pixels = strict_maxima(heat, WINDOW_PX, self.options.min_score)
        if ignored is not None:
            pixels = among_usable(pixels, usable_pixels(ignored, width, height))
        weight = InterpolateSparse2d("bilinear")(reliability, pixels[None], height, width)[0, :, 0]
        scores = heat[pixels[:, 1], pixels[:, 0]] * weight
        pixels = pixels[torch.argsort(scores, descending=True, stable=True)[: self.options.max_keypoints]]
        descriptors = InterpolateSparse2d("bicubic")(normalize(feature_map, dim=1), pixels[None], height, width)[0]
        return view_of(
            reduced_camera,
            array_of(pixels + peaks(log_heat, pixels)[0]).astype(np.float64) + SHIFT_PX,
            array_of(normalize(descriptors, dim=1)),
            np.full(len(pixels), WINDOW_PX, np.float32),
        )
