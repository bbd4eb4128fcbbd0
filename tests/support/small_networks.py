"""Small networks with random weights, and photographs for them."""

import hashlib
from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless_server.method.features.views import Features, Photograph, PosedView, View
from mapless_server.networks.mapanything import MapAnything
from mapless_server.networks.megaloc import MegaLoc, MegaLocSizes
from mapless_server.networks.network import Network
from mapless_server.networks.runner import NetworkRunner
from support.images import textured
from support.parity_rule import ruled_network, weights

PIXEL_LIMIT = 20 * 14**2
"""5 x 4 patches for 4:3."""
NOTHING = Features(np.empty((0, 2), np.float32), np.empty((0, 4), np.float32), np.empty(0, np.float32))


def small_network(name: str) -> Network:
    """A small network of the rule's weights, whose every part has an effect, and which masks no pixel."""
    network = ruled_network(name)
    for key, parameter in network.named_parameters():
        if key.endswith("gamma"):
            parameter.data *= 6.0
    if isinstance(network, MapAnything):
        network.get_parameter("dense_head.1.conv2.2.bias")[5] = 50.0
    return network


def small_runner(name: str) -> NetworkRunner:
    """The network on the CPU."""
    return NetworkRunner(small_network(name), name, f"sha of {name}", "cpu")


def photograph(image: NDArray[np.uint8], camera: Camera | None = None, reads: list[str] | None = None) -> Photograph:
    """A photograph; every reading of it is noted in `reads`."""
    height, width = image.shape[:2]
    sha256 = hashlib.sha256(image.tobytes()).hexdigest()

    def read() -> NDArray[np.uint8]:
        if reads is not None:
            reads.append(sha256)
        return image

    camera = camera or Camera(width, height, 0.8 * width, 0.8 * width, width / 2 - 0.5, height / 2 - 0.5)
    return Photograph(lambda: sha256, camera, read)


def view_of(photo: Photograph) -> View:
    """A view without features."""
    return View(photo.camera.pinhole(), NOTHING, photo)


def references_of(photos: Sequence[Photograph]) -> tuple[PosedView, ...]:
    """References half a metre apart, each turned a little more."""
    poses = (
        RigidTransform(rotation_from_vector([0.0, 0.05 * i, 0.0]), np.array([0.5 * i + 1.0, 0.1 * i * i, -2.0]))
        for i in range(len(photos))
    )
    return tuple(
        PosedView(f"key-{i}", f"scenes/s/references/r{i}", view_of(photo), pose)
        for i, (photo, pose) in enumerate(zip(photos, poses, strict=True))
    )


def small_request(
    reference_count: int, seed: int = 0, size: tuple[int, int] = (96, 72), reads: list[str] | None = None
) -> tuple[View, tuple[PosedView, ...]]:
    """A query and references of one size, every image another one."""
    photos = [photograph(textured(*size, seed=1000 * seed + i), reads=reads) for i in range(reference_count + 1)]
    return view_of(photos[0]), references_of(photos[1:])


SMALL_MEGALOC = MegaLocSizes(64, 4, 3, hidden=32, clusters=8, cluster_width=16, token_width=24, length=96)


def ruled_state(network: torch.nn.Module) -> dict[str, Tensor]:
    """Weights by the rule; scores so far apart that it shows how often Sinkhorn's iteration goes round."""
    shapes = {name: tuple(tensor.shape) for name, tensor in network.state_dict().items()}
    state = {name: torch.tensor(weights(name, shape)).reshape(shape) for name, shape in shapes.items()}
    state["aggregator.agg.score.3.weight"] *= 16
    return state


def ruled_megaloc() -> MegaLoc:
    """The network with these weights."""
    with torch.device("meta"):
        network = MegaLoc(SMALL_MEGALOC)
    network.load_state_dict(ruled_state(network), assign=True)
    return network.eval().requires_grad_(False)
