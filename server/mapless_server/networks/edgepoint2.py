"""EdgePoint2 (Yao et al. 2025): a small convolutional network of keypoints and descriptors, made for edge devices.

Written from a description of it; the modules' names are those of the official checkpoints' entries. `EdgePoint2` is the
network as described, but for the last layer of the descriptors, which is applied to samples of a map rather than to all
of it; `fuse` makes it compute the same in less time.
"""

from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F  # noqa: N812  its usual name
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

from .checkpoint import load_strictly
from .edgepoint2_heads import sampled
from .edgepoint2_sizes import GROUP, MULTIPLE_PX, VARIANTS, Describe, Widths


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
        return F.relu(self.layer(x).add_(self.skip(x)), inplace=True)


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
            nn.Conv2d(score, 4, 3, padding=1),
        )

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor]:
        """Logits (1, 1, H, W) and the map (1, C, H', W') for `describe` of a grey image (1, 1, H, W).

        H' and W' are quarters of H and W rounded up to multiples of 32.
        """
        half = self.block1(pad(normalize(image)))
        quarter = F.avg_pool2d(half, 2)
        eighth = self.block2(F.avg_pool2d(quarter, 2))
        last = self.block3(F.avg_pool2d(eighth, 4))
        score = self.conv1(half)
        score += _enlarge(self.conv2(eighth), 4)
        score += _enlarge(self.conv3(last), 16)
        logits = _squares_of_channels(self.score_head(score))
        return logits[..., : image.shape[2], : image.shape[3]], self.desc_head[1](self._joined(quarter, eighth, last))

    def describe(self, samples: Tensor) -> Tensor:
        """Descriptors (N, D), not normalized, of samples (N, C) of the map.

        This layer commutes with sampling, and there are fewer keypoints than pixels of the map.
        """
        layer = self.desc_head[2]
        assert isinstance(layer, nn.Conv2d)
        return F.linear(samples, layer.weight.flatten(1), layer.bias)

    def _joined(self, quarter: Tensor, eighth: Tensor, last: Tensor) -> Tensor:
        """The descriptors' first layer, applied to each map before it is enlarged, which commutes."""
        layer = self.desc_head[0]
        assert isinstance(layer, nn.Conv2d)
        first, second, third = layer.weight.split([x.shape[1] for x in (quarter, eighth, last)], dim=1)
        joined = F.conv2d(quarter, first, layer.bias, dilation=layer.dilation)
        joined += _enlarge(F.conv2d(eighth, second, dilation=layer.dilation), 2)
        joined += _enlarge(F.conv2d(last, third, dilation=layer.dilation), 8)
        return joined


class TorchEdgePoint2:
    """EdgePoint2 "s64", "m64", "l64" or "e64" with the weights of a file; CheckpointError if they do not fit.

    Attributes:
        sha256: SHA-256 of the file, hexadecimal.
    """

    def __init__(self, variant: str, weights: Path, device: str = "cpu") -> None:
        network = EdgePoint2(VARIANTS[variant])
        self.sha256 = load_strictly(network, weights, optional={})
        self._device = torch.device(device)
        self._network = fuse(network.eval()).to(self._device)

    def release_memory(self) -> None:
        """Nothing: torch keeps none on a CPU, and what it keeps of a GPU is for all networks."""

    def maps(self, grey: NDArray[np.uint8]) -> tuple[NDArray[np.float32], Describe]:
        """Logits (H, W) of a grey image (H, W), and what returns descriptors at keypoints; see `Describe`."""
        with torch.inference_mode():
            # Transferred as bytes, a quarter of the size of floats.
            image = torch.from_numpy(np.ascontiguousarray(grey)).to(self._device)[None, None].float() / 255
            logits, features = self._network(image)
            feature_map: NDArray[np.float32] = features[0].cpu().contiguous().numpy()

        def describe(keypoints: NDArray[np.float64]) -> NDArray[np.float32]:
            with torch.inference_mode():
                samples = torch.from_numpy(sampled(feature_map, keypoints)).to(self._device)
                return np.asarray(self._network.describe(samples).cpu().numpy())

        return logits[0, 0].cpu().numpy(), describe


def fuse(network: EdgePoint2) -> EdgePoint2:
    """Moves each batch normalization into the convolution before it, and puts channels last in memory; in place.

    L64 at 640x480 on one core of a CPU: 38 ms unfused, 24 ms fused.
    """
    for block in network.modules():
        if isinstance(block, nn.Conv2d) and block.kernel_size == (1, 1):
            # Dilation does not change a 1x1 convolution. Without it, PyTorch does not compute it by oneDNN on one
            # thread, but by a matrix product that takes twice the time.
            block.dilation = (2, 2)
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
    centred = image - image.mean()  # a fifth of the time of instance_norm
    return centred / (centred.square().mean() + 1e-5).sqrt()


def pad(image: Tensor) -> Tensor:
    """Pads an image to sides that are multiples of 32, right and below, by zeros, the mean of a normalized image."""
    height, width = image.shape[2:]
    return F.pad(image, (0, -width % MULTIPLE_PX, 0, -height % MULTIPLE_PX))


def _squares_of_channels(x: Tensor) -> Tensor:
    """(1, 4, H, W) to (1, 1, 2 H, 2 W); with channels last a quarter of the time of pixel_shuffle."""
    _, _, height, width = x.shape
    squares = x.permute(0, 2, 3, 1).reshape(height, width, 2, 2)
    return squares.permute(0, 2, 1, 3).reshape(1, 1, 2 * height, 2 * width)


def _enlarge(x: Tensor, factor: int) -> Tensor:
    return F.interpolate(x, scale_factor=factor, mode="bilinear", align_corners=False)


def _relu() -> nn.ReLU:
    return nn.ReLU(inplace=True)
