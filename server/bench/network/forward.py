"""A network's forward pass on a CUDA device: its steps with their least times; peak and memory."""

import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import torch
from torch import Tensor

from mapless_server.networks.network import Network, NetworkOutput
from mapless_server.networks.runner import NetworkRunner

from .operations import Peak
from .report import Figure
from .subject import CACHED, GRID, REFERENCES, VIEWS, Scene, Work, flop_of, make_network

PLAIN_MS, KEPT_MS = 90.0, 60.0
"""Targets: without and with what is kept."""
MAX_DIFFERENCE = 0.2
"""Between two ways to compute the same in bfloat16, largest of all pixels, as a share of the largest value: rounding in
sixty blocks makes some hundredths of it, a wrong block about 1."""


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
    """A network in bfloat16, and a scene."""

    @torch.no_grad()
    def __init__(self, network: Network, views: int = VIEWS, grid: tuple[int, int] = GRID) -> None:
        network.set_compute_type(torch.bfloat16)
        self.network = network
        self.scene = Scene(network, views, grid)
        self._compiled = _compiled(network)
        self.kept = self.scene.encode(network, slice(None)).to(torch.bfloat16)

    @torch.no_grad()
    def run(self, work: Work, compiled: bool = False) -> NetworkOutput:
        """Encodes the last views, the query last of all, uses kept tokens for the others, and reconstructs."""
        encode, reconstruct = self._compiled if compiled else (self.network.encode, self.network.reconstruct)
        scene, kept = self.scene, work.views - work.encoded
        intrinsics = None if scene.intrinsics is None else scene.intrinsics[kept:]
        encoded: Tensor = encode(scene.images[kept:], scene.layout, intrinsics)
        # Recorded graphs write into the same memory again and again: joining copies.
        tokens = torch.cat([self.kept[:kept], encoded.to(torch.bfloat16)])[None]
        output: NetworkOutput = reconstruct(tokens, scene.layout, work.mapped, *scene.conditions)
        return output


def _compiled(network: Network) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Compiles as the runner does; nothing happens before the first call."""
    options: dict[str, str | int | bool | Callable[..., Any]] = {"triton.cudagraphs": True}
    encode = torch.compile(network.encode, backend="inductor", fullgraph=True, dynamic=False, options=options)
    reconstruct = torch.compile(network.reconstruct, backend="inductor", fullgraph=True, dynamic=False, options=options)
    return encode, reconstruct


def measure_forward(name: str, peak: Peak, device: torch.device, repeats: int, compiles: bool) -> Iterator[Figure]:
    """Measures each step and yields its figure."""
    part = f"{name} forward, {VIEWS} views of {GRID[1] * 14}x{GRID[0] * 14}"
    forward = Forward(make_network(name, device=device))
    for step in STEPS:
        if step.compiled and not compiles:
            continue
        flop = flop_of(name, step.work)
        figure = Figure(part, step.name, None, "ms", floor_ms=peak.floor_ms(flop), target=step.target_ms)
        try:
            difference = _check(forward, step)
            times = median_s(partial(forward.run, step.work, step.compiled), device, repeats)
        except Exception as error:  # the other steps can still be measured
            yield replace(figure, note=reason_of(error))
            continue
        note = f"{flop / 1e12:.2f} TFLOP"
        note += f"; from eager by {difference:.2g} of the largest" if step.compiled else ""
        yield replace(figure, value=1e3 * times[0], again=1e3 * times[1], note=note)


def _check(forward: Forward, step: Step) -> float:
    """Runs a step; its largest difference from the eager pass. ArithmeticError if that is not finite, or too large."""
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
    """The error in one line for the table."""
    return f"{type(error).__name__}: {error}".splitlines()[0][:160].replace("|", "/")


PRODUCT_SIDE = 8192
LIMIT_GB = 8.0


def median_s(work: Callable[[], object], device: torch.device, repeats: int) -> tuple[float, float]:
    """The median time of `work`, seconds, measured twice: a difference smaller than that of the two is none."""
    for _ in range(3):  # the first are slower
        work()
    first, second = (_median_s(work, device, repeats) for _ in range(2))
    return first, second


def _median_s(work: Callable[[], object], device: torch.device, repeats: int) -> float:
    if device.type != "cuda":
        times = []
        for _ in range(repeats):
            start_s = time.perf_counter()
            work()
            times.append(time.perf_counter() - start_s)
        return statistics.median(times)
    events = [(torch.cuda.Event(enable_timing=True), torch.cuda.Event(enable_timing=True)) for _ in range(repeats)]
    torch.cuda.synchronize(device)
    for start, end in events:
        start.record()
        work()
        end.record()
    torch.cuda.synchronize(device)
    return statistics.median(float(start.elapsed_time(end)) for start, end in events) / 1000


def measure_peak(device: torch.device) -> Peak:
    """Measures the peak of a CUDA device on random numbers, since zeros are faster."""
    a, b = (torch.randn(PRODUCT_SIDE, PRODUCT_SIDE, device=device, dtype=torch.bfloat16) for _ in range(2))
    product_s = min(median_s(lambda: a @ b, device, 20))
    return Peak(torch.cuda.get_device_name(device), 2 * PRODUCT_SIDE**3 / product_s)


def measure_memory(make_runner: Callable[[], NetworkRunner], device: torch.device) -> Iterator[Figure]:
    """Peak memory while the network is loaded, warmed up and used, with a hundred references' tokens on the device.

    The figures are those of the whole process, so nothing else may be on the device before.
    """
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    runner = make_runner()
    part = f"{runner.name} memory"
    yield Figure(part, "weights and recorded graphs", torch.cuda.memory_allocated(device) / 1e9, "GB")
    scene = Scene(runner.network, REFERENCES + 1, GRID)
    intrinsics = None if scene.intrinsics is None else scene.intrinsics[:1]
    kept = [runner.encode(scene.images[:1], intrinsics).clone() for _ in range(CACHED)]
    for _ in range(3):
        query = runner.encode(scene.images[:1], intrinsics)
        runner.reconstruct(torch.cat([*kept[:REFERENCES], query])[None], GRID, REFERENCES, scene.poses, scene.posed)
    torch.cuda.synchronize(device)
    yield Figure(part, f"tokens of {CACHED} references", sum(it.nbytes for it in kept) / 1e9, "GB")
    peak = torch.cuda.max_memory_allocated(device) / 1e9
    yield Figure(part, "peak, of tensors", peak, "GB", target=LIMIT_GB)
    free, total = torch.cuda.mem_get_info(device)
    note = "with the driver's and the allocator's own, and other processes'"
    yield Figure(part, "taken from the device", (total - free) / 1e9, "GB", target=LIMIT_GB, note=note)
    runner.close()
