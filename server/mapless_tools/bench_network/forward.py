"""A network's forward pass on a CUDA device: its steps with their least and predicted times, kernels, variants."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from typing import Any
from unittest.mock import patch

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor
from torch._C._autograd import DeviceType
from torch.nn.attention import SDPBackend, sdpa_kernel

from mapless_server.networks.blocks import Attention
from mapless_server.networks.network import Network, NetworkOutput
from mapless_server.networks.pi3 import PiNetwork

from .device import median_s
from .operations import ATTENTION_EFFICIENCY, Rates
from .report import Figure
from .subject import GRID, REFERENCES, Scene, Work, make_network, operations_of

VIEWS = REFERENCES + 1
PLAIN_MS, KEPT_MS = 90.0, 60.0
"""Targets: without and with what is kept."""
MAX_DIFFERENCE = 0.2
"""Between two ways to compute the same in bfloat16, largest of all pixels, as a share of the largest value: rounding in
sixty blocks makes some hundredths of it, a wrong block about 1."""


BACKENDS = {
    "flash": SDPBackend.FLASH_ATTENTION,
    "cuDNN": SDPBackend.CUDNN_ATTENTION,
    "memory efficient": SDPBackend.EFFICIENT_ATTENTION,
}
HEADS, HEAD_WIDTH = 16, 64


@dataclass(frozen=True)
class Step:
    """A way to compute a query."""

    name: str
    work: Work
    compiled: bool
    target_ms: float | None = None


STEPS = (
    Step("eager, everything", Work(VIEWS, VIEWS), False),
    Step("eager, no map of the query", Work(VIEWS, REFERENCES), False),
    Step("eager, references' tokens kept", Work(1, REFERENCES), False),
    Step("eager, tokens kept, cameras only", Work(1, 0), False),
    Step("compiled, references' tokens kept", Work(1, REFERENCES), True, KEPT_MS),
    Step("compiled, tokens kept, cameras only", Work(1, 0), True, KEPT_MS),
    Step("compiled, everything", Work(VIEWS, VIEWS), True, PLAIN_MS),
)
"""The ones that matter most before those that compile longest."""


class Forward:
    """A network in bfloat16 with exactly one kind of attention, and a scene."""

    def __init__(
        self,
        network: Network,
        backend: SDPBackend = SDPBackend.FLASH_ATTENTION,
        views: int = VIEWS,
        grid: tuple[int, int] = GRID,
    ) -> None:
        network.set_compute_type(torch.bfloat16)
        self.network = network
        self.backend = backend
        self.scene = Scene(network, views, grid)
        self._compiled = _compiled(network)
        with self.kernels():
            self.kept = self.scene.encode(network, slice(None)).to(torch.bfloat16)

    @contextmanager
    def kernels(self) -> Iterator[None]:
        """Enables only the wanted attention; if it cannot run, that is an error. The network itself uses flash."""
        with torch.no_grad():
            if self.backend is SDPBackend.FLASH_ATTENTION:
                yield
                return
            with sdpa_kernel(self.backend), patch.object(Attention, "attend", staticmethod(_any_attention)):
                yield

    def run(self, work: Work, compiled: bool = False) -> NetworkOutput:
        """Encodes the last views, the query last of all, uses kept tokens for the others, and reconstructs."""
        encode, reconstruct = self._compiled if compiled else (self.network.encode, self.network.reconstruct)
        scene, kept = self.scene, work.views - work.encoded
        with self.kernels():
            intrinsics = None if scene.intrinsics is None else scene.intrinsics[kept:]
            encoded: Tensor = encode(scene.images[kept:], scene.layout, intrinsics)
            # Recorded graphs write into the same memory again and again: joining copies.
            tokens = torch.cat([self.kept[:kept], encoded.to(torch.bfloat16)])[None]
            output: NetworkOutput = reconstruct(tokens, scene.layout, work.mapped, *scene.conditions)
            return output


def _any_attention(q: Tensor, k: Tensor, v: Tensor) -> Tensor:
    return F.scaled_dot_product_attention(q.to(v.dtype), k.to(v.dtype), v)


def _compiled(network: Network) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiles as the runner does; nothing happens before the first call."""
    options: dict[str, str | int | bool | Callable[..., Any]] = {"triton.cudagraphs": True}
    encode = torch.compile(network.encode, backend="inductor", fullgraph=True, dynamic=False, options=options)
    reconstruct = torch.compile(network.reconstruct, backend="inductor", fullgraph=True, dynamic=False, options=options)
    return encode, reconstruct


def measure_forward(name: str, rates: Rates, device: torch.device, repeats: int, compiles: bool) -> Iterator[Figure]:
    """Measures each step and yields its figure."""
    part = f"{name} forward, {VIEWS} views of {GRID[1] * 14}x{GRID[0] * 14}"
    forward = Forward(make_network(name, device=device))
    for step in STEPS:
        if step.compiled and not compiles:
            continue
        operations = operations_of(name, step.work)
        floor_ms = 1e3 * operations.floor_s(rates)
        predicted_ms = 1e3 * operations.predicted_s(rates, step.compiled)
        figure = Figure(part, step.name, None, "ms", None, floor_ms, predicted_ms, step.target_ms)
        try:
            difference = _check(forward, step)
            times = median_s(partial(forward.run, step.work, step.compiled), device, repeats)
        except Exception as error:  # the other steps can still be measured
            yield replace(figure, note=reason_of(error))
            continue
        note = f"{operations.flop / 1e12:.2f} TFLOP, {operations.kernels} kernels"
        note += f"; from eager by {difference:.2g} of the largest" if step.compiled else ""
        yield replace(figure, value=1e3 * times[0], again=1e3 * times[1], note=note)


def _check(forward: Forward, step: Step) -> float:
    """Runs a step; returns its largest difference from the eager pass.

    ArithmeticError if the output is not finite, or differs too much.
    """
    output = forward.run(step.work, step.compiled)
    if not all(bool(tensor.isfinite().all()) for tensor in vars(output).values()):
        raise ArithmeticError("the output is not finite")
    output = NetworkOutput(*(tensor.clone() for tensor in vars(output).values()))
    difference = max_difference(output, forward.run(step.work))
    if not difference <= MAX_DIFFERENCE:
        raise ArithmeticError(f"the output differs from the eager one by {difference:.2g} of the largest")
    return difference


def max_difference(output: NetworkOutput, reference: NetworkOutput) -> float:
    """The largest difference of any output, as a share of the largest absolute value of that output."""
    parts = zip(vars(output).values(), vars(reference).values(), strict=True)
    return max((float((a - b).abs().max() / b.abs().max()) for a, b in parts if a.numel()), default=0.0)


def reason_of(error: Exception) -> str:
    """What failed, in one line for the table."""
    return f"{type(error).__name__}: {error}".splitlines()[0][:160].replace("|", "/")


def measure_kernels(name: str, device: torch.device) -> tuple[list[Figure], dict[str, Any]]:
    """Which kernels an eager forward pass launches, how often flash attention, and how often the host waits."""
    forward = Forward(make_network(name, device=device))
    work = Work(1, REFERENCES)
    forward.run(work)
    activities = [torch.profiler.ProfilerActivity.CUDA, torch.profiler.ProfilerActivity.CPU]
    with torch.profiler.profile(activities=activities) as profile:
        forward.run(work)
        torch.cuda.synchronize(device)
    kernels = [event for event in profile.key_averages() if event.device_type == DeviceType.CUDA]
    milliseconds: dict[str, float] = {"attention": 0.0, "matrix products": 0.0, "between": 0.0}
    flash_count = 0
    for event in kernels:
        milliseconds[_kind(event.key)] += event.self_device_time_total / 1000
        flash_count += event.count if "flash" in event.key else 0
    blocks = sum(isinstance(module, Attention) for module in forward.network.modules())
    part = f"{name} kernels, eager, tokens kept"
    figures = [Figure(part, kind, value, "ms") for kind, value in milliseconds.items()]
    note = f"{blocks} blocks; and all else that attends"
    figures += [Figure(part, "flash attention", flash_count, "calls", target=blocks, target_is_least=True, note=note)]
    figures += [Figure(part, "the host waits", _waits(forward, work), "times", target=0)]
    longest = sorted(kernels, key=lambda event: -event.self_device_time_total)[:25]
    return figures, {"kernels": [[it.key, it.count, it.self_device_time_total / 1000] for it in longest]}


def _waits(forward: Forward, work: Work) -> int:
    """How often the host waits for the device, as far as torch detects it."""
    torch.cuda.set_sync_debug_mode("warn")
    try:
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            forward.run(work)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    return sum("synchroniz" in str(warning.message) for warning in caught)


def _kind(kernel: str) -> str:
    name = kernel.lower()
    if any(word in name for word in ("flash", "fmha", "attention")):
        return "attention"
    if any(word in name for word in ("gemm", "cutlass", "nvjet", "xmma", "cublas", "conv", "wgrad", "dgrad")):
        return "matrix products"
    return "between"


def measure_attention(rates: Rates, device: torch.device, repeats: int) -> Iterator[Figure]:
    """Measures attention alone, over the scene and within its views, with each kernel."""
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
    """Measures eager forward passes with kept references' tokens, with one change at a time."""
    part = f"{name} forward, eager, tokens kept, otherwise"
    network = make_network(name, device=device)
    for label, backend in BACKENDS.items():
        yield _figure(part, f"{label} attention", network, backend, device, repeats)
    if isinstance(network, PiNetwork):
        with_low_precision_stream(network)
        label = "main decoder's residual stream in bfloat16"
        yield _figure(part, label, network, SDPBackend.FLASH_ATTENTION, device, repeats)
    yield _rounding(part, make_network(name, device=device))


def _rounding(part: str, network: Network) -> Figure:
    """The effect of bfloat16 at full size; casts the network to it."""
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


def with_low_precision_stream(network: PiNetwork) -> None:
    """Makes the main decoder's residual stream bfloat16, unlike the official code."""
    network.set_compute_type(torch.bfloat16)
    network.decoder.to(torch.bfloat16)
    network.register_token.data = network.register_token.to(torch.bfloat16)
