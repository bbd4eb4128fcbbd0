"""The token cache: returns what was stored, and stays within its bounds."""

import threading
from dataclasses import replace

import pytest

pytest.importorskip("torch", reason="the networks' extra is not installed")
pytest.importorskip("PIL", reason="the networks' extra is not installed")

import torch

from mapless.geometry import Camera
from mapless_server.method.coarse.grids import Grid
from mapless_server.method.coarse.token_cache import TokenCache, TokenCacheCounters, TokenCacheOptions, TokenKey

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
