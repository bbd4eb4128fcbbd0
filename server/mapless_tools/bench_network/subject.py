"""The networks to measure: the official sizes, random weights."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from mapless_server.networks.conditions import normalize_poses
from mapless_server.networks.encoder import PATCH_PX
from mapless_server.networks.network import Network, NetworkOutput, Sizes
from mapless_server.networks.pi3 import Pi3
from mapless_server.networks.pi3x import Pi3X

from .operations import Operations, count_operations

GRID = (28, 37)
"""Rows and columns of patches of 518x392 pixels, the server's size for 4:3."""
REFERENCES = 10
QK_GAIN = 1.5
"""Selective attention, like a trained network's: with uniform attention everything averages out, rounding too."""


def make_network(name: str, sizes: Sizes | None = None, device: torch.device | str = "cpu", seed: int = 0) -> Network:
    """A Pi3 or Pi3X, float32, with seeded random weights that keep all activations finite and of a trained one's order.

    Zeros would be computed faster, and would show no error.
    """
    with torch.device("meta"):
        network: Network = Pi3(sizes) if name == "pi3" else Pi3X(sizes)
    random = torch.Generator(device).manual_seed(seed)
    weights = {
        key: _scaled(key, torch.randn(parameter.shape, generator=random, device=device))
        for key, parameter in network.named_parameters()
    }
    network.load_state_dict({**network.state_dict(), **weights}, assign=True)
    return network.eval().requires_grad_(False).to(device)


def _scaled(key: str, noise: Tensor) -> Tensor:
    name = key.rsplit(".", 1)[-1]
    if name == "gamma":
        return 0.1 + 0.03 * noise
    if name in ("cls_token", "pos_embed", "register_tokens", "register_token", "metric_token"):
        return 0.3 * noise
    if noise.ndim == 1:
        return (1.0 if name == "weight" else 0.0) + 0.05 * noise
    weights: Tensor = noise / noise[0].numel() ** 0.5
    if key.endswith("qkv.weight"):
        weights[: 2 * len(weights) // 3] *= QK_GAIN
    if key.startswith(("point_head.proj", "conf_head.proj", "metric_head")) or "_head.output_block" in key:
        weights *= 0.3  # depths are exponentials
    return weights


@dataclass(frozen=True)
class Work:
    """One forward pass of a scene.

    Attributes:
        encoded: how many views are encoded; the tokens of the others are at hand.
        mapped: of how many views points and confidence are computed.
        views: of the scene.
        grid: rows and columns of patches.
    """

    encoded: int
    mapped: int
    views: int = REFERENCES + 1
    grid: tuple[int, int] = GRID


class Scene:
    """Random views of one scene, and what is known of them, on the network's device."""

    def __init__(self, network: Network, views: int, grid: tuple[int, int], seed: int = 0) -> None:
        device = network.register_token.device
        height, width = (PATCH_PX * side for side in grid)
        on_meta = device.type == "meta"
        random = None if on_meta else torch.Generator(device).manual_seed(seed)
        self.layout = network.layout(grid)
        self.images = torch.rand(views, 3, height, width, generator=random, device=device)
        self.intrinsics = self.poses = self.posed = None
        if network.conditioned:
            k = torch.tensor([[0.8 * width, 0.0, width / 2], [0.0, 0.8 * width, height / 2], [0.0, 0.0, 1.0]])
            self.intrinsics = k.repeat(views, 1, 1).to(device)
            poses = torch.eye(4).repeat(1, views, 1, 1)
            poses[..., 0, 3] = torch.arange(views)
            self.poses = normalize_poses(poses).to(device)
            self.posed = torch.arange(views - 1, device=device)[None]

    def encode(self, network: Network, views: slice) -> Tensor:
        """Tokens (V, T, C) of some views."""
        intrinsics = None if self.intrinsics is None else self.intrinsics[views]
        return network.encode(self.images[views], self.layout, intrinsics)

    def reconstruct(self, network: Network, tokens: Tensor, mapped: int) -> NetworkOutput:
        """The scene of tokens (1, N, T, C)."""
        return network.reconstruct(tokens, self.layout, mapped, self.poses, self.posed)


def operations_of(name: str, work: Work, sizes: Sizes | None = None, dtype: torch.dtype = torch.bfloat16) -> Operations:
    """What a forward pass executes."""
    network = meta_network(name, sizes, dtype)
    scene = Scene(network, work.views, work.grid)
    width, count = network.sizes.width, 5 + work.grid[0] * work.grid[1]
    tokens = torch.empty(1, work.views, count, width, dtype=dtype, device="meta")
    encoded = count_operations(lambda: scene.encode(network, slice(work.encoded))) if work.encoded else Operations()
    return encoded + count_operations(lambda: scene.reconstruct(network, tokens, work.mapped))


def meta_network(name: str, sizes: Sizes | None = None, dtype: torch.dtype = torch.bfloat16) -> Network:
    """A network without memory, to count on."""
    with torch.device("meta"):
        network: Network = Pi3(sizes) if name == "pi3" else Pi3X(sizes)
    network.requires_grad_(False).set_compute_type(dtype)
    return network.to("meta")
