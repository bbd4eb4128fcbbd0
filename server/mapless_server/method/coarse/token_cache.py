"""Cache of references' tokens, which a network computes from one view alone, so they are the same in every call.

Tokens are kept on the device, and in the host's memory if the device has no room.
"""

import threading
from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

from mapless.geometry import Camera
from mapless_server.bounds import check_bounds
from mapless_server.cache import LruCache

from .grids import Grid


@dataclass(frozen=True)
class TokenKey:
    """Everything that the tokens of a view depend on: computation, encoded photograph and its camera, and picture.

    `camera` is the picture's, which a network that takes intrinsics gets.
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
    """Options of the cache; tokens of one view are 2.1 MB at 518x392 in bfloat16, MapAnything's 3.2; twice in float32.

    Attributes:
        device_bytes: on the device; 1 GiB are 500 views, enough for a scene and little beside the weights.
        host_bytes: in the host's memory, for tokens that have no room on the device. For CUDA it is pinned, in blocks
            whose sizes are powers of two: at 518x392 nearly twice as much is taken.
    """

    device_bytes: int = 2**30
    host_bytes: int = 2 * 2**30

    def __post_init__(self) -> None:
        check_bounds(self, "device_bytes host_bytes", at_least=0)


@dataclass(frozen=True)
class TokenCacheCounters:
    """Events since the cache was created, and its present size."""

    device_hits: int = 0
    host_hits: int = 0
    misses: int = 0
    device_bytes: int = 0
    host_bytes: int = 0
    evictions: int = 0


class TokenCache:
    """Least recently used tokens are moved from the device to the host, and then dropped. Safe to use from threads."""

    def __init__(self, device: torch.device, options: TokenCacheOptions | None = None) -> None:
        options = options or TokenCacheOptions()
        self._device = device
        self._pins = device.type == "cuda"
        self._on_device: LruCache[Tensor] = LruCache(options.device_bytes)
        self._on_host: LruCache[Tensor] = LruCache(options.host_bytes)
        self._host_bytes = options.host_bytes
        self._counts: Counter[str] = Counter()
        self._lock = threading.Lock()

    @property
    def counters(self) -> TokenCacheCounters:
        """Returns a snapshot of the counters."""
        with self._lock:
            return TokenCacheCounters(**self._counts, device_bytes=self._on_device.used, host_bytes=self._on_host.used)

    def get(self, key: TokenKey) -> Tensor | None:
        """Returns the tokens (T, C) on the device, or None if they are not cached; they must not be modified."""
        with self._lock:
            tokens = self._on_device.get(key)
            if tokens is not None:
                self._counts["device_hits"] += 1
                return tokens
            spilled = self._on_host.get(key)
            if spilled is None:
                self._counts["misses"] += 1
                return None
            self._counts["host_hits"] += 1
            tokens = spilled.to(self._device, non_blocking=True)
            self._hold(key, tokens)
            return tokens

    def put(self, key: TokenKey, tokens: Tensor) -> None:
        """Stores a copy of tokens (T, C) on the device; a view of a batch would keep the whole batch in memory."""
        with self._lock:
            self._hold(key, tokens.clone())

    def release_device(self) -> None:
        """Releases the device's memory; tokens are moved to the host as far as there is room."""
        with self._lock:
            for key, tokens in self._on_device.clear():
                self._spill(key, tokens)

    def _hold(self, key: TokenKey, tokens: Tensor) -> None:
        for old_key, old_tokens in self._on_device.put(key, tokens, tokens.nbytes):
            self._spill(old_key, old_tokens)

    def _spill(self, key: TokenKey, tokens: Tensor) -> None:
        dropped = 1
        if self._on_host.get(key) is not None:
            dropped = 0  # tokens that came from the host are still there
        elif tokens.nbytes <= self._host_bytes:
            spilled = torch.empty(tokens.shape, dtype=tokens.dtype, pin_memory=self._pins)
            # Not waited for: it is only read by a copy to the device, which the device does after this one.
            copied = spilled.copy_(tokens, non_blocking=self._pins)
            dropped = len(self._on_host.put(key, copied, copied.nbytes))
        self._counts["evictions"] += dropped
