"""A tenant uses its rate and what it saved, and at most one job beyond; no tenant waits for ever; memory is bounded."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapless_server.security import RateLimiter

rates = st.floats(0.01, 8)
bursts = st.floats(0.1, 30)
jobs = st.lists(st.tuples(st.floats(0, 5), st.floats(0, 60)), min_size=1, max_size=60)
"""(time since the one before, cost), seconds."""


@given(rate=rates, burst_s=bursts, jobs=jobs)
def test_any_window_admits_rate_and_burst_and_one_job_more(
    rate: float, burst_s: float, jobs: list[tuple[float, float]]
) -> None:
    limiter = RateLimiter(rate, burst_s)
    now_s = 1000.0
    admitted: list[tuple[float, float]] = []
    for pause_s, cost_s in jobs:
        now_s += pause_s
        if limiter.charge("t", "", cost_s, now_s) == 0:
            admitted.append((now_s, cost_s))
    for first in range(len(admitted)):
        total_s = largest_s = 0.0
        for at_s, cost_s in admitted[first:]:
            total_s += cost_s
            largest_s = max(largest_s, cost_s)
            assert total_s <= rate * (at_s - admitted[first][0]) + burst_s + largest_s + 1e-6


@given(rate=rates, burst_s=bursts, jobs=jobs)
def test_the_returned_wait_is_enough_and_necessary(
    rate: float, burst_s: float, jobs: list[tuple[float, float]]
) -> None:
    limiter = RateLimiter(rate, burst_s)
    now_s = 0.0
    for pause_s, cost_s in jobs:
        now_s += pause_s
        wait_s = limiter.charge("t", "", cost_s, now_s)
        if wait_s > 0:
            assert limiter.charge("t", "", cost_s, now_s + 0.9 * wait_s) > 0 or wait_s < 1e-6
            now_s += wait_s
            assert limiter.charge("t", "", cost_s, now_s) == pytest.approx(0, abs=1e-6)  # rounding


def test_a_job_above_the_burst_waits_and_leaves_a_debt() -> None:
    limiter = RateLimiter(0.5, 2.0)
    assert limiter.charge("t", "", 12.0, 0.0) == 0
    assert limiter.charge("t", "", 1.0, 0.0) == pytest.approx(22.0)  # 10 s of debt and 1 s, at half a second a second
    assert limiter.charge("t", "", 12.0, 4.0) == pytest.approx(20.0)
    assert limiter.charge("t", "", 12.0, 24.0) == 0


@given(predicted_s=st.floats(0, 10), actual_s=st.floats(0, 10), later_s=st.floats(0, 3))
def test_settling_equals_charging_the_actual_cost(predicted_s: float, actual_s: float, later_s: float) -> None:
    # The first job keeps both buckets from being full, where what comes on top is lost.
    settled, charged = RateLimiter(1.0, 20.0), RateLimiter(1.0, 20.0)
    for limiter, cost_s in ((settled, predicted_s), (charged, actual_s)):
        assert limiter.charge("t", "", 5.0, 0.0) == 0
        assert limiter.charge("t", "", cost_s, 0.0) == 0
    settled.settle("t", "", predicted_s, actual_s, later_s)
    assert settled.charge("t", "", 20.0, later_s) == pytest.approx(charged.charge("t", "", 20.0, later_s))


def test_a_refund_never_saves_up_more_than_the_burst() -> None:
    limiter = RateLimiter(1.0, 2.0)
    assert limiter.charge("t", "", 2.0, 0.0) == 0
    limiter.settle("t", "", 100.0, 0.0, 0.0)
    assert limiter.charge("t", "", 2.0, 0.0) == 0
    assert limiter.charge("t", "", 1.0, 0.0) == pytest.approx(1.0)


def test_tenants_have_separate_buckets_and_rates() -> None:
    rates = {"slow": 0.1, "free": 0.0}
    limiter = RateLimiter(1.0, 1.0, rates.get)
    for tenant in ("slow", "usual"):
        assert limiter.charge(tenant, "", 1.0, 0.0) == 0
    assert limiter.charge("slow", "", 1.0, 0.0) == pytest.approx(10.0)
    assert limiter.charge("usual", "", 1.0, 0.0) == pytest.approx(1.0)
    assert all(limiter.charge("free", "", 1e6, 0.0) == 0 for _ in range(10))
    rates["slow"] = 10.0
    assert limiter.charge("slow", "", 1.0, 0.0) == pytest.approx(0.1)


def test_no_rate_is_no_limit() -> None:
    limiter = RateLimiter(0.0, 1.0)
    assert all(limiter.charge("t", "", 1e6, 0.0) == 0 for _ in range(10))
    limiter.settle("t", "", 1.0, 2.0, 0.0)
    assert len(limiter._tenants) == 0


def test_full_buckets_are_removed() -> None:
    limiter = RateLimiter(1.0, 1.0)
    for i in range(100_000):
        assert limiter.charge(f"t{i}", "", 0.5, 0.1 * i) == 0
        assert len(limiter._tenants) <= 64


def test_a_clock_that_goes_back_changes_no_level() -> None:
    limiter = RateLimiter(1.0, 2.0)
    assert limiter.charge("t", "", 2.0, 100.0) == 0
    assert limiter.charge("t", "", 1.0, 50.0) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("rate", "burst_s", "named"),
    [(-1.0, 1.0, "rate"), (1.0, 0.0, "burst_s"), (np.nan, 1.0, "rate"), (1.0, np.nan, "burst_s")],
)
def test_a_wrong_limit_is_rejected_by_name(rate: float, burst_s: float, named: str) -> None:
    with pytest.raises(ValueError, match=f"^{named} must be"):
        RateLimiter(rate, burst_s)


@given(quiet_s=st.floats(0.01, 0.3), count=st.integers(1, 5))
def test_a_token_gets_its_part_beside_one_that_asks_for_all(quiet_s: float, count: int) -> None:
    """One tenant's rate is kept: what the quiet ones use, the other one does not get."""
    limiter, quiet_got_s, refused, all_s = RateLimiter(1.0, 10.0), 0.0, 0, 0.0
    for i in range(2000):
        now_s = 0.1 * i
        while limiter.charge("t", "greedy", 0.5, now_s) == 0:
            all_s += 0.5
        for caller in map(str, range(count) if i % 10 == 0 else ()):
            cost_s = quiet_s / count  # together less than half of the rate
            if limiter.charge("t", caller, cost_s, now_s) == 0:
                quiet_got_s, all_s = quiet_got_s + cost_s, all_s + cost_s
            else:
                refused += 1
    assert refused == 0
    assert quiet_got_s == pytest.approx(200 * quiet_s)
    assert all_s <= 1.0 * 200 + 2 * 10.0 + 0.5 * (count + 1)


def test_new_ids_without_a_token_get_no_part_of_their_own() -> None:
    limiter = RateLimiter(1.0, 2.0)
    assert limiter.charge("t", "", 2.0, 0.0) == 0
    assert limiter.charge("t", "", 1.0, 0.0) == pytest.approx(1.0)
    assert limiter.charge("t", "token", 1.0, 0.0) == 0
