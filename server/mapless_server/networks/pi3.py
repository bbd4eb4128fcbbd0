"""pi^3 (Wang et al. 2025), points, confidence and poses from images alone, and its successor Pi3X.

Pi3X takes intrinsics and poses as conditions, and its output is roughly metric. Given poses fix neither the frame nor
the scale of the output: align it with them afterwards, as with Pi3. The official network's part for given depths, a
fifth of its weights, is left out, since no query has depths.
"""

import math
from abc import abstractmethod
from dataclasses import dataclass

import torch
from torch import Tensor, nn

from .checkpoint import FileNames
from .conditions import PoseInjection, normalize_poses, prope, rays_from_intrinsics
from .decoder import SPECIALS, AlternatingDecoder, Injection, TokenLayout, make_layout
from .encoder import PATCH_PX, Encoder, PatchEmbedding
from .heads import CameraHead, ConvHead, HeadDecoder, LinearHead, MetricDecoder
from .network import Network, NetworkOutput

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
        heads: heads of attention.
        encoder_depth, decoder_depth: blocks of the encoder and of the main decoder.
        head_depth: blocks of each head's decoder.
        camera_width: channels in the camera head.
        conv_stages, conv_last_width: channels of the convolutional heads (Pi3X).
        metric_width, metric_heads, metric_depth: channels, heads and blocks of the metric decoder (Pi3X).
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
    """The common part of Pi3 and Pi3X, whose heads of points and confidence differ."""

    point_head: nn.Module
    conf_head: nn.Module
    max_log_depth = math.inf
    """Largest logarithm of a depth."""
    file_names = FileNames(unused_prefixes=UNUSED)

    def __init__(self, sizes: Sizes) -> None:
        super().__init__(are_constants_stored=True)
        self.sizes = sizes
        self.register_token = nn.Parameter(torch.empty(1, 1, SPECIALS, sizes.width))
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
        """See Network.encode; the tokens are those after block 0 of the decoder."""
        return self.begin(self.embed(images, intrinsics), layout)

    @abstractmethod
    def embed(self, images: Tensor, intrinsics: Tensor | None) -> Tensor:
        """Patch tokens (V, P, C) of views; arguments as for `encode`."""

    def encode_images(self, images: Tensor) -> Tensor:
        """The encoder's patch tokens (V, P, C) of images (V, 3, H, W) in [0, 1]."""
        return self.encoder(self.normalized(images))

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

    def read_maps(self, decoded: Tensor, layout: TokenLayout) -> tuple[Tensor, Tensor]:
        """Points (V, H, W, 3), without metric scale, and confidence logits (V, H, W) of decoded tokens (V, T, 2 C)."""
        x, y, log_z = self.point_head(self.point_decoder(decoded, layout.rope), layout.grid).unbind(-1)
        z = torch.exp(log_z.clamp_max(self.max_log_depth))
        confidence = self.conf_head(self.conf_decoder(decoded, layout.rope), layout.grid)
        return torch.stack([x * z, y * z, z], dim=-1), confidence[..., 0]


class Pi3(PiNetwork):
    """The paper's network."""

    conditioned = False

    def __init__(self, sizes: Sizes | None = None) -> None:
        sizes = sizes or Sizes()
        super().__init__(sizes)
        self.point_head = LinearHead(sizes.width, 3)
        self.conf_head = LinearHead(sizes.width, 1)

    def embed(self, images: Tensor, intrinsics: Tensor | None = None) -> Tensor:
        """See PiNetwork.embed; ``intrinsics`` must be None."""
        if intrinsics is not None:
            raise ValueError("Pi3 takes no intrinsics")
        return self.encode_images(images)

    def reconstruct(
        self,
        tokens: Tensor,
        layout: TokenLayout,
        mapped: int,
        poses: Tensor | None = None,
        posed: Tensor | None = None,
        metric: Tensor | None = None,
    ) -> NetworkOutput:
        """See Network.reconstruct; ``poses`` and ``posed`` must be None."""
        if poses is not None or posed is not None:
            raise ValueError("Pi3 takes no poses")
        decoded = self.decode(tokens, layout)
        points, logits = self.maps(decoded[:, :mapped], layout)
        return NetworkOutput(points, logits, self.cameras(decoded, layout))


INJECTION_PERIOD = 8
"""Poses are injected after block 1 and every eighth from there."""


class Pi3X(PiNetwork):
    """The network of Pi3X, without its part for depths."""

    conditioned = True
    max_log_depth = 15.0
    metre_sigma = 0.31
    """A third party found a mean error of the scale of 25 % on ETH3D, for a normal distribution 0.8 of this."""

    def __init__(self, sizes: Sizes | None = None) -> None:
        sizes = sizes or Sizes()
        super().__init__(sizes)
        injections = len(range(1, sizes.decoder_depth, INJECTION_PERIOD))
        self.ray_embed = PatchEmbedding(2, sizes.width)
        self.pose_inject_blk = nn.ModuleList(PoseInjection(sizes.width, sizes.heads) for _ in range(injections))
        self.point_head = ConvHead(sizes.width, sizes.conv_stages, sizes.conv_last_width, (2, 1))
        self.conf_head = ConvHead(sizes.width, sizes.conv_stages, sizes.conv_last_width, (1,))
        self.metric_token = nn.Parameter(torch.empty(1, 1, 2 * sizes.width))
        self.metric_decoder = MetricDecoder(2 * sizes.width, sizes.metric_width, sizes.metric_heads, sizes.metric_depth)
        self.metric_head = nn.Linear(sizes.metric_width, 1)

    def embed(self, images: Tensor, intrinsics: Tensor | None = None) -> Tensor:
        """See PiNetwork.embed."""
        patches = self.encode_images(images)
        if intrinsics is None:
            return patches
        return patches + self.ray_embed(rays_from_intrinsics(intrinsics, *images.shape[-2:]))

    def conditions(self, poses: Tensor, posed: Tensor, metric: Tensor) -> tuple[Tensor, ...] | None:
        """See Network.conditions: normalized poses, and the indices (B, M') of the views that have one, two at least.

        The unit does not matter. Views without a pose need plausible values, for these enter the scale. ValueError for
        scenes with different numbers of posed views.
        """
        counts = posed.sum(1)
        if (counts != counts[0]).any():
            raise ValueError(f"scenes with different numbers of posed views in one batch: {counts.tolist()}")
        if counts[0] < 2:
            return None
        return normalize_poses(poses), posed.nonzero()[:, 1].view(len(posed), -1)

    def reconstruct(
        self,
        tokens: Tensor,
        layout: TokenLayout,
        mapped: int,
        poses: Tensor | None = None,
        posed: Tensor | None = None,
        metric: Tensor | None = None,
    ) -> NetworkOutput:
        """See Network.reconstruct; the output is roughly metric."""
        inject = None if poses is None or posed is None else self._injection(poses, posed, layout.grid)
        decoded = self.decode(tokens, layout, inject)
        points, logits = self.maps(decoded[:, :mapped], layout)
        cameras = self.cameras(decoded, layout)
        metric = self._metric(decoded, layout)
        cameras = torch.cat([cameras[..., :3], cameras[..., 3:] * _scaling_column(metric)], dim=-1)
        return NetworkOutput(points * metric[:, None, None, None, None], logits, cameras)

    def _injection(self, poses: Tensor, posed: Tensor, grid: tuple[int, int]) -> Injection:
        """Makes the injection that updates the posed views' patches by these views' cameras."""
        known = torch.take_along_dim(poses, posed[:, :, None, None], dim=1)
        positions = prope(known, grid, self.sizes.width // self.sizes.heads)

        def inject(index: int, x: Tensor) -> Tensor:
            if index % INJECTION_PERIOD != 1:
                return x
            specials, patches = x.split([SPECIALS, x.shape[2] - SPECIALS], dim=2)
            chosen = posed[:, :, None, None].expand(-1, -1, *patches.shape[2:])
            block = self.pose_inject_blk[index // INJECTION_PERIOD]
            update = block(patches.gather(1, chosen).flatten(1, 2), positions).unflatten(1, (posed.shape[1], -1))
            patches = patches.scatter_add(1, chosen, update.to(patches.dtype))
            return torch.cat([specials, patches], dim=2)

        return inject

    def _metric(self, decoded: Tensor, layout: TokenLayout) -> Tensor:
        """Scale (B,) of each scene, approximately metres per unit."""
        scale: Tensor = self.metric_head(self.metric_decoder(self.metric_token, decoded.flatten(1, 2), layout.rope))
        return scale.exp()[:, 0]


def _scaling_column(scale: Tensor) -> Tensor:
    """Factors (B, 1, 4, 1) for the last column of poses, which scale their translations by (B,)."""
    column = scale[:, None].repeat(1, 4)
    column[:, 3] = 1
    return column[:, None, :, None]
