"""On a GPU everything gives the CPU's results, and runs out of memory without harm."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("kornia", reason="the networks' extra is not installed")

import torch
from safetensors.torch import save_file
from support.images import textured
from support.scenes import random_for
from support.small_networks import (
    PIXEL_LIMIT,
    SMALL_MEGALOC,
    photograph,
    ruled_megaloc,
    small_network,
    small_request,
    view_of,
)

from mapless_server.choices import NETWORKS
from mapless_server.method.coarse import Outcome, Request, reconstruct_one
from mapless_server.method.coarse.network import NetworkOptions, NetworkReconstructor
from mapless_server.method.coarse.token_cache import TokenCacheOptions
from mapless_server.method.features.views import Reconstruction
from mapless_server.networks import blocks
from mapless_server.networks.lightglue import LightGlue
from mapless_server.networks.network import NetworkOutput
from mapless_server.networks.runner import NetworkRunner
from mapless_server.scenes.retrieval.megaloc import MegaLocDescriptor

pytestmark = [pytest.mark.gpu, pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")]


KEYPOINTS, REFERENCES, WIDTH = 300, 4, 128


def match(device: str, dtype: torch.dtype = torch.float32) -> torch.Tensor:
    """Scores of one query with references of different numbers of keypoints, by a random network."""
    torch.manual_seed(0)
    network = LightGlue(WIDTH, layers=3).eval().to(device)
    random = random_for("lightglue cuda")
    position, positions = (random.uniform(-1, 1, (n, KEYPOINTS, 2)) for n in (1, REFERENCES))
    descriptor, descriptors = (random.normal(size=(n, KEYPOINTS, WIDTH)) / np.sqrt(WIDTH) for n in (1, REFERENCES))
    inputs = [torch.from_numpy(array).float().to(device) for array in (position, descriptor, positions, descriptors)]
    counts = torch.tensor([KEYPOINTS, 40, 250, 1], device=device)
    mask = torch.arange(KEYPOINTS, device=device) < counts[:, None]
    with torch.inference_mode(), torch.autocast(device, dtype, enabled=dtype is not torch.float32):
        _, score = network(*inputs, mask)
    assert isinstance(score, torch.Tensor)
    return score.float().cpu()


def test_scores_are_the_cpus() -> None:
    torch.testing.assert_close(match("cuda"), match("cpu"), rtol=0, atol=1e-3)


def test_a_network_running_beside_it_changes_nothing() -> None:
    """The kernels that one of them may take must not decide those of the other."""
    expected = match("cuda", torch.float16)
    runner = NetworkRunner(small_network("pi3"), "pi3", "sha", "cuda")
    images = torch.rand(4, 3, 56, 70)
    failures: list[BaseException] = []

    def repeatedly(work: Callable[[], object]) -> None:
        try:
            for _ in range(50):
                work()
        except BaseException as error:
            failures.append(error)

    def found() -> None:
        torch.testing.assert_close(match("cuda", torch.float16), expected, rtol=0, atol=1e-2)

    work = (found, lambda: runner.reconstruct(runner.encode(images)[None], (4, 5), 3))
    threads = [threading.Thread(target=repeatedly, args=(each,)) for each in work]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    runner.close()
    assert failures == []


VIEWS = [view_of(photograph(textured(80 + 8 * i, 60, seed=i))) for i in range(7)]


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "megaloc.safetensors"
    save_file(ruled_megaloc().state_dict(), path)
    return path


def test_vectors_are_the_cpus_but_for_rounding(file: Path) -> None:
    on_host, on_device = (MegaLocDescriptor(file, device, SMALL_MEGALOC, 24) for device in ("cpu", "cuda"))
    assert (on_host.dtype, on_device.dtype) == (torch.float32, torch.bfloat16)
    assert on_host.name == on_device.name
    expected, found = (np.stack([each.describe(it) for it in VIEWS]) for each in (on_host, on_device))
    assert np.linalg.norm(expected - found, axis=1).max() < 0.1 * np.linalg.norm(expected[0] - expected[1])


def test_without_flash_attention_it_computes_in_full_precision(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: Any) -> Any:
        raise RuntimeError("no such kernel")

    monkeypatch.setattr(blocks, "flash_attention", missing)
    on_host, on_device = (MegaLocDescriptor(file, device, SMALL_MEGALOC, 24) for device in ("cpu", "cuda"))
    assert on_device.dtype == torch.float32
    for it in VIEWS:
        np.testing.assert_allclose(on_device.describe(it), on_host.describe(it), rtol=0, atol=1e-3)


OPTIONS = NetworkOptions(pixel_limit=PIXEL_LIMIT)
UNCACHED = NetworkOptions(pixel_limit=PIXEL_LIMIT, cache=TokenCacheOptions(0, 0))


class TightRunner(NetworkRunner):
    """Has room for one scene at a time."""

    def reconstruct(self, tokens: torch.Tensor, *arguments: Any, **named: Any) -> NetworkOutput:
        if len(tokens) > 1:
            torch.empty(2**45, device=self.device)
        return super().reconstruct(tokens, *arguments, **named)


def runner_of(name: str, kind: type[NetworkRunner] = NetworkRunner) -> NetworkRunner:
    return kind(small_network(name), name, "sha", "cuda")


def assert_same_bits(actual: Outcome | Exception, expected: Outcome | Exception) -> None:
    assert isinstance(actual, Reconstruction)
    assert isinstance(expected, Reconstruction)
    for mine, theirs in zip((*actual.references, actual.query), (*expected.references, expected.query), strict=True):
        np.testing.assert_array_equal(mine.point_map, theirs.point_map)
        np.testing.assert_array_equal(mine.confidence, theirs.confidence)
        np.testing.assert_array_equal(mine.local_from_camera.matrix(), theirs.local_from_camera.matrix())


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
