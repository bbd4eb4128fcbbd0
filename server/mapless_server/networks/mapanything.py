"""MapAnything (Keetha et al. 2025), version 1.1: metric points, confidence and poses from images and hints.

Any subset of the views may have rays and poses. The first view is the reference: poses are given and predicted
relative to it, and it must be posed if any is. The network takes given values as hints only, so the output has to be
aligned with the given poses. The official network's part for given depths is left out, since no photograph has any.

    image > DINOv2 ViT-g > + rays              (of each view alone: `encode`, whose result can be cached)
                         > + poses, normalize  > blocks over the scene and within views in turn
                                               > points, poses, scale of the scene (`decode`)

Written from a description of the official network; modules are named as the entries of its checkpoint.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor, nn

from .blocks import BLOCK_EPS, Block, LayerNorm
from .checkpoint import FileNames
from .encoder import PATCH_PX, PlainEncoder
from .heads import DenseFeatures, DenseRegression, ResidualMlp
from .network import Network, NetworkOutput
from .view_conditions import (
    MIN_LENGTH,
    MapEncoder,
    RelativePoses,
    VectorEncoder,
    pinhole_rays,
    quaternions_from_rotations,
    relative_poses,
    rotations_from_quaternions,
)

CHANNELS = 6
"""Channels of the dense head: ray, logarithm of the depth, confidence, mask."""
DENSE_VIEWS = 5
"""Views whose pixels are computed at a time: each takes 0.35 GB at 518x392."""
HIDDEN_LOGIT = -1e4
"""The confidence's logit where the network masks a pixel: its sigmoid is 0."""

UNUSED = ("depth_encoder.", "depth_scale_encoder.")
"""Prefixes of names in the checkpoint that are not used here: for given depths."""

V1_WIDTH = 768
"""Channels of a token in version 1 of the network."""

ALIASES = (
    (r"dpt_feature_head\.", r"dense_head.0."),
    (r"dpt_regressor_head\.", r"dense_head.1."),
    *((rf"(.*)\.scratch\.layer{i + 1}_rn\.", rf"\1.input_process.{i}.1.") for i in range(4)),
    (r"(.*)\.scratch\.layer_rn\.(\d)\.", r"\1.input_process.\2.1."),
)
"""Patterns of the beginnings of further names that the official network has for the same tensors."""


def canonical_name(name: str) -> str:
    """Converts any official name of a tensor to its name here, which is that in the published file."""
    for pattern, replacement in ALIASES:
        name = re.sub(rf"^{pattern}", replacement, name)
    return name


def _describe_misfit(shapes: Mapping[str, tuple[int, ...]]) -> str:
    if shapes.get("scale_token") != (V1_WIDTH,):
        return ""
    return "it is version 1 of MapAnything (facebook/map-anything-apache-v1), another network than version 1.1"


@dataclass(frozen=True)
class MapAnythingSizes:
    """Sizes of the network; the defaults are those of the official one.

    Attributes:
        width: channels of a token.
        encoder_heads, encoder_depth: heads and blocks of the encoder.
        heads, depth: heads and (an even number of) blocks of the transformer over all views.
        taps: two blocks of it whose output the dense head gets, besides its input and its last output.
        map_widths, vector_widths: channels in the encoders of rays, and of poses and scales.
        dense_map_widths, dense_width, dense_hidden: channels of the dense head.
        pose_width, scale_width: channels of the other heads.
    """

    width: int = 1536
    encoder_heads: int = 24
    encoder_depth: int = 24
    heads: int = 24
    depth: int = 16
    taps: tuple[int, int] = (7, 11)
    map_widths: tuple[int, ...] = (588, 768, 1024)
    vector_widths: tuple[int, ...] = (128, 256, 512)
    dense_map_widths: tuple[int, int, int, int] = (96, 192, 384, 768)
    dense_width: int = 256
    dense_hidden: int = 128
    pose_width: int = 784
    scale_width: int = 196


@dataclass(frozen=True, eq=False)
class Decoded:
    """The network's output for B scenes with N views each, in the frame of view 0 of each scene, before the scale.

    Attributes:
        rays: (B, M, H, W, 3) unit directions in the camera's frame, of the first M views.
        depths: (B, M, H, W) distances along the rays.
        confidence_logits: (B, M, H, W); the official confidence is 1 + their exponential.
        mask_logits: (B, M, H, W); above 0 where the pixel shows a surface.
        translations: (B, N, 3) camera centres.
        quaternions: (B, N, 4) rotations, x, y, z, w, unit length, world_from_camera.
        scale: (B, 1) metres per unit.
    """

    rays: Tensor
    depths: Tensor
    confidence_logits: Tensor
    mask_logits: Tensor
    translations: Tensor
    quaternions: Tensor
    scale: Tensor


class MapAnything(Network):
    """The network of `facebook/map-anything-apache`."""

    conditioned = True
    metre_sigma = 0.2
    """A third party found a mean error of the scale of 16 % on ETH3D, for a normal distribution 0.8 of this."""
    file_names = FileNames(canonical_name, UNUSED, _describe_misfit)

    def __init__(self, sizes: MapAnythingSizes | None = None) -> None:
        sizes = sizes or MapAnythingSizes()
        super().__init__()
        self.sizes = sizes
        width = sizes.width
        self.scale_token = nn.Parameter(torch.empty(width))
        encoder = PlainEncoder(width, sizes.encoder_heads, sizes.encoder_depth, gated=True)
        self.encoder = nn.ModuleDict({"model": encoder})
        self.ray_dirs_encoder = MapEncoder(3, sizes.map_widths, width)
        self.cam_rot_encoder = VectorEncoder(4, sizes.vector_widths, width)
        self.cam_trans_encoder = VectorEncoder(3, sizes.vector_widths, width)
        self.cam_trans_scale_encoder = VectorEncoder(1, sizes.vector_widths, width)
        self.fusion_norm_layer = LayerNorm(width, eps=BLOCK_EPS)
        self.info_sharing = ViewTransformer(width, sizes.heads, sizes.depth, sizes.taps)
        features = DenseFeatures(width, sizes.dense_map_widths, sizes.dense_width)
        self.dense_head = nn.ModuleList([features, DenseRegression(sizes.dense_width, sizes.dense_hidden, CHANNELS)])
        self.pose_head = PoseHead(width, sizes.pose_width)
        self.scale_head = ScaleHead(width, sizes.scale_width)

    @property
    def width(self) -> int:
        """See Network.width."""
        return self.sizes.width

    @staticmethod
    def token_count(grid: tuple[int, int]) -> int:
        """See Network.token_count."""
        return grid[0] * grid[1] + 1

    def layout(self, grid: tuple[int, int]) -> tuple[int, int]:
        """See Network.layout: a view's patches come by rows, then its class token."""
        return grid

    def encode(self, images: Tensor, layout: tuple[int, int], intrinsics: Tensor | None = None) -> Tensor:
        """See Network.encode; without intrinsics, the views' rays are unknown."""
        if intrinsics is None:
            return self.encode_views(images)
        # Elsewhere (0.5, 0.5) is the centre of the top-left pixel, here it is (0, 0).
        shift = intrinsics.new_zeros(3, 3)
        shift[:2, 2] = 0.5
        rays = pinhole_rays(intrinsics - shift, layout[0] * PATCH_PX, layout[1] * PATCH_PX)
        return self.encode_views(images, rays)

    def encode_views(self, images: Tensor, rays: Tensor | None = None) -> Tensor:
        """Tokens (V, P + 1, C) float32 of each view alone, the class token last.

        Images are (V, 3, H, W) in [0, 1], rays (V, H, W, 3) unit directions in the camera's frame, of any kind of lens.
        """
        encoded = self.encoder["model"](self.normalized(images))
        of_class, patches = encoded.split([1, encoded.shape[1] - 1], dim=1)
        if rays is not None:
            patches = patches + self.ray_dirs_encoder(rays.permute(0, 3, 1, 2))
        return torch.cat([patches, of_class], dim=1)

    def conditions(self, poses: Tensor, posed: Tensor, metric: Tensor) -> tuple[Tensor, Tensor, Tensor] | None:
        """See Network.conditions; returns the arguments unchanged, since scenes may differ in which views are posed.

        ValueError if the first view of a scene has no pose, but another one has.
        """
        if (posed.any(1) & ~posed[:, 0]).any():
            raise ValueError("the first view must have a pose if any has: poses are relative to it")
        return (poses, posed, metric) if posed.any() else None

    def reconstruct(
        self,
        tokens: Tensor,
        layout: tuple[int, int],
        mapped: int,
        poses: Tensor | None = None,
        posed: Tensor | None = None,
        metric: Tensor | None = None,
    ) -> NetworkOutput:
        """See Network.reconstruct; the output is metric, within the network's accuracy."""
        return as_output(self.decode(tokens, layout, mapped, _relative(poses, posed), posed, metric))

    def decode(
        self,
        tokens: Tensor,
        layout: tuple[int, int],
        mapped: int,
        relative: RelativePoses | None = None,
        posed: Tensor | None = None,
        metric: Tensor | None = None,
    ) -> Decoded:
        """Computes the network's output from tokens (B, N, T, C) of `encode_views`.

        Args:
            tokens: tokens of all views; the first is the reference.
            layout: layout of one view.
            mapped: M; see Network.reconstruct.
            relative: relative poses; None if none is known.
            posed: (B, N) bool, which views have a pose.
            metric: (B, N) bool, whether a view's pose is in metres; None if all are.
        """
        tokens = tokens.to(self.scale_token.dtype)
        patches, of_class = tokens.split([tokens.shape[2] - 1, 1], dim=2)
        if relative is not None and posed is not None:
            patches = patches + self._features_of_poses(relative, posed, metric)[:, :, None]
        fused = self.fusion_norm_layer(patches)
        joined = torch.cat([fused, of_class], dim=2)
        taps, last, scale = self.info_sharing(joined, self.scale_token)
        dense = self._dense([fused, *(tap[:, :, :-1] for tap in taps), last[:, :, :-1]], mapped, layout)
        rays, log_depth, confidence, mask = dense.split([3, 1, 1, 1], dim=2)
        translations, quaternions = self.pose_head(last[:, :, :-1])
        return Decoded(
            (rays / rays.norm(dim=2, keepdim=True).clamp_min(MIN_LENGTH)).permute(0, 1, 3, 4, 2),
            log_depth[:, :, 0].exp(),
            confidence[:, :, 0],
            mask[:, :, 0],
            translations,
            quaternions,
            self.scale_head(scale).exp().clamp_min(MIN_LENGTH),
        )

    def _features_of_poses(self, relative: RelativePoses, posed: Tensor, metric: Tensor | None) -> Tensor:
        """Features (B, N, C) of the poses; 0 where no pose is given."""
        of_pose = self.cam_rot_encoder(relative.quaternions) + self.cam_trans_encoder(relative.translations)
        of_scale = self.cam_trans_scale_encoder((relative.scale + MIN_LENGTH).log()[:, None])[:, None]
        has_scale = posed if metric is None else posed & metric
        return _where(posed, of_pose) + _where(has_scale, of_scale.expand_as(of_pose))

    def _dense(self, depths: list[Tensor], mapped: int, grid: tuple[int, int]) -> Tensor:
        """Channels (B, M, CHANNELS, H, W) of the first M views, from patch tokens (B, N, P, C) of four depths."""
        scenes = len(depths[0])
        if not scenes * mapped:  # not every kernel accepts an empty tensor
            return depths[0].new_empty(scenes, mapped, CHANNELS, grid[0] * PATCH_PX, grid[1] * PATCH_PX)
        features, regression = self.dense_head
        views = torch.stack([it[:, :mapped].flatten(0, 1) for it in depths], dim=1)
        dense = torch.cat([regression(features(part.unbind(1), grid), grid) for part in views.split(DENSE_VIEWS)])
        return dense.unflatten(0, (scenes, mapped))


class ViewTransformer(nn.Module):
    """Blocks over all tokens of the scene (even index) and within each view (odd), without positions.

    The first view is marked by a constant vector. A scale token of the scene takes part in the former blocks.
    """

    view_pos_table: Tensor

    def __init__(self, width: int, heads: int, depth: int, taps: tuple[int, int]) -> None:
        super().__init__()
        self.taps = taps
        self.register_buffer("view_pos_table", torch.empty(1, width))
        self.self_attention_blocks = nn.ModuleList(Block(width, heads, gated=True) for _ in range(depth))
        self.norm = LayerNorm(width, eps=BLOCK_EPS)

    def forward(self, tokens: Tensor, scale_token: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Transforms the tokens (B, N, T, C) of all views of B scenes, and the learned scale token (C,).

        Returns the normalized output (B, N, T, C) of the two blocks at the taps and of the last block, and that of the
        scale token (B, C).
        """
        scenes, _, count, width = tokens.shape
        x = torch.cat([tokens[:, :1] + self.view_pos_table, tokens[:, 1:]], dim=1)
        scale = scale_token.expand(scenes, 1, width)
        tapped = []
        for index, block in enumerate(self.self_attention_blocks):
            if index % 2 == 1:
                x = block(x.flatten(0, 1)).unflatten(0, (scenes, -1))
            else:
                joined = block(torch.cat([x.flatten(1, 2), scale], dim=1))
                x, scale = joined[:, :-1].unflatten(1, (-1, count)), joined[:, -1:]
            if index in self.taps:
                tapped.append(self.norm(x))
        return tapped, self.norm(x), self.norm(scale)[:, 0]


class PoseHead(nn.Module):
    """Computes a pose from the mean of a view's patch tokens, in float32."""

    def __init__(self, width_in: int, width: int) -> None:
        super().__init__()
        self.proj = nn.Conv2d(width_in, width, 1)
        self.res_conv = nn.ModuleList(ResidualMlp(width, partial(nn.Conv2d, kernel_size=1)) for _ in range(2))
        self.more_mlps = nn.Sequential(nn.Linear(width, width), nn.ReLU(), nn.Linear(width, width), nn.ReLU())
        self.fc_t = nn.Linear(width, 3)
        self.fc_rot = nn.Linear(width, 4)

    def forward(self, patches: Tensor) -> tuple[Tensor, Tensor]:
        """Patch tokens (B, N, P, C) to translations (B, N, 3) and unit quaternions (B, N, 4), x, y, z, w."""
        x = self.proj(patches.flatten(0, 1).transpose(1, 2)[..., None])
        for block in self.res_conv:
            x = block(x)
        features = self.more_mlps(x.mean((2, 3))).unflatten(0, patches.shape[:2])
        quaternions = self.fc_rot(features)
        return self.fc_t(features), quaternions / quaternions.norm(dim=-1, keepdim=True).clamp_min(MIN_LENGTH)


class ScaleHead(nn.Module):
    """Computes the logarithm of metres per unit from the scale token."""

    def __init__(self, width_in: int, width: int) -> None:
        super().__init__()
        self.proj = nn.Linear(width_in, width)
        self.mlp = nn.Sequential(*(nn.Sequential(nn.Linear(width, width), nn.ReLU()) for _ in range(2)))
        self.output_proj = nn.Linear(width, 1)

    def forward(self, token: Tensor) -> Tensor:
        """(B, C) to (B, 1)."""
        out: Tensor = self.output_proj(self.mlp(self.proj(token)))
        return out


def as_output(decoded: Decoded) -> NetworkOutput:
    """Converts the output to metres and to every network's form; masked pixels have no confidence.

    The official confidence c >= 1 becomes 1 - 1/c, which is the sigmoid of its logit.
    """
    scale = decoded.scale
    points = decoded.rays * (scale[:, :, None, None] * decoded.depths)[..., None]
    logits = torch.where(decoded.mask_logits <= 0, HIDDEN_LOGIT, decoded.confidence_logits)
    translations = scale[..., None] * decoded.translations
    upper = torch.cat([rotations_from_quaternions(decoded.quaternions), translations[..., None]], dim=-1)
    last = torch.zeros_like(upper[..., :1, :])
    last[..., 3] = 1
    return NetworkOutput(points, logits, torch.cat([upper, last], dim=-2))


def _relative(poses: Tensor | None, posed: Tensor | None) -> RelativePoses | None:
    """Makes relative poses from poses (B, N, 4, 4); None without poses."""
    if poses is None or posed is None:
        return None
    return relative_poses(quaternions_from_rotations(poses[..., :3, :3]), poses[..., :3, 3], posed)


def _where(mask: Tensor, features: Tensor) -> Tensor:
    """Features (..., C) of views where the mask is true, and 0 elsewhere."""
    return torch.where(mask.view(*mask.shape, *[1] * (features.dim() - mask.dim())), features, 0.0)
