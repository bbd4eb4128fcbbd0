"""ALIKED (Zhao et al. 2023), the network of kornia with the authors' weights n16."""

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mapless.geometry import Camera
from mapless_server.networks.local_features import load_aliked

from ..views import View
from .image import reduce_image, view_of
from .network import LearnedOptions, array_of, image_tensor


class AlikedExtractor:
    """ALIKED. Scores are in 0 to 1: maxima of up to 0.006 in blank images, of about 0.02 in weakly textured rooms.

    kornia's pixel coordinates are those used here: (0, 0) is the centre of the top-left pixel. Photographs reduced to
    half and three quarters of their size have the same keypoints to 0.1 px, so there is no shift to correct.

    Args:
        weights: safetensors file, the names of the authors' checkpoint.
        device: "cpu" or a CUDA device.
        options: the defaults if None.

    Raises:
        CheckpointError: the weights do not fit.
    """

    def __init__(self, weights: Path, device: str = "cpu", options: LearnedOptions | None = None) -> None:
        self.options = options or LearnedOptions()
        self._network, sha256 = load_aliked(weights, self.options.max_keypoints)
        self._device = torch.device(device)
        self._network.to(self._device).eval()
        self.name = self.options.label("aliked-n16", sha256)

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], camera: Camera) -> View:
        """See FeatureExtractor.extract; the strongest keypoint first."""
        reduced, reduced_camera = reduce_image(image, camera, self.options.max_side_px)
        feature_map, score_map = self._network.extract_dense_map(image_tensor(reduced, self._device))
        found, scores, dispersities = (parts[0] for parts in self._network.dkd(score_map))
        good = scores > self.options.min_score
        found, scores, dispersities = found[good], scores[good], dispersities[good]
        order = torch.argsort(scores, descending=True, stable=True)
        found, dispersities = found[order], dispersities[order]
        if not len(found):
            dimension = feature_map.shape[1]
            return view_of(reduced_camera, np.empty((0, 2)), np.empty((0, dimension), np.float32), array_of(scores))
        descriptors = self._network.desc_head(feature_map, [found])[0][0]
        last_pixel = np.array([reduced.shape[1] - 1, reduced.shape[0] - 1])
        pixels = (array_of(found).astype(np.float64) + 1) / 2 * last_pixel
        return view_of(reduced_camera, pixels, array_of(descriptors), self._peak_sizes_px(dispersities))

    def _peak_sizes_px(self, dispersities: torch.Tensor) -> NDArray[np.float32]:
        """Diameter of the score map's peak: four times the root mean square distance of the score from its centre.

        The position of a wide peak is less certain: on surveyed photographs the matches of the widest sixth lie 1.6
        times as far from their epipolar lines as those of the narrowest, as sizes times `structure.FIRST_GUESS.slope`
        predict. A dispersity is that mean square, in squared radii of the window in which kornia searches the peak.
        """
        return 4 * self._network.nms_radius * np.sqrt(array_of(dispersities))
