"""ALIKED (Zhao et al. 2023), the network of kornia with the authors' weights n16."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from kornia.feature.aliked.aliked import ALIKED, DKD, SDDH, DeformableConv2d, InputPadder, ResBlock
from numpy.typing import NDArray
from torch import nn
from torch.nn.functional import conv2d, embedding_bag, grid_sample, normalize

from mapless.geometry import Camera
from mapless_server.networks.local_features import load_aliked

from ..limits import MULTIPLE_PX
from ..masks import are_usable, usable_pixels
from ..views import Ignored, View, reduce_image, view_of
from .network import array_of, image_tensor
from .options import ALIKED_VARIANT, LearnedOptions

_CORNERS = torch.tensor([[0, 0], [1, 0], [0, 1], [1, 1]])
"""Pixels around a position, x and y, from the first."""

_UNLIMITED = 2**31
"""More keypoints than any image has."""

_REACH = 0.25
"""Largest offset of a sampled position, as a share of the map's longer side."""

_AT_ONCE = 256
"""Keypoints that are described at once, with 20 MB."""


class AlikedExtractor:
    """ALIKED. Scores are in 0 to 1: maxima of up to 0.006 in blank images, of about 0.02 in weakly textured rooms.

    kornia's pixel coordinates are those used here: (0, 0) is the centre of the top-left pixel. `weights` is a
    safetensors file with the names of the authors' checkpoint; CheckpointError if they do not fit.
    """

    def __init__(self, weights: Path, device: str = "cpu", options: LearnedOptions | None = None) -> None:
        self.options = options or LearnedOptions()
        self._network, sha256 = load_aliked(weights, self.options.max_keypoints)
        self._device = torch.device(device)
        self._network.to(self._device).eval()
        # Above the threshold, however many: with a mask the strongest are chosen after it.
        radius, threshold = self._network.nms_radius, max(self.options.min_score, 1e-9)
        self._all_maxima = DKD(radius, top_k=0, scores_th=threshold, n_limit=_UNLIMITED).to(self._device)
        self.name = self.options.label(ALIKED_VARIANT, sha256)

    @torch.inference_mode()
    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        """See FeatureExtractor.extract; the strongest keypoint first."""
        reduced, reduced_camera = reduce_image(image, camera, self.options.max_side_px)
        maps = find_maps(self._network, image_tensor(reduced, self._device))
        detector = self._network.dkd if ignored is None else self._all_maxima
        found, scores, dispersities = (parts[0] for parts in detector(maps.scores))
        last_pixel = np.array([reduced.shape[1] - 1, reduced.shape[0] - 1])
        good = scores > self.options.min_score
        if ignored is not None:
            usable = usable_pixels(ignored, reduced.shape[1], reduced.shape[0])
            allowed = are_usable(usable, (array_of(found).astype(np.float64) + 1) / 2 * last_pixel)
            good &= torch.from_numpy(allowed).to(good.device)
        found, scores, dispersities = found[good], scores[good], dispersities[good]
        order = torch.argsort(scores, descending=True, stable=True)[: self.options.max_keypoints]
        found, dispersities = found[order], dispersities[order]
        if not len(found):
            dimension = self._network.desc_head.sf_conv.in_channels
            return view_of(reduced_camera, np.empty((0, 2)), np.empty((0, dimension), np.float32), array_of(scores))
        descriptors = describe(self._network.desc_head, maps, found)
        pixels = (array_of(found).astype(np.float64) + 1) / 2 * last_pixel
        return view_of(reduced_camera, pixels, array_of(descriptors), self._peak_sizes_px(dispersities))

    def _peak_sizes_px(self, dispersities: torch.Tensor) -> NDArray[np.float32]:
        """Diameter of the score map's peak: four times the root mean square distance of the score from its centre.

        The position of a wide peak is less certain, as sizes times `FIRST_GUESS.slope` predict. A dispersity is that
        mean square, in squared radii of the window in which kornia searches the peak.
        """
        return 4 * self._network.nms_radius * np.sqrt(array_of(dispersities))


@dataclass(frozen=True, eq=False)
class Maps:
    """The maps that the network computes of an image.

    Attributes:
        scores: (1, 1, H, W) in 0 to 1.
        levels: four maps (1, C, h, w) of features at falling resolution, of the padded image. A pixel's features are
            those of all four, interpolated, side by side, normalized.
        padding_px: columns left of the image and rows above it that the padding has added.
    """

    scores: torch.Tensor
    levels: Sequence[torch.Tensor]
    padding_px: tuple[int, int]

    def features(self, pixels: torch.Tensor) -> torch.Tensor:
        """Features (..., 4 C) of whole pixels (..., 2), x and y."""
        at = pixels.flatten(end_dim=-2) + torch.tensor(self.padding_px, device=pixels.device)
        full = _size(self.levels[0])
        found = []
        for level in self.levels:
            size = _size(level)
            position = at * ((size - 1) / (full - 1))
            before = torch.minimum(position.floor(), (size - 2).clamp(min=0))
            corners = torch.minimum(before[:, None] + _CORNERS.to(at.device), size - 1).long()
            share = position - before
            weights = torch.where(_CORNERS.to(at.device) > 0, share[:, None], 1 - share[:, None]).prod(2)
            rows = level[0].permute(1, 2, 0).flatten(end_dim=1)
            index = corners[..., 1] * level.shape[3] + corners[..., 0]
            found.append(embedding_bag(index, rows, per_sample_weights=weights, mode="sum"))
        return normalize(torch.cat(found, dim=1), dim=1).view(*pixels.shape[:-1], -1)


def _size(x: torch.Tensor) -> torch.Tensor:
    """Width and height."""
    return torch.tensor([x.shape[3], x.shape[2]], device=x.device)


def find_maps(network: ALIKED, image: torch.Tensor) -> Maps:
    """The scores and features of an image (1, 3, H, W) in 0 to 1; those of `ALIKED.extract_dense_map` to rounding.

    That holds the features of all pixels, 580 MiB at 640x480. Here they are computed where a descriptor needs them: the
    first layer of the scores weighs the channels alone, so it may precede the interpolation.
    """
    padder = InputPadder(image.shape[-2], image.shape[-1], MULTIPLE_PX)
    x1 = network.block1(padder.pad(image).contiguous(memory_format=torch.channels_last))
    x2 = network.block2(network.pool2(x1))
    x3 = _residual(network.block3, network.pool4(x2))
    x4 = _residual(network.block4, network.pool4(x3))
    projections = (network.conv1, network.conv2, network.conv3, network.conv4)
    levels = [network.gate(project(x)) for project, x in zip(projections, (x1, x2, x3, x4), strict=True)]
    del x1
    weigh, *rest = network.score_head
    weights = weigh.get_parameter("weight").chunk(4, dim=1)
    weighed = conv2d(levels[0], weights[0])
    enlargements = (network.upsample2, network.upsample8, network.upsample32)
    for level, weight, enlarge in zip(levels[1:], weights[1:], enlargements, strict=True):
        weighed += enlarge(conv2d(level, weight))
    scores = padder.unpad(torch.sigmoid(nn.Sequential(*rest)(weighed)))
    height, width = (b - a for a, b in zip(image.shape[-2:], weighed.shape[-2:], strict=True))
    return Maps(scores, levels, (width // 2, height // 2))


def describe(head: SDDH, maps: Maps, keypoints: torch.Tensor) -> torch.Tensor:
    """Descriptors (N, D) of keypoints (N, 2), which are -1 to 1 in the image: the numbers of `SDDH` to rounding."""
    size = _size(maps.scores)
    limit = _REACH * float(size.max())
    side = torch.arange(head.kernel_size, device=size.device)
    around = torch.stack(torch.meshgrid(side, side, indexing="xy"), dim=-1)
    descriptors = []
    for some in keypoints.split(_AT_ONCE):
        centres = (some / 2 + 0.5) * (size - 1)
        first = torch.minimum((centres.long() - 1).clamp(min=0), size - 1 - head.kernel_size)
        patches = maps.features(first[:, None, None] + around).permute(0, 3, 1, 2)
        offsets = head.offset_conv(patches).clamp(-limit, limit).view(len(some), 2, -1).mT
        positions = centres[:, None] + offsets
        corners = positions.floor()[:, :, None] + _CORNERS.to(size.device)
        weights = (1 - (positions[:, :, None] - corners).abs()).prod(3)
        weights *= ((corners >= 0) & (corners < size)).all(3)
        pixels = torch.minimum(corners.clamp(min=0), size - 1).long()
        sampled = (weights[..., None, :] @ maps.features(pixels)).squeeze(2)
        states = torch.selu(sampled @ head.sf_conv.weight[:, :, 0, 0].T)
        descriptors.append(states.flatten(1) @ head.get_parameter("agg_weights").flatten(end_dim=1))
    return normalize(torch.cat(descriptors), dim=1)


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
    limit = _REACH * max(height, width)
    offsets = layer.offset_conv(x).clamp(-limit, limit).view(side, side, 2, height, width)
    across, down, kernel = (torch.arange(n, dtype=x.dtype, device=x.device) for n in (width, height, side))
    columns = offsets[:, :, 1] + across + (kernel - layer.padding)[:, None, None]
    rows = offsets[:, :, 0] + down[:, None] + (kernel - layer.padding)[:, None, None, None]
    # Borders of the image are at -1 and 1, half a pixel beyond its outer centres.
    grid = torch.stack([(2 * columns + 1) / width - 1, (2 * rows + 1) / height - 1], dim=-1)
    sampled = grid_sample(x, grid.view(1, -1, width, 2), align_corners=False)
    return (weight.flatten(1) @ sampled.reshape(-1, height * width)).view(1, -1, height, width)
