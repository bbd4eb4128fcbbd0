"""A small MegaLoc with weights made by a rule."""

import torch
from torch import Tensor

from mapless_server.networks.megaloc import MegaLoc, MegaLocSizes
from support.parity_rule import weights

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
