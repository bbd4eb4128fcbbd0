"""The network backend on a GPU: tokens move to the host and memory runs out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("PIL", reason="the networks' extra is not installed")

import torch
from support.small_networks import GRIDS, small_network, small_request

from mapless_server.method.choices import NETWORKS
from mapless_server.method.coarse import Outcome, Request, reconstruct_one
from mapless_server.method.coarse.device import DeviceReconstruction
from mapless_server.method.coarse.network import NetworkOptions, NetworkReconstructor
from mapless_server.method.coarse.token_cache import TokenCacheOptions
from mapless_server.networks.network import NetworkOutput
from mapless_server.networks.runner import NetworkRunner

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]

OPTIONS = NetworkOptions(grids=GRIDS)
UNCACHED = NetworkOptions(grids=GRIDS, cache=TokenCacheOptions(0, 0))


class TightRunner(NetworkRunner):
    """Has room for one scene at a time."""

    def reconstruct(self, tokens: torch.Tensor, *arguments: Any, **named: Any) -> NetworkOutput:
        if len(tokens) > 1:
            torch.empty(2**45, device=self.device)
        return super().reconstruct(tokens, *arguments, **named)


def runner_of(name: str, kind: type[NetworkRunner] = NetworkRunner) -> NetworkRunner:
    return kind(small_network(name), name, "sha", "cuda")


def assert_same_bits(actual: Outcome | Exception, expected: Outcome | Exception) -> None:
    assert isinstance(actual, DeviceReconstruction)
    assert isinstance(expected, DeviceReconstruction)
    for name in ("point_maps", "confidence", "local_from_camera"):
        assert torch.equal(getattr(actual, name), getattr(expected, name)), name


def outcomes_of(backend: NetworkReconstructor, requests: Sequence[Any], times: int) -> list[Outcome]:
    return [reconstruct_one(backend, *request) for _ in range(times) for request in requests]


@pytest.mark.parametrize("name", NETWORKS)
@pytest.mark.parametrize("views_on_device", [0, 2, 100])
def test_cached_tokens_give_the_same_bits(name: str, views_on_device: int) -> None:
    """From the device, from the host, and where views push one another back and forth."""
    runner, requests = runner_of(name), [small_request(3, 1), small_request(4, 2)]
    one_view_bytes = (5 + 20) * 64 * 2
    cache = replace(OPTIONS.cache, device_bytes=views_on_device * one_view_bytes)
    backend = NetworkReconstructor(runner, replace(OPTIONS, cache=cache))
    plain = outcomes_of(NetworkReconstructor(runner, UNCACHED), requests, 1)
    for actual, expected in zip(outcomes_of(backend, requests, 3), plain * 3, strict=True):
        assert_same_bits(actual, expected)
    counters = backend.cache.counters
    assert counters.misses == 7
    assert counters.device_bytes <= views_on_device * one_view_bytes
    assert (counters.host_hits == 0) == (views_on_device == 100)


def test_a_batch_that_does_not_fit_leaves_the_device_as_it_was() -> None:
    """Its tokens are in the host's memory, and each query alone is answered as ever."""
    runner, requests = runner_of("pi3", TightRunner), [small_request(3, i) for i in range(4)]
    backend = NetworkReconstructor(runner, OPTIONS)
    with pytest.raises(torch.OutOfMemoryError):
        backend.reconstruct_many([Request(*request) for request in requests])
    assert backend.cache.counters.device_bytes == 0
    plain = outcomes_of(NetworkReconstructor(runner, UNCACHED), requests, 1)
    for actual, expected in zip(outcomes_of(backend, requests, 1), plain, strict=True):
        assert_same_bits(actual, expected)
    assert backend.cache.counters.host_hits == 12
