"""Many queries at a time have the answers they have alone: kept tokens, batches, memory that does not suffice."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import pytest

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("PIL", reason="the networks' extra is not installed")

import torch
from support.grey_network import (
    OPTIONS,
    UNCACHED,
    GreyRunner,
    assert_close,
    assert_same_bits,
    grey_backend,
    grey_request,
    greys_of,
)
from support.small_networks import small_request, small_runner

from mapless.geometry import Camera
from mapless_server.choices import NETWORKS
from mapless_server.method.coarse import Request, reconstruct_one
from mapless_server.method.coarse.grids import Grid
from mapless_server.method.coarse.network import NetworkReconstructor
from mapless_server.method.coarse.token_cache import TokenCache, TokenCacheCounters, TokenCacheOptions, TokenKey

# Kept tokens


@pytest.mark.parametrize("name", NETWORKS)
def test_cached_tokens_give_the_same_bits(name: str) -> None:
    reads: list[str] = []
    query, references = small_request(4, reads=reads)
    runner = small_runner(name)
    backend = NetworkReconstructor(runner, OPTIONS)
    reconstruct_one(backend, query, references[:3])
    reconstruct_one(backend, query, references[2:])
    reads.clear()
    kept = reconstruct_one(backend, query, references)
    assert query.photograph is not None
    assert reads == [query.photograph.sha256]
    assert backend.cache.counters.device_hits == 5
    assert_same_bits(kept, reconstruct_one(NetworkReconstructor(runner, UNCACHED), query, references))
    assert len(reads) == 6


@pytest.mark.parametrize("name", NETWORKS)
def test_tokens_from_the_host_give_the_same_bits(name: str) -> None:
    request = small_request(4)
    runner = small_runner(name)
    backend = NetworkReconstructor(runner, OPTIONS)
    reconstruct_one(backend, *request)
    one_view_bytes = backend.cache.counters.device_bytes // 4
    # On a device of its own memory; here both levels are the host's.
    backend.cache = type(backend.cache)(runner.device, TokenCacheOptions(one_view_bytes, 4 * one_view_bytes))
    first, second = reconstruct_one(backend, *request), reconstruct_one(backend, *request)
    assert backend.cache.counters.host_hits == 3 + 1
    assert_same_bits(first, second)
    assert_same_bits(second, reconstruct_one(NetworkReconstructor(runner, UNCACHED), *request))


def test_another_photograph_of_the_same_name_misses_the_cache() -> None:
    query, references = grey_request(7, 50, 100)
    backend = grey_backend(GreyRunner())
    reconstruct_one(backend, query, references)
    changed = replace(references[1], view=grey_request(200)[0])
    assert greys_of(reconstruct_one(backend, query, [references[0], changed])) == [7, 50, 200]


# Many queries at a time


@pytest.mark.parametrize("name", NETWORKS)
def test_queries_of_a_batch_equal_single_ones(name: str) -> None:
    mixed = [small_request(3, 1), small_request(2, 2), small_request(3, 3), small_request(3, 4, size=(72, 96))]
    _, references = small_request(3)
    common = [(small_request(1, seed)[0], references) for seed in (1, 2, 3, 4)]
    runner = small_runner(name)
    for options, requests in ((OPTIONS, [*mixed, small_request(3, 5)]), (UNCACHED, common)):
        together = NetworkReconstructor(runner, options).reconstruct_many([Request(*request) for request in requests])
        for request, outcome in zip(requests, together, strict=True):
            assert_close(outcome, reconstruct_one(NetworkReconstructor(runner, options), *request))


@pytest.mark.parametrize("cache", [OPTIONS.cache, TokenCacheOptions(0, 0)], ids=["kept", "not kept"])
def test_each_view_of_a_batch_is_encoded_once(cache: TokenCacheOptions) -> None:
    runner = GreyRunner()
    _, references = grey_request(0, 50, 100, 150)
    requests = [Request(grey_request(i)[0], references) for i in (1, 2, 3, 4)]
    outcomes = grey_backend(runner, replace(OPTIONS, cache=cache)).reconstruct_many(requests)
    assert [greys_of(outcome) for outcome in outcomes] == [[i, 50, 100, 150] for i in (1, 2, 3, 4)]
    assert sum(runner.encoded) == 3 + 4
    assert runner.batches == [4]


def test_one_requests_error_does_not_fail_the_others() -> None:
    requests = [grey_request(1, 50), grey_request(2, 60), grey_request(3, 70)]
    query, (reference,) = requests[1]
    requests[1] = (query, (replace(reference, view=replace(reference.view, photograph=None)),))
    outcomes = grey_backend(GreyRunner()).reconstruct_many([Request(*request) for request in requests])
    assert isinstance(outcomes[1], ValueError)
    assert [greys_of(outcomes[i]) for i in (0, 2)] == [[1, 50], [3, 70]]


# Out of memory


def test_out_of_memory_is_retried_after_tokens_are_released() -> None:
    runner = GreyRunner(failing_batches=1)
    backend = grey_backend(runner)
    outcomes = backend.reconstruct_many([Request(*grey_request(i, 50, 100)) for i in range(4)])
    assert [greys_of(outcome) for outcome in outcomes] == [[i, 50, 100] for i in range(4)]
    assert runner.batches == [4, 4]
    assert sum(runner.encoded) == 2 + 4, "the batch's own tokens stay"
    assert backend.cache.counters.device_bytes == 0


def test_a_batch_that_still_does_not_fit_raises() -> None:
    runner = GreyRunner(most_scenes=2)
    with pytest.raises(torch.OutOfMemoryError):
        grey_backend(runner).reconstruct_many([Request(*grey_request(i, 50, 100)) for i in range(4)])
    assert runner.batches == [4, 4]


def test_a_single_query_is_retried_once() -> None:
    runner = GreyRunner(most_scenes=0)
    with pytest.raises(torch.OutOfMemoryError):
        reconstruct_one(grey_backend(runner), *grey_request(1, 50))
    assert runner.batches == [1, 1]


@pytest.mark.parametrize("failing", [1, 2])
@pytest.mark.parametrize("queries", [1, 2])
def test_encoding_is_retried_once(failing: int, queries: int) -> None:
    backend = grey_backend(GreyRunner(failing_encodings=failing))
    requests = [Request(*grey_request(i, 50)) for i in range(queries)]
    if failing == 1:
        assert [greys_of(outcome) for outcome in backend.reconstruct_many(requests)] == [
            [i, 50] for i in range(queries)
        ]
    elif queries == 1:
        assert isinstance(backend.reconstruct_many(requests)[0], torch.OutOfMemoryError)
    else:  # it may be the others that have taken the room
        with pytest.raises(torch.OutOfMemoryError):
            backend.reconstruct_many(requests)


class LostDevice(RuntimeError):
    """As torch raises it when the context is poisoned."""


def test_errors_of_the_device_are_passed_on_unchanged(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whether it is lost while one view is encoded or in the middle of the batch, the error comes out unchanged."""
    lost = LostDevice("CUDA error: an illegal memory access was encountered")

    def fail(*_: Any) -> None:
        raise lost

    runner = GreyRunner()
    backend = grey_backend(runner)
    requests = [Request(*grey_request(i, 50)) for i in (1, 2)]
    with monkeypatch.context() as patch:
        patch.setattr(runner, "reconstruct", fail)
        with pytest.raises(LostDevice) as raised:
            backend.reconstruct_many(requests)
        assert raised.value is lost
    monkeypatch.setattr(runner, "encode", fail)
    assert all(outcome is lost for outcome in grey_backend(runner).reconstruct_many(requests))


# The cache


CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)
KEY = TokenKey("pi3", "weights", torch.float32, "image", CAMERA, Grid(5, 4), CAMERA.resized(70, 56))
SIZE = 4 * 6
"""Bytes of the tokens below."""


def key(image: int) -> TokenKey:
    return replace(KEY, image_sha256=str(image))


def tokens(image: int) -> torch.Tensor:
    return torch.full((3, 2), float(image))


def cache_of(device_count: int, host_count: int) -> TokenCache:
    """A cache with room for so many views; both levels are in the host's memory here."""
    return TokenCache(torch.device("cpu"), TokenCacheOptions(device_count * SIZE, host_count * SIZE))


def assert_holds(cache: TokenCache, at: TokenKey, expected: torch.Tensor) -> None:
    found = cache.get(at)
    assert found is not None
    assert torch.equal(found, expected)


def held(cache: TokenCache, count: int) -> list[int]:
    return [i for i in range(count) if cache.get(key(i)) is not None]


@pytest.mark.parametrize(
    "change",
    [
        {"network": "pi3x"},
        {"weights_sha256": "other weights"},
        {"dtype": torch.bfloat16},
        {"image_sha256": "other image"},
        {"source": replace(CAMERA, focal_x_px=501.0)},
        {"grid": Grid(4, 5)},
        {"camera": CAMERA.resized(56, 70)},
    ],
    ids=lambda change: next(iter(change)),
)
def test_the_key_differs_in_everything_that_tokens_depend_on(change: dict[str, object]) -> None:
    cache = cache_of(4, 0)
    cache.put(KEY, tokens(1))
    assert cache.get(replace(KEY, **change)) is None  # type: ignore[arg-type]
    assert_holds(cache, replace(KEY), tokens(1))


def test_the_least_recently_used_moves_to_the_host_then_out() -> None:
    cache = cache_of(2, 2)
    for i in range(3):
        cache.put(key(i), tokens(i))  # 0 goes to the host
    assert cache.get(key(1)) is not None  # on the device, as 2
    assert cache.counters == TokenCacheCounters(1, 0, 0, 2 * SIZE, SIZE)
    assert_holds(cache, key(0), tokens(0))  # to the device, for 2
    assert cache.counters == TokenCacheCounters(1, 1, 0, 2 * SIZE, 2 * SIZE)
    # On the device 1 and 0, on the host 0 and 2, in the order of use.
    cache.put(key(3), tokens(3))  # 1 goes to the host, for which 0 is forgotten there
    cache.put(key(4), tokens(4))  # 0 goes to the host, for which 2 is forgotten
    assert cache.get(key(2)) is None
    for i in (3, 4, 1):
        assert_holds(cache, key(i), tokens(i))


@pytest.mark.parametrize(
    ("device_count", "host_count", "kept"), [(0, 0, 0), (3, 0, 3), (0, 3, 3), (2, 3, 5), (9, 9, 8)]
)
def test_the_most_recent_views_are_kept_within_the_limit(device_count: int, host_count: int, kept: int) -> None:
    for i in range(8):
        cache = cache_of(device_count, host_count)
        for j in range(8):
            cache.put(key(j), tokens(j))
        counters = cache.counters
        assert counters.device_bytes == min(device_count, 8) * SIZE
        assert counters.device_bytes + counters.host_bytes == kept * SIZE
        if i < 8 - kept:
            assert cache.get(key(i)) is None
        else:
            assert_holds(cache, key(i), tokens(i))


def test_a_view_does_not_keep_its_batch_in_memory() -> None:
    batch = torch.arange(600.0).reshape(100, 3, 2)
    cache = cache_of(4, 0)
    cache.put(key(7), batch[7])
    found = cache.get(key(7))
    assert found is not None
    assert found.untyped_storage().nbytes() == SIZE
    batch.zero_()
    assert torch.equal(found, torch.arange(42.0, 48.0).reshape(3, 2))


def test_tokens_released_from_the_device_stay_on_the_host() -> None:
    cache = cache_of(4, 2)
    for i in range(4):
        cache.put(key(i), tokens(i))
    cache.release_device()
    assert cache.counters == TokenCacheCounters(host_bytes=2 * SIZE, evictions=2)
    assert held(cache, 4) == [2, 3]
    assert cache.counters.host_hits == 2


def test_storing_a_key_again_replaces_its_tokens() -> None:
    cache = cache_of(2, 0)
    cache.put(key(0), tokens(0))
    cache.put(key(0), tokens(5))
    assert_holds(cache, key(0), tokens(5))
    assert cache.counters.device_bytes == SIZE


def test_threads_get_the_tokens_of_their_keys() -> None:
    cache = cache_of(5, 5)
    wrong: list[int] = []

    def work(seed: int) -> None:
        for step in range(400):
            i = (seed * 7 + step * step) % 20
            found = cache.get(key(i))
            if found is None:
                cache.put(key(i), tokens(i))
            elif not torch.equal(found, tokens(i)):
                wrong.append(i)
            if step % 100 == 99:
                cache.release_device()

    threads = [threading.Thread(target=work, args=(seed,)) for seed in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    counters = cache.counters
    assert not wrong
    assert counters.device_hits + counters.host_hits + counters.misses == 1600
    assert max(counters.device_bytes, counters.host_bytes) <= 5 * SIZE
