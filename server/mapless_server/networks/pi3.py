"""pi^3 (Wang et al. 2025): points, confidence and poses from images alone."""

from __future__ import annotations

import torch
from torch import Tensor

from .decoder import TokenLayout
from .heads import LinearHead
from .network import NetworkOutput
from .pi import PiNetwork, Sizes


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

    def read_maps(self, decoded: Tensor, layout: TokenLayout) -> tuple[Tensor, Tensor]:
        """See PiNetwork.read_maps."""
        x, y, log_z = self.point_head(self.point_decoder(decoded, layout.rope), layout.grid).unbind(-1)
        z = torch.exp(log_z)
        confidence = self.conf_head(self.conf_decoder(decoded, layout.rope), layout.grid)
        return torch.stack([x * z, y * z, z], dim=-1), confidence[..., 0]
