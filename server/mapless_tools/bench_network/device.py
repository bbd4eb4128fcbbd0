"""The limits of a device, and the memory of a network that serves on it."""

import statistics
import time
from collections.abc import Callable, Iterator

import torch

from mapless_server.networks.runner import NetworkRunner

from .operations import Rates
from .report import Figure
from .subject import GRID, REFERENCES, Scene

PRODUCT_SIDE = 8192
COPY_BYTES = 4 * 2**30
"""Much larger than any cache."""
CACHED = 100
"""References whose tokens lie on the device."""
LIMIT_GB = 8.0


def median_s(work: Callable[[], object], device: torch.device, repeats: int, warm_up: int = 3) -> tuple[float, float]:
    """The median time of `work`, seconds, measured twice: a difference smaller than that of the two is none."""
    for _ in range(warm_up):
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


def measure_rates(device: torch.device, repeats: int = 20) -> Rates:
    """Measures the limits of a CUDA device on random numbers, since zeros are faster."""
    a, b = (torch.randn(PRODUCT_SIDE, PRODUCT_SIDE, device=device, dtype=torch.bfloat16) for _ in range(2))
    product_s = min(median_s(lambda: a @ b, device, repeats))
    source = torch.randint(0, 255, (COPY_BYTES,), dtype=torch.uint8, device=device)
    target = torch.empty_like(source)
    copy_s = min(median_s(lambda: target.copy_(source), device, repeats))
    name = torch.cuda.get_device_name(device)
    return Rates(name, 2 * PRODUCT_SIDE**3 / product_s, 2 * COPY_BYTES / copy_s, _launch_s(device), measured=True)


def _launch_s(device: torch.device, count: int = 2000) -> float:
    """The host's time for an operation on a tiny tensor, whose kernel takes less time."""
    x = torch.ones(1, device=device)
    torch.cuda.synchronize(device)
    start_s = time.perf_counter()
    for _ in range(count):
        x.add_(1)
    took_s = time.perf_counter() - start_s
    torch.cuda.synchronize(device)
    return took_s / count


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
