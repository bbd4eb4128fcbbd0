"""The interface of all networks: images to tokens of each view alone, then tokens to poses and maps."""

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from .blocks import Linear
from .encoder import PATCH_PX, PatchEmbedding

IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
"""Standard deviation of ImageNet's pixels, red, green, blue; the encoders were trained with them."""


@dataclass(frozen=True, eq=False)
class NetworkOutput:
    """A network's output for B scenes with N views each, up to a similarity for each scene.

    Attributes:
        local_points: (B, M, H, W, 3) float32, the point at each pixel of the first M views, in the view's camera frame.
        confidence_logits: (B, M, H, W) float32; their sigmoid is 0 to 1.
        camera_poses: (B, N, 4, 4) float32, local_from_camera; cameras look along +z, x right, y down.
    """

    local_points: Tensor
    confidence_logits: Tensor
    camera_poses: Tensor


class ImageNetwork(nn.Module):
    """A network of images in [0, 1], whose transformer blocks can compute in low precision."""

    image_mean: Tensor
    image_std: Tensor

    def __init__(self, are_constants_stored: bool = False) -> None:
        super().__init__()
        # Checkpoints may lack the two constants, so they have values even in a network on the meta device.
        for name, values in (("image_mean", IMAGE_MEAN), ("image_std", IMAGE_STD)):
            constant = torch.tensor(values, device="cpu").view(1, 3, 1, 1)
            self.register_buffer(name, constant, persistent=are_constants_stored)

    def normalized(self, images: Tensor) -> Tensor:
        """Images (..., 3, H, W) in the encoders' units."""
        return (images - self.image_mean) / self.image_std

    def set_compute_type(self, dtype: torch.dtype) -> None:
        """Casts the parts that compute in low precision: linear layers of all transformer blocks, patch embeddings.

        The rest, normalizations, LayerScale, learned tokens, encoders of conditions and the heads themselves, stays
        float32; so does SALAD, a hundredth of the time, whose logarithms and sums are sensitive to rounding.
        """
        for module in self.modules():
            if isinstance(module, (Linear, PatchEmbedding)):
                module.to(dtype)


class Network(ImageNetwork, ABC):
    """A network in two steps, so that the result of the first can be cached for each view.

    `encode` depends on one view alone, `reconstruct` on all views of a scene.

    Attributes:
        conditioned: whether it takes intrinsics and poses.
        metre_sigma: relative standard deviation of the output's unit, if that is approximately the metre; None if it is
            arbitrary.
    """

    conditioned: bool
    metre_sigma: float | None = None

    @property
    @abstractmethod
    def width(self) -> int:
        """The number C of channels of a token."""

    @staticmethod
    @abstractmethod
    def token_count(grid: tuple[int, int]) -> int:
        """The number T of tokens of a view with a grid (rows, columns) of patches."""

    @abstractmethod
    def layout(self, grid: tuple[int, int]) -> Any:
        """The layout of tokens for a grid (rows, columns) of patches, an argument of the methods below."""

    @abstractmethod
    def encode(self, images: Tensor, layout: Any, intrinsics: Tensor | None = None) -> Tensor:
        """Computes the tokens (V, T, C) of each view alone.

        Args:
            images: (V, 3, H, W) in [0, 1], sides multiples of 14.
            layout: layout of their grid.
            intrinsics: (V, 3, 3) in pixels, (0.5, 0.5) the centre of the top-left one; only for a conditioned network.
        """

    def conditions(self, poses: Tensor, posed: Tensor, metric: Tensor) -> tuple[Tensor, ...] | None:
        """Converts poses of a conditioned network's views to `reconstruct`'s form; None if they are of no use.

        Args:
            poses: (B, N, 4, 4) world_from_camera, float32.
            posed: (B, N) bool on the CPU.
            metric: (B, N) bool on the CPU, whether a view's pose is in metres.
        """
        raise ValueError(f"{type(self).__name__} takes no poses")

    @abstractmethod
    def reconstruct(
        self,
        tokens: Tensor,
        layout: Any,
        mapped: int,
        poses: Tensor | None = None,
        posed: Tensor | None = None,
        metric: Tensor | None = None,
    ) -> NetworkOutput:
        """Computes poses of all views of each scene, and maps of the first ``mapped`` of them.

        Args:
            tokens: (B, N, T, C) from `encode`.
            layout: layout of one view.
            mapped: M; points and confidence of all views would be a tenth of the work, so only those used are computed.
            poses: from `conditions`, like the next two; None if nothing is known, or the network is not conditioned.
            posed: mask of the views that have a pose.
            metric: whether a pose is in metres; only MapAnything takes it.
        """


def patch_grid(images: Tensor) -> tuple[int, int]:
    """Rows and columns of patches of images (..., H, W); ValueError if a side is not a multiple of 14."""
    height, width = images.shape[-2:]
    if height % PATCH_PX or width % PATCH_PX or not height * width:
        raise ValueError(f"images must have sides that are multiples of {PATCH_PX}, not {width}x{height}")
    return height // PATCH_PX, width // PATCH_PX
