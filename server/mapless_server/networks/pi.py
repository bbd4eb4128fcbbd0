"""The common part of Pi3 and Pi3X: from images to decoded tokens, poses and maps."""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .checkpoint import FileNames
from .decoder import SPECIALS, AlternatingDecoder, Injection, TokenLayout, make_layout
from .encoder import PATCH_PX, Encoder
from .heads import CameraHead, HeadDecoder
from .network import IMAGE_MEAN, IMAGE_STD, Network

UNUSED = (
    *("omega", "flow_decoder.", "flow_head.", "global_points_decoder.", "global_point_head."),
    *("depth_encoder.", "depth_emb"),
)
"""Prefixes of names in the checkpoints that are not used here: for training, and for given depths."""


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


class PiNetwork(Network):
    """What Pi3 and Pi3X have in common."""

    file_names = FileNames(unused_prefixes=UNUSED)
    image_mean: Tensor
    image_std: Tensor

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

    @property
    def width(self) -> int:
        """See Network.width."""
        return self.sizes.width

    @staticmethod
    def token_count(grid: tuple[int, int]) -> int:
        """See Network.token_count."""
        return SPECIALS + grid[0] * grid[1]

    def layout(self, grid: tuple[int, int]) -> TokenLayout:
        """See Network.layout."""
        return make_layout(grid, self.sizes.width // self.sizes.heads, self.register_token.device)

    def encode(self, images: Tensor, layout: TokenLayout, intrinsics: Tensor | None = None) -> Tensor:
        """See Network.encode; after block 0 of the decoder."""
        return self.begin(self.embed(images, intrinsics), layout)

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
