"""The networks to measure: the official sizes, random weights."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from mapless_server.choices import NETWORKS
from mapless_server.networks.encoder import PATCH_PX
from mapless_server.networks.mapanything import MapAnything, MapAnythingSizes
from mapless_server.networks.network import Network, NetworkOutput
from mapless_server.networks.pi3 import Pi3, Pi3X, Sizes

from .operations import Peak, count_flop
from .report import Figure

GRID = (28, 37)
"""Rows and columns of patches of 518x392 pixels, the server's size for 4:3."""
REFERENCES = 10
VIEWS = REFERENCES + 1
CACHED = 100
"""References whose tokens lie on the device."""
QK_GAIN = 1.5
"""Selective attention, like a trained network's: with uniform attention everything averages out, rounding too."""
EXPONENTIALS = ("point_head.proj", "conf_head.proj", "metric_head", "dense_head.1.conv2.2", "scale_head.output_proj")
"""Last layers, exponentials of whose output are depths or scales."""
AnySizes = Sizes | MapAnythingSizes


def network_without_weights(name: str, sizes: AnySizes | None = None) -> Network:
    """A Pi3, Pi3X or MapAnything on the meta device, with sizes of its own kind; None for the official ones."""
    with torch.device("meta"):
        if name == "mapanything":
            if isinstance(sizes, Sizes):
                raise TypeError("MapAnything has sizes of its own")
            return MapAnything(sizes)
        if isinstance(sizes, MapAnythingSizes):
            raise TypeError(f"these are sizes of MapAnything, not of {name}")
        return Pi3(sizes) if name == "pi3" else Pi3X(sizes)


def make_network(
    name: str, sizes: AnySizes | None = None, device: torch.device | str = "cpu", seed: int = 0
) -> Network:
    """A float32 network with seeded random weights and finite activations; zeros would be faster and hide errors."""
    network = network_without_weights(name, sizes)
    random = torch.Generator(device).manual_seed(seed)
    parameters = dict(network.named_parameters())
    state = {}
    for key, tensor in network.state_dict().items():
        if key in parameters:
            state[key] = _scaled(key, torch.randn(tensor.shape, generator=random, device=device))
        else:
            state[key] = _marker(tensor) if tensor.is_meta else tensor
    network.load_state_dict(state, assign=True)
    return network.eval().requires_grad_(False).to(device)


def _marker(buffer: Tensor) -> Tensor:
    """MapAnything's marker of the first view: 0 on even channels, 1 on odd ones."""
    return (torch.arange(buffer.shape[-1]) % 2).float().expand(buffer.shape).clone()


def _scaled(key: str, noise: Tensor) -> Tensor:
    name = key.rsplit(".", 1)[-1]
    if name == "gamma":
        return 0.1 + 0.03 * noise
    if name in ("cls_token", "pos_embed", "register_tokens", "register_token", "metric_token", "scale_token"):
        return 0.3 * noise
    if noise.ndim == 1:
        return (1.0 if name == "weight" else 0.0) + 0.05 * noise
    weights: Tensor = noise / noise[0].numel() ** 0.5
    if key.endswith("qkv.weight"):
        weights[: 2 * len(weights) // 3] *= QK_GAIN
    if key.startswith(EXPONENTIALS) or "_head.output_block" in key:
        weights *= 0.3  # depths are exponentials
    return weights


@dataclass(frozen=True)
class Work:
    """One forward pass of a scene.

    Of its views, so many are encoded, the tokens of the others being given, and points and confidence of so many are
    computed.
    """

    encoded: int
    mapped: int
    views: int = REFERENCES + 1
    grid: tuple[int, int] = GRID


class Scene:
    """Random views of one scene, and what is known about them, on the network's device."""

    def __init__(self, network: Network, views: int, grid: tuple[int, int], seed: int = 0) -> None:
        device = next(network.parameters()).device
        height, width = (PATCH_PX * side for side in grid)
        on_meta = device.type == "meta"
        random = None if on_meta else torch.Generator(device).manual_seed(seed)
        self.layout = network.layout(grid)
        self.images = torch.rand(views, 3, height, width, generator=random, device=device)
        self.intrinsics = self.poses = self.posed = None
        self.conditions: tuple[Tensor, ...] = ()
        if network.conditioned:
            k = torch.tensor([[0.8 * width, 0.0, width / 2], [0.0, 0.8 * width, height / 2], [0.0, 0.0, 1.0]])
            self.intrinsics = k.repeat(views, 1, 1).to(device)
            self.poses = torch.eye(4).repeat(1, views, 1, 1)
            self.poses[..., 0, 3] = torch.arange(views)
            self.posed = (torch.arange(views) < views - 1)[None]
            given = network.conditions(self.poses, self.posed, torch.ones_like(self.posed)) or ()
            self.conditions = tuple(it.to(device) for it in given)

    def encode(self, network: Network, views: slice) -> Tensor:
        """Encodes some views to tokens (V, T, C)."""
        intrinsics = None if self.intrinsics is None else self.intrinsics[views]
        return network.encode(self.images[views], self.layout, intrinsics)

    def reconstruct(self, network: Network, tokens: Tensor, mapped: int) -> NetworkOutput:
        """Reconstructs the scene from tokens (1, N, T, C)."""
        return network.reconstruct(tokens, self.layout, mapped, *self.conditions)


def flop_of(name: str, work: Work, sizes: AnySizes | None = None) -> int:
    """Counts the operations that a forward pass executes."""
    network = meta_network(name, sizes)
    scene = Scene(network, work.views, work.grid)
    shape = (1, work.views, network.token_count(work.grid), network.width)
    tokens = torch.empty(shape, dtype=torch.bfloat16, device="meta")
    encoded = count_flop(lambda: scene.encode(network, slice(work.encoded))) if work.encoded else 0
    return encoded + count_flop(lambda: scene.reconstruct(network, tokens, work.mapped))


def meta_network(name: str, sizes: AnySizes | None = None) -> Network:
    """A network without memory, for counting."""
    network = network_without_weights(name, sizes)
    network.requires_grad_(False).set_compute_type(torch.bfloat16)
    return network.to("meta")


WORKS = {
    "everything": Work(VIEWS, VIEWS),
    "references mapped": Work(VIEWS, REFERENCES),
    "references' tokens kept, references mapped": Work(1, REFERENCES),
    "references' tokens kept, cameras only": Work(1, 0),
}


def count_all(peak: Peak) -> Iterator[Figure]:
    """Counts operations of forward passes of the official networks, and bytes on the device."""
    for name in NETWORKS:
        part = f"{name}, {VIEWS} views of 518x392; floors are those of {peak.device}"
        for label, work in WORKS.items():
            flop = flop_of(name, work)
            yield Figure(part, label, flop / 1e12, "TFLOP", floor_ms=peak.floor_ms(flop))
        network = meta_network(name)
        weights = sum(it.nbytes for it in network.parameters())
        tokens = CACHED * network.token_count(GRID) * network.width * torch.bfloat16.itemsize
        yield Figure(f"{name} memory", "weights, linear layers in bfloat16", weights / 1e9, "GB")
        yield Figure(f"{name} memory", f"tokens of {CACHED} references of 518x392", tokens / 1e9, "GB")
