"""A soak's verdict: planted leaks are found, and neither noise, waves nor a curve that has settled is taken for one."""

import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from bench.load.slopes import MIN_SAMPLES, Slope, slope
from bench.load.soak import FIGURES, MIN_SETTLED_S, SoakOptions, least_minutes, slopes_of
from bench.load.watch import Scrape, ServerState, ServerUnderLoad, read_state
from mapless.geometry import Array

EVERY_S = 10.0
TIMES_S = np.arange(0.0, 2400.0, EVERY_S)
"""Forty minutes, as of an hour are left after its first third."""


def waves(alike: float, spread: float, seed: int) -> Array:
    """Noise in which each sample is like the one before: an autoregressive process of order one."""
    random = np.random.default_rng(seed)
    noise: Array = random.normal(0.0, spread, len(TIMES_S))
    for i in range(1, len(noise)):
        noise[i] = alike * noise[i - 1] + np.sqrt(1 - alike**2) * noise[i]
    return noise


def found(values: np.ndarray) -> Slope:
    return slope(TIMES_S.tolist(), (500 + values).tolist())


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_a_leak_of_a_mebibyte_a_minute_is_found(alike: float) -> None:
    leak = found(TIMES_S / 60 + waves(alike, 3.0, 1))
    assert leak.low < 60 < leak.high
    assert leak.grows
    assert leak.verdict == "grows"


def test_a_descriptor_leaked_every_ten_minutes_is_found() -> None:
    steps = found(np.floor(TIMES_S / 600))
    assert steps.grows
    assert steps.low < 6 < steps.high + 2


@pytest.mark.parametrize("alike", [0.0, 0.9])
def test_of_noise_without_a_slope_nearly_all_is_flat(alike: float) -> None:
    flat = sum(found(waves(alike, 3.0, seed)).is_flat for seed in range(12))
    assert flat >= 11


def test_a_warm_up_is_no_leak_whether_it_was_left_out_or_not() -> None:
    def warmed(since_s: float) -> np.ndarray:
        return 200 * (1 - np.exp(-(TIMES_S + since_s) / 180)) + waves(0.5, 1.0, 2)

    assert found(warmed(1200)).is_flat
    assert not found(warmed(0)).grows


def test_a_third_of_wild_samples_moves_it_little() -> None:
    wild = TIMES_S / 60 + waves(0.0, 1.0, 3)
    wild[::4] += np.random.default_rng(4).choice([-500.0, 500.0], len(wild[::4]))
    assert found(wild).per_hour == pytest.approx(60, abs=6)


def test_a_day_of_samples_is_thinned_and_its_slope_kept() -> None:
    times = np.arange(0.0, 86_400.0, EVERY_S)
    values = 100 + times / 3600 + np.random.default_rng(5).normal(0, 2, len(times))
    day = slope(times.tolist(), values.tolist())
    assert day.low < 1 < day.high
    assert day.grows


@pytest.mark.parametrize("times", [[0.0] * 20, list(range(MIN_SAMPLES - 1)), list(range(20, 0, -1))])
def test_too_few_samples_or_none_in_order_are_refused(times: list[float]) -> None:
    with pytest.raises(ValueError, match="slope needs"):
        slope(times, [1.0] * len(times))


# What is watched


def state(at_s: float, **held: Any) -> ServerState:
    return replace(ServerState(at_s, 500.0, 20, 30, at_s, 400.0, 5e5, 15, 40.0, 0.0, 1.0), **held)


def test_slopes_skip_the_settling_and_need_enough_time() -> None:
    climbing = [state(at, resident_mib=min(500.0, at)) for at in np.arange(0.0, 3600.0, EVERY_S).tolist()]
    slopes = slopes_of(climbing, 1200)
    assert set(slopes) == set(FIGURES)
    assert slopes["resident_mib"].is_flat
    assert slopes_of(climbing, 3600 - MIN_SETTLED_S) == {}


@pytest.mark.parametrize("options", [SoakOptions(), SoakOptions(settle_share=0.0), SoakOptions(sample_every_s=60.0)])
def test_the_minimum_of_minutes_gives_slopes_and_less_none(options: SoakOptions) -> None:
    def looked_at(minutes: float) -> dict[str, Slope]:
        # The first look comes at once, the last before the end.
        times = np.arange(0.0, 60 * minutes, options.sample_every_s).tolist()
        return slopes_of([state(at) for at in times], options.settle_share * 60 * minutes)

    least = least_minutes(options)
    assert set(looked_at(least)) == set(FIGURES)
    assert looked_at(least - 3) == {}


def test_a_process_is_read_with_its_files_sockets_and_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pages = [
        Scrape(0, {}, {}, {}, {"mapless_event_loop_lag_seconds_sum": s, "mapless_event_loop_lag_seconds_count": n})
        for s, n in ((1.0, 100.0), (1.5, 200.0))
    ]
    monkeypatch.setattr("bench.load.watch.read_metrics", lambda _: pages.pop(0))
    (tmp_path / "below").mkdir()
    (tmp_path / "below" / "file").write_bytes(bytes(2**20))
    watched = ServerUnderLoad(os.getpid(), "nowhere", tmp_path)
    first, series = read_state(watched, 0.0, None)
    second, _ = read_state(watched, 1.0, series)
    assert first.data_mib == pytest.approx(1.0, abs=0.1)
    assert 0 < first.unique_mib <= first.resident_mib
    assert first.threads >= 1
    assert first.sockets <= first.descriptors
    assert second.loop_lag_ms == pytest.approx(5.0)
