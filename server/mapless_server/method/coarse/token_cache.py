"""Tokens of references, kept: what a network computes of one view alone is the same in every call.

They lie on the device as long as there is room, and then in the host's memory. The key says everything that they depend
on, so an entry is never wrong, only forgotten.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from mapless.geometry import Camera

from ..options import check_bounds
from .grids import Grid


@dataclass(frozen=True)
class TokenKey:
    """What the tokens of a view depend on.

    Attributes:
        network, weights_sha256, dtype: what computed them.
        image_sha256: of the encoded photograph.
        source: the photograph's camera; how it is undistorted follows from it.
        grid: size of the picture.
        camera: of the picture; a conditioned network takes it.
    """

    network: str
    weights_sha256: str
    dtype: torch.dtype
    image_sha256: str
    source: Camera
    grid: Grid
    camera: Camera


@dataclass(frozen=True)
class TokenCacheOptions:
    """Options of the cache; tokens of one view are 2.1 MB at 518x392 in bfloat16, twice that in float32.

    Attributes:
        device_bytes: on the device; 1 GiB are 500 views in bfloat16, enough for a scene and little beside the weights.
        host_bytes: in the host's memory, for what has no room on the device: another 1000 views. Copying one to the
            device moves 2.1 MB; computing it takes 0.8 TFLOP. For CUDA it is pinned, which comes in powers of two: at
            518x392 nearly twice as much is taken.
    """

    device_bytes: int = 2**30
    host_bytes: int = 2 * 2**30

    def __post_init__(self) -> None:
        check_bounds(self, "device_bytes host_bytes", at_least=0)


@dataclass(frozen=True)
class TokenCacheCounters:
    """What the cache did since it was made, and what it holds."""

    device_hits: int = 0
    host_hits: int = 0
    misses: int = 0
    device_bytes: int = 0
    host_bytes: int = 0
    evictions: int = 0


class TokenCache:
    """Least recently used tokens go from the device to the host, and from there away. Safe to use from threads."""

    def __init__(self, device: torch.device, options: TokenCacheOptions | None = None) -> None:
        options = options or TokenCacheOptions()
        self._device = device
        self._pins = device.type == "cuda"
        self._on_device = _Level(options.device_bytes)
        self._on_host = _Level(options.host_bytes)
        self._counters = TokenCacheCounters()
        self._lock = threading.Lock()

    @property
    def counters(self) -> TokenCacheCounters:
        """A moment's."""
        with self._lock:
            return replace(self._counters, device_bytes=self._on_device.used_bytes, host_bytes=self._on_host.used_bytes)

    def get(self, key: TokenKey) -> Tensor | None:
        """The tokens (T, C) on the device, or None; not to be written to."""
        with self._lock:
            tokens = self._on_device.get(key)
            if tokens is not None:
                self._counters = replace(self._counters, device_hits=self._counters.device_hits + 1)
                return tokens
            spilled = self._on_host.get(key)
            if spilled is None:
                self._counters = replace(self._counters, misses=self._counters.misses + 1)
                return None
            self._counters = replace(self._counters, host_hits=self._counters.host_hits + 1)
            tokens = spilled.to(self._device, non_blocking=True)
            self._hold(key, tokens)
            return tokens

    def put(self, key: TokenKey, tokens: Tensor) -> None:
        """Holds a copy of tokens (T, C) on the device: a part of a batch would keep the whole of it."""
        with self._lock:
            self._hold(key, tokens.clone())

    def release_device(self) -> None:
        """Leaves the device's memory to others; what has room in the host's stays at hand."""
        with self._lock:
            for key, tokens in self._on_device.clear():
                self._spill(key, tokens)

    def _hold(self, key: TokenKey, tokens: Tensor) -> None:
        for old_key, old_tokens in self._on_device.put(key, tokens):
            self._spill(old_key, old_tokens)

    def _spill(self, key: TokenKey, tokens: Tensor) -> None:
        forgotten = 1
        if self._on_host.get(key) is not None:
            forgotten = 0  # what came from the host has stayed there
        elif self._on_host.takes(tokens):
            spilled = torch.empty(tokens.shape, dtype=tokens.dtype, pin_memory=self._pins)
            # It is only ever read by a copy to the device, which queues up behind this one.
            forgotten = len(self._on_host.put(key, spilled.copy_(tokens, non_blocking=self._pins)))
        self._counters = replace(self._counters, evictions=self._counters.evictions + forgotten)


class _Level:
    """Tensors of at most `capacity_bytes` together, the least recently used ones pushed out."""

    def __init__(self, capacity_bytes: int) -> None:
        self.used_bytes = 0
        self._capacity_bytes = capacity_bytes
        self._entries: OrderedDict[TokenKey, Tensor] = OrderedDict()

    def takes(self, tokens: Tensor) -> bool:
        """Whether there is room when all else is pushed out."""
        return tokens.nbytes <= self._capacity_bytes

    def get(self, key: TokenKey) -> Tensor | None:
        if key not in self._entries:
            return None
        self._entries.move_to_end(key)
        return self._entries[key]

    def put(self, key: TokenKey, tokens: Tensor) -> list[tuple[TokenKey, Tensor]]:
        """Holds tokens; returns what had to go for them, be it they themselves."""
        if not self.takes(tokens):
            return [(key, tokens)]
        replaced = self._entries.pop(key, None)
        self.used_bytes += tokens.nbytes - (replaced.nbytes if replaced is not None else 0)
        self._entries[key] = tokens
        gone = []
        while self.used_bytes > self._capacity_bytes:
            gone.append(self._entries.popitem(last=False))
            self.used_bytes -= gone[-1][1].nbytes
        return gone

    def clear(self) -> list[tuple[TokenKey, Tensor]]:
        """Everything, the least recently used first."""
        gone = list(self._entries.items())
        self._entries.clear()
        self.used_bytes = 0
        return gone
