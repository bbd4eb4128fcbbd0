"""Device memory of a network that serves: weights, tokens of a hundred references, one query."""

from __future__ import annotations

from collections.abc import Callable, Iterator

import torch

from mapless_server.networks.runner import NetworkRunner

from .report import Figure
from .subject import GRID, REFERENCES, Scene

CACHED = 100
LIMIT_GB = 8.0


def measure_memory(make_runner: Callable[[], NetworkRunner], device: torch.device) -> Iterator[Figure]:
    """The peak while the network is loaded, warmed up and used, with the tokens of a hundred references on the device.

    What `make_runner` holds before must be nothing: the figures are of the whole process.
    """
    torch.cuda.empty_cache()
    torch.cuda.reset_peak_memory_stats(device)
    runner = make_runner()
    part = f"{runner.name} memory"
    yield Figure(part, "weights and recorded graphs", torch.cuda.memory_allocated(device) / 1e9, "GB")
    scene = Scene(runner.network, REFERENCES + 1, GRID)
    tokens = runner.encode(scene.images[:1], scene.intrinsics[:1] if scene.intrinsics is not None else None)
    kept = [tokens.clone() for _ in range(CACHED)]
    posed = None if scene.posed is None else (torch.arange(REFERENCES + 1) < REFERENCES)[None]
    for _ in range(3):
        query = runner.encode(scene.images[:1], scene.intrinsics[:1] if scene.intrinsics is not None else None)
        runner.reconstruct(torch.cat([*kept[:REFERENCES], query])[None], GRID, REFERENCES, scene.poses, posed)
    torch.cuda.synchronize(device)
    yield Figure(part, f"tokens of {CACHED} references", sum(it.nbytes for it in kept) / 1e9, "GB")
    peak = torch.cuda.max_memory_allocated(device) / 1e9
    yield Figure(part, "peak, of tensors", peak, "GB", target=LIMIT_GB)
    free, total = torch.cuda.mem_get_info(device)
    note = "with the driver's and the allocator's own, and other processes'"
    yield Figure(part, "taken from the device", (total - free) / 1e9, "GB", target=LIMIT_GB, note=note)
    runner.close()
