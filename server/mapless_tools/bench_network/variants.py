"""What could be chosen otherwise: the attention kernel, the type of the residual stream."""

from __future__ import annotations

from collections.abc import Iterator

import torch
import torch.nn.functional as F  # noqa: N812
from torch.nn.attention import SDPBackend, sdpa_kernel

from mapless_server.networks.network import Network

from .ceilings import median_s
from .forward import VIEWS, Forward, max_difference, reason_of
from .operations import ATTENTION_EFFICIENCY, Rates
from .report import Figure
from .subject import GRID, REFERENCES, Scene, Work, make_network

BACKENDS = {
    "flash": SDPBackend.FLASH_ATTENTION,
    "cuDNN": SDPBackend.CUDNN_ATTENTION,
    "memory efficient": SDPBackend.EFFICIENT_ATTENTION,
}
HEADS, HEAD_WIDTH = 16, 64


def measure_attention(rates: Rates, device: torch.device, repeats: int) -> Iterator[Figure]:
    """Attention alone, over the scene and within its views, by each kernel."""
    tokens = 5 + GRID[0] * GRID[1]
    for batch, count in ((1, VIEWS * tokens), (VIEWS, tokens)):
        q, k, v = torch.randn(3, batch, HEADS, count, HEAD_WIDTH, device=device, dtype=torch.bfloat16)
        flop = 4 * batch * HEADS * count**2 * HEAD_WIDTH
        floor_ms = 1e3 * flop / rates.matrix_flops
        part = f"attention alone, {batch} x {count} tokens, 16 heads of 64"
        for name, backend in BACKENDS.items():
            predicted = floor_ms / ATTENTION_EFFICIENCY if name == "flash" else None
            try:
                with torch.no_grad(), sdpa_kernel(backend):
                    times = median_s(lambda: F.scaled_dot_product_attention(q, k, v), device, repeats)  # noqa: B023
            except Exception as error:  # a kernel that this device lacks
                yield Figure(part, name, None, "ms", None, floor_ms, predicted, note=reason_of(error))
                continue
            note = f"{flop / times[0] / 1e12:.0f} TFLOP/s"
            yield Figure(part, name, 1e3 * times[0], "ms", 1e3 * times[1], floor_ms, predicted, note=note)


def measure_variants(name: str, device: torch.device, repeats: int) -> Iterator[Figure]:
    """Eager forward passes with the references' tokens kept, one thing changed at a time."""
    part = f"{name} forward, eager, tokens kept, otherwise"
    network = make_network(name, device=device)
    for label, backend in BACKENDS.items():
        yield _figure(part, f"{label} attention", network, backend, device, repeats)
    with_low_precision_stream(network)
    yield _figure(
        part, "main decoder's residual stream in bfloat16", network, SDPBackend.FLASH_ATTENTION, device, repeats
    )
    yield _rounding(part, make_network(name, device=device))


def _rounding(part: str, network: Network) -> Figure:
    """What bfloat16 changes at full size; casts the network to it."""
    scene = Scene(network, VIEWS, GRID)
    with torch.no_grad():
        exact = scene.reconstruct(network, scene.encode(network, slice(None))[None], REFERENCES)
    rounded = Forward(network).run(Work(1, REFERENCES))
    note = "of the largest value, with random weights"
    return Figure(part, "largest difference from float32", max_difference(rounded, exact), "", note=note)


def _figure(part: str, label: str, network: Network, backend: SDPBackend, device: torch.device, repeats: int) -> Figure:
    try:
        forward = Forward(network, backend)
        times = median_s(lambda: forward.run(Work(1, REFERENCES)), device, repeats)
    except Exception as error:  # the others can still be measured
        return Figure(part, label, None, "ms", note=reason_of(error))
    return Figure(part, label, 1e3 * times[0], "ms", 1e3 * times[1])


def with_low_precision_stream(network: Network) -> None:
    """Lets the main decoder carry bfloat16, which the official code does not."""
    network.set_compute_type(torch.bfloat16)
    network.decoder.to(torch.bfloat16)
    network.register_token.data = network.register_token.to(torch.bfloat16)
