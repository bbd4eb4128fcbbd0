"""ALIKED (Zhao et al. 2023), the network of kornia with the authors' weights n16."""

from pathlib import Path

import numpy as np
import torch
from kornia.feature.aliked.aliked import ALIKED, DeformableConv2d, InputPadder, ResBlock
from numpy.typing import NDArray
from torch import nn
from torch.nn.functional import grid_sample

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
        feature_map, score_map = dense_maps(self._network, image_tensor(reduced, self._device))
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


def dense_maps(network: ALIKED, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Feature map (1, D, H, W) and score map (1, 1, H, W) of an image (1, 3, H, W), in 0 to 1.

    The numbers are those of `ALIKED.extract_dense_map` to the last digits. That holds the feature map three times: its
    parts, these side by side, and normalized. Here all is in one array, 270 MiB at 640x480 instead of 580, and
    channels lie side by side in memory, with which the convolutions take 60 % of the time.
    """
    padder = InputPadder(image.shape[-2], image.shape[-1], 32)
    x1 = network.block1(padder.pad(image).contiguous(memory_format=torch.channels_last))
    x2 = network.block2(network.pool2(x1))
    x3 = _residual(network.block3, network.pool4(x2))
    x4 = _residual(network.block4, network.pool4(x3))
    first = network.gate(network.conv1(x1))
    shape = (1, 4 * first.shape[1], *first.shape[2:])
    maps = torch.empty(shape, dtype=x1.dtype, device=x1.device, memory_format=torch.channels_last)
    del x1
    parts = maps.chunk(4, dim=1)
    parts[0].copy_(first)
    del first
    parts[1].copy_(network.upsample2(network.gate(network.conv2(x2))))
    parts[2].copy_(network.upsample8(network.gate(network.conv3(x3))))
    parts[3].copy_(network.upsample32(network.gate(network.conv4(x4))))
    scores = torch.sigmoid(network.score_head(maps))
    maps /= torch.linalg.vector_norm(maps, dim=1, keepdim=True).clamp_min(1e-12)
    return padder.unpad(maps), padder.unpad(scores)


def _residual(block: ResBlock, x: torch.Tensor) -> torch.Tensor:
    """The block of two deformable convolutions."""
    assert block.gate is not None
    assert block.downsample is not None
    between = block.gate(block.bn1(_deformed(block.conv1, x)))
    after = block.bn2(_deformed(block.conv2, between))
    result: torch.Tensor = block.gate(after.add_(block.downsample(x)))
    return result


def _deformed(layer: nn.Module, x: torch.Tensor) -> torch.Tensor:
    """The layer, with all pixels sampled by one call of `grid_sample`, which needs a tenth of the memory."""
    assert isinstance(layer, DeformableConv2d)
    height, width = x.shape[2:]
    weight = layer.regular_conv.weight
    side = weight.shape[-1]
    limit = max(height, width) / 4
    offsets = layer.offset_conv(x).clamp(-limit, limit).view(side, side, 2, height, width)
    across, down, kernel = (torch.arange(n, dtype=x.dtype, device=x.device) for n in (width, height, side))
    columns = offsets[:, :, 1] + across + (kernel - layer.padding)[:, None, None]
    rows = offsets[:, :, 0] + down[:, None] + (kernel - layer.padding)[:, None, None, None]
    # Borders of the image are at -1 and 1, half a pixel beyond its outer centres.
    grid = torch.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], dim=-1)
    sampled = grid_sample(x, grid.view(1, -1, width, 2), align_corners=False)
    return (weight.flatten(1) @ sampled.reshape(-1, height * width)).view(1, -1, height, width)
