"""Pi3X, the successor of pi^3: may be told rays, depths and poses, and knows roughly how long a metre is.

Told poses fix neither the frame nor the scale of what it answers: align it with them afterwards, as with Pi3.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from .conditions import PoseInjection, mean_depth, normalize_poses, prope, rays_from_intrinsics
from .decoder import SPECIALS, Injection, Layout
from .encoder import Encoder, PatchEmbedding
from .heads import ConvHead, MetricDecoder
from .network import Network, NetworkOutput, Sizes, patch_grid

INJECTION_PERIOD = 8
"""Poses are injected after block 1 and every eighth from there."""
MAX_LOG_DEPTH = 15.0


@dataclass(frozen=True, eq=False)
class Conditions:
    """What is known of B scenes with N views; None where nothing is.

    Attributes:
        rays: (B, N, 2, H, W) x and y at depth 1 of each pixel, and which views' are used.
        has_ray: (B, N) bool.
        depths: (B, N, H, W), 0 where unknown.
        has_depth: (B, N) bool.
        poses: (B, N, 4, 4) world_from_camera; those of views without a pose must be plausible, since they count for
            the scale (see `normalize_poses`).
        has_pose: (B, N) bool; scenes with a single one count as having none.
    """

    rays: Tensor | None = None
    has_ray: Tensor | None = None
    depths: Tensor | None = None
    has_depth: Tensor | None = None
    poses: Tensor | None = None
    has_pose: Tensor | None = None

    def scene(self, index: int) -> Conditions:
        """Those of one scene, B = 1."""
        chosen = {name: value[index : index + 1] for name, value in vars(self).items() if value is not None}
        return replace(self, **chosen)


class Pi3X(Network):
    """See the module."""

    conditioned = True

    def __init__(self, sizes: Sizes | None = None) -> None:
        sizes = sizes or Sizes()
        super().__init__(sizes)
        injections = len(range(1, sizes.decoder_depth, INJECTION_PERIOD))
        self.depth_encoder = Encoder(sizes.width, sizes.heads, sizes.encoder_depth, channels=2)
        self.depth_emb = nn.Parameter(torch.empty(1, 1, sizes.width))
        self.ray_embed = PatchEmbedding(2, sizes.width)
        self.pose_inject_blk = nn.ModuleList(PoseInjection(sizes.width, sizes.heads) for _ in range(injections))
        self.point_head = ConvHead(sizes.width, sizes.conv_stages, sizes.conv_last_width, (2, 1))
        self.conf_head = ConvHead(sizes.width, sizes.conv_stages, sizes.conv_last_width, (1,))
        self.metric_token = nn.Parameter(torch.empty(1, 1, 2 * sizes.width))
        self.metric_decoder = MetricDecoder(2 * sizes.width, sizes.metric_width, sizes.metric_heads, sizes.metric_depth)
        self.metric_head = nn.Linear(sizes.metric_width, 1)

    def forget_depths(self) -> None:
        """Gives back what is there for depths, a fifth of the weights, where none will ever be told."""
        del self.depth_encoder, self.depth_emb

    def embed(self, images: Tensor, intrinsics: Tensor | None = None) -> Tensor:
        """See Network.embed."""
        patches = self.encode_images(images)
        if intrinsics is None:
            return patches
        return patches + self.ray_embed(rays_from_intrinsics(intrinsics, *images.shape[-2:]))

    def reconstruct(
        self,
        tokens: Tensor,
        layout: Layout,
        mapped: int,
        poses: Tensor | None = None,
        posed: Tensor | None = None,
    ) -> NetworkOutput:
        """See Network.reconstruct; what it gives is roughly metric."""
        inject = None if poses is None or posed is None else self._injection(poses, posed, layout.grid)
        decoded = self.decode(tokens, layout, inject)
        points, logits = self.maps(decoded[:, :mapped], layout)
        cameras = self.cameras(decoded, layout)
        metric = self._metric(decoded, layout)
        cameras = torch.cat([cameras[..., :3], cameras[..., 3:] * _scaling_column(metric)], dim=-1)
        return NetworkOutput(points * metric[:, None, None, None, None], logits, cameras)

    def forward(self, images: Tensor, conditions: Conditions | None = None) -> NetworkOutput:
        """Everything of images (B, N, 3, H, W) in [0, 1]. Scenes that know different things are done one by one."""
        conditions = conditions or Conditions()
        outputs = [self._forward_scene(images[i : i + 1], conditions.scene(i)) for i in range(len(images))]
        return NetworkOutput(*(torch.cat([vars(o)[name] for o in outputs]) for name in vars(outputs[0])))

    def _forward_scene(self, images: Tensor, conditions: Conditions) -> NetworkOutput:
        layout, views = self.layout(patch_grid(images)), images.shape[1]
        patches = self.encode_images(images[0])
        unit, uses_depth = torch.ones(1, device=images.device), torch.zeros(1, dtype=torch.bool, device=images.device)
        if conditions.rays is not None and conditions.has_ray is not None:
            patches = patches + self.ray_embed(conditions.rays[0]) * conditions.has_ray[0, :, None, None]
        if conditions.depths is not None and conditions.has_depth is not None:
            unit, uses_depth = mean_depth(conditions.depths), conditions.has_depth.any(1)
            embedded = self._embed_depths(conditions.depths[0] / (unit + 1e-8))
            patches = patches + embedded * conditions.has_depth[0, :, None, None]
        poses = posed = None
        if conditions.poses is not None and conditions.has_pose is not None and conditions.has_pose.sum() > 1:
            poses = normalize_poses(conditions.poses, unit, uses_depth)
            posed = conditions.has_pose[0].nonzero().mT
        tokens = self.begin(patches, layout)[None]
        return self.reconstruct(tokens, layout, views, poses, posed)

    def _embed_depths(self, depths: Tensor) -> Tensor:
        """(V, H, W), 0 where unknown, to (V, P, C)."""
        embedded: Tensor = self.depth_encoder(torch.stack([depths, (depths > 0).to(depths.dtype)], dim=1))
        return embedded + self.depth_emb

    def _injection(self, poses: Tensor, posed: Tensor, grid: tuple[int, int]) -> Injection:
        """Adds to the posed views' patches what they learn from one another's cameras."""
        known = torch.take_along_dim(poses, posed[:, :, None, None], dim=1)
        positions = prope(known, grid, self.sizes.width // self.sizes.heads)

        def inject(index: int, x: Tensor) -> Tensor:
            if index % INJECTION_PERIOD != 1:
                return x
            specials, patches = x.split([SPECIALS, x.shape[2] - SPECIALS], dim=2)
            chosen = posed[:, :, None, None].expand(-1, -1, *patches.shape[2:])
            block = self.pose_inject_blk[index // INJECTION_PERIOD]
            learned = block(patches.gather(1, chosen).flatten(1, 2), positions).unflatten(1, (posed.shape[1], -1))
            patches = patches.scatter_add(1, chosen, learned.to(patches.dtype))
            return torch.cat([specials, patches], dim=2)

        return inject

    def _metric(self, decoded: Tensor, layout: Layout) -> Tensor:
        """Scale (B,) of each scene, about metres per unit."""
        scale: Tensor = self.metric_head(self.metric_decoder(self.metric_token, decoded.flatten(1, 2), layout.rope))
        return scale.exp()[:, 0]

    def read_maps(self, decoded: Tensor, layout: Layout) -> tuple[Tensor, Tensor]:
        """See Network.read_maps; before the metric scale."""
        x, y, log_z = self.point_head(self.point_decoder(decoded, layout.rope), layout.grid).unbind(-1)
        z = torch.exp(log_z.clamp_max(MAX_LOG_DEPTH))
        confidence = self.conf_head(self.conf_decoder(decoded, layout.rope), layout.grid)
        return torch.stack([x * z, y * z, z], dim=-1), confidence[..., 0]


def _scaling_column(scale: Tensor) -> Tensor:
    """(B, 1, 4, 1): what the last column of a pose is multiplied by to scale its translation by (B,)."""
    column = scale[:, None].repeat(1, 4)
    column[:, 3] = 1
    return column[:, None, :, None]
