"""The common part of Pi3 and Pi3X: from images to decoded tokens, poses and maps."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .blocks import Linear
from .decoder import SPECIALS, AlternatingDecoder, Injection, TokenLayout, make_layout
from .encoder import PATCH_PX, Encoder, PatchEmbedding
from .heads import CameraHead, HeadDecoder

IMAGE_MEAN = (0.485, 0.456, 0.406)
IMAGE_STD = (0.229, 0.224, 0.225)
"""Of ImageNet's pixels, red, green, blue; the encoder was trained with them."""


@dataclass(frozen=True)
class Sizes:
    """Sizes of a network; the defaults are those of the official ones.

    Attributes:
        width: channels of a token.
        heads: of attention.
        encoder_depth, decoder_depth: blocks of the encoder and of the main decoder.
        head_depth: blocks of each head's decoder.
        camera_width: channels in the camera head.
        conv_stages, conv_last_width: channels of the convolutional heads (Pi3X).
        metric_width, metric_heads, metric_depth: of the metric decoder (Pi3X).
    """

    width: int = 1024
    heads: int = 16
    encoder_depth: int = 24
    decoder_depth: int = 36
    head_depth: int = 5
    camera_width: int = 512
    conv_stages: tuple[int, ...] = (256, 128, 64)
    conv_last_width: int = 32
    metric_width: int = 512
    metric_heads: int = 8
    metric_depth: int = 5


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


class Network(nn.Module, ABC):
    """A network in two steps, so that the result of the first can be cached for each view.

    `encode` depends on one view alone, `reconstruct` on all views of a scene.
    """

    image_mean: Tensor
    image_std: Tensor
    conditioned: bool
    """Whether it takes intrinsics and poses."""

    def __init__(self, sizes: Sizes) -> None:
        super().__init__()
        self.sizes = sizes
        self.register_token = nn.Parameter(torch.empty(1, 1, SPECIALS, sizes.width))
        # Checkpoints may lack the two constants, so they have values even in a network on the meta device.
        self.register_buffer("image_mean", torch.tensor(IMAGE_MEAN, device="cpu").view(1, 3, 1, 1))
        self.register_buffer("image_std", torch.tensor(IMAGE_STD, device="cpu").view(1, 3, 1, 1))
        self.encoder = Encoder(sizes.width, sizes.heads, sizes.encoder_depth)
        self.decoder = AlternatingDecoder(sizes.width, sizes.heads, sizes.decoder_depth)
        self.point_decoder = self._head_decoder(sizes.width)
        self.conf_decoder = self._head_decoder(sizes.width)
        self.camera_decoder = self._head_decoder(sizes.camera_width)
        self.camera_head = CameraHead(sizes.camera_width)

    def _head_decoder(self, width_out: int) -> HeadDecoder:
        sizes = self.sizes
        return HeadDecoder(2 * sizes.width, sizes.width, width_out, sizes.heads, sizes.head_depth)

    def set_compute_type(self, dtype: torch.dtype) -> None:
        """Casts the parts that compute in low precision: linear layers of all transformer blocks, patch embeddings.

        The rest, normalizations, LayerScale, learned tokens and the heads themselves, stays float32.
        """
        for module in self.modules():
            if isinstance(module, (Linear, PatchEmbedding)):
                module.to(dtype)

    def layout(self, grid: tuple[int, int]) -> TokenLayout:
        """The layout of tokens that the methods below take, of a grid (rows, columns) of patches."""
        return make_layout(grid, self.sizes.width // self.sizes.heads, self.register_token.device)

    def encode(self, images: Tensor, layout: TokenLayout, intrinsics: Tensor | None = None) -> Tensor:
        """Tokens (V, T, C) of each view alone, after block 0 of the decoder; T = 5 + H/14 * W/14.

        Args:
            images: (V, 3, H, W) in [0, 1], sides multiples of 14.
            layout: of their grid.
            intrinsics: (V, 3, 3) in pixels, (0.5, 0.5) the centre of the top-left one; only of a conditioned network.
        """
        return self.begin(self.embed(images, intrinsics), layout)

    @abstractmethod
    def reconstruct(
        self,
        tokens: Tensor,
        layout: TokenLayout,
        mapped: int,
        poses: Tensor | None = None,
        posed: Tensor | None = None,
    ) -> NetworkOutput:
        """Poses of all views of each scene, and maps of the first ``mapped`` of them.

        Args:
            tokens: (B, N, T, C) from `encode`.
            layout: of one view.
            mapped: M; points and confidence of all views would be a tenth of the work, so only those used are computed.
            poses: (B, N, 4, 4) from `conditions.normalize_poses`; None if nothing is known, or
                the network is not conditioned.
            posed: (B, M') int64, the indices of the views of each scene whose pose is known, two at least.
        """

    @abstractmethod
    def embed(self, images: Tensor, intrinsics: Tensor | None) -> Tensor:
        """Patch tokens (V, P, C) of views; arguments as for `encode`."""

    def encode_images(self, images: Tensor) -> Tensor:
        """The encoder's patch tokens (V, P, C) of images (V, 3, H, W) in [0, 1]."""
        return self.encoder((images - self.image_mean) / self.image_std)

    def begin(self, patches: Tensor, layout: TokenLayout) -> Tensor:
        """Patch tokens (V, P, C) to tokens (V, T, C), special ones first, after block 0 of the decoder."""
        specials = self.register_token[0].expand(len(patches), -1, -1)
        return self.decoder.begin(torch.cat([specials, patches], dim=1), layout.rope)

    def decode(self, tokens: Tensor, layout: TokenLayout, inject: Injection | None = None) -> Tensor:
        """Tokens (B, N, T, C) of `encode` to decoded tokens (B, N, T, 2 C), float32."""
        return self.decoder(tokens.to(self.register_token.dtype), layout.rope, inject)

    def cameras(self, decoded: Tensor, layout: TokenLayout) -> Tensor:
        """Poses (B, N, 4, 4) of decoded tokens (B, N, T, 2 C)."""
        tokens = self.camera_decoder(decoded.flatten(0, 1), layout.rope)
        poses: Tensor = self.camera_head(tokens)
        return poses.unflatten(0, decoded.shape[:2])

    def maps(self, decoded: Tensor, layout: TokenLayout) -> tuple[Tensor, Tensor]:
        """Local points (B, M, H, W, 3), confidence logits (B, M, H, W) of decoded tokens (B, M, T, 2 C); M may be 0."""
        shape = decoded.shape[:2]
        if not shape.numel():  # not every kernel accepts an empty tensor
            empty = decoded.new_empty(*shape, *(side * PATCH_PX for side in layout.grid), 3)
            return empty, empty[..., 0]
        points, logits = self.read_maps(decoded.flatten(0, 1), layout)
        return points.unflatten(0, shape), logits.unflatten(0, shape)

    @abstractmethod
    def read_maps(self, decoded: Tensor, layout: TokenLayout) -> tuple[Tensor, Tensor]:
        """Local points (V, H, W, 3) and confidence logits (V, H, W) of decoded tokens (V, T, 2 C)."""


def patch_grid(images: Tensor) -> tuple[int, int]:
    """Rows and columns of patches of images (..., H, W); ValueError if a side is not a multiple of 14."""
    height, width = images.shape[-2:]
    if height % PATCH_PX or width % PATCH_PX or not height * width:
        raise ValueError(f"images must have sides that are multiples of {PATCH_PX}, not {width}x{height}")
    return height // PATCH_PX, width // PATCH_PX
