"""Pi3X, the successor of pi^3: takes intrinsics and poses as conditions, and its output is roughly metric.

Given poses fix neither the frame nor the scale of the output: align it with them afterwards, as with Pi3. The official
network's part for given depths, a fifth of its weights, is left out: no query comes with depths.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from .conditions import PoseInjection, normalize_poses, prope, rays_from_intrinsics
from .decoder import SPECIALS, Injection, TokenLayout
from .encoder import PatchEmbedding
from .heads import ConvHead, MetricDecoder
from .network import NetworkOutput
from .pi import PiNetwork, Sizes

INJECTION_PERIOD = 8
"""Poses are injected after block 1 and every eighth from there."""
MAX_LOG_DEPTH = 15.0


class Pi3X(PiNetwork):
    """The network of Pi3X, without its part for depths."""

    conditioned = True
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

        The unit does not matter. Views without a pose need plausible values, for these enter the scale.

        Raises:
            ValueError: scenes with different numbers of posed views.
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
        """Adds the update by the posed views' cameras to these views' patches."""
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
        """Scale (B,) of each scene, about metres per unit."""
        scale: Tensor = self.metric_head(self.metric_decoder(self.metric_token, decoded.flatten(1, 2), layout.rope))
        return scale.exp()[:, 0]

    def read_maps(self, decoded: Tensor, layout: TokenLayout) -> tuple[Tensor, Tensor]:
        """See PiNetwork.read_maps; before the metric scale."""
        x, y, log_z = self.point_head(self.point_decoder(decoded, layout.rope), layout.grid).unbind(-1)
        z = torch.exp(log_z.clamp_max(MAX_LOG_DEPTH))
        confidence = self.conf_head(self.conf_decoder(decoded, layout.rope), layout.grid)
        return torch.stack([x * z, y * z, z], dim=-1), confidence[..., 0]


def _scaling_column(scale: Tensor) -> Tensor:
    """Factors (B, 1, 4, 1) of the last column of a pose that scale its translation by (B,)."""
    column = scale[:, None].repeat(1, 4)
    column[:, 3] = 1
    return column[:, None, :, None]
