"""Threads that give way: how long they pause, on a clock of the test's own."""

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

from mapless_server.scheduling import processor
from mapless_server.scheduling.processor import LONGEST_PAUSE_S, SHARE_BESIDE_OTHERS, give_way, lower_priority


class Clock:
    """Time, and processor time of the one thread that computes."""

    def __init__(self) -> None:
        self.now_s = self.spent_s = 0.0

    def compute(self, seconds: float) -> None:
        self.now_s += seconds
        self.spent_s += seconds

    def sleep(self, seconds: float) -> None:
        self.now_s += seconds


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> Clock:
    it = Clock()
    times = SimpleNamespace(monotonic=lambda: it.now_s, thread_time=lambda: it.spent_s, sleep=it.sleep)
    monkeypatch.setattr(processor, "time", times)
    return it


def pauses_s(
    clock: Clock,
    steps_s: list[float],
    others_compute: Callable[[], bool] | None,
    longest_s: float = LONGEST_PAUSE_S,
) -> list[float]:
    """The pause after each step of a thread, of low priority unless it is None."""

    def computed() -> list[float]:
        if others_compute is not None:
            lower_priority(others_compute)
        found = []
        for step_s in steps_s:
            clock.compute(step_s)
            begin_s = clock.now_s
            give_way(longest_s)
            found.append(clock.now_s - begin_s)
        return found

    with ThreadPoolExecutor(1) as thread:
        return thread.submit(computed).result()


def test_beside_others_a_thread_takes_its_share_of_a_core(clock: Clock) -> None:
    pauses_s(clock, [0.02, 0.01, 0.03] * 10, lambda: True)
    assert clock.spent_s / clock.now_s == pytest.approx(SHARE_BESIDE_OTHERS, rel=0.1)


def test_a_long_pause_is_made_in_parts(clock: Clock) -> None:
    """The thread may hold a lock."""
    pauses = pauses_s(clock, [0.1, 0.0, 0.0], lambda: True)
    assert pauses == pytest.approx([LONGEST_PAUSE_S, 0.9 - LONGEST_PAUSE_S, 0.0], abs=0.011)


def test_between_steps_the_whole_pause_is_made(clock: Clock) -> None:
    assert pauses_s(clock, [1.0, 0.0], lambda: True, math.inf) == pytest.approx([9.0, 0.0], abs=0.011)


def test_a_pause_ends_when_no_others_compute_any_more(clock: Clock) -> None:
    assert pauses_s(clock, [0.1, 0.0], lambda: clock.now_s < 0.3) == pytest.approx([0.2, 0.0], abs=0.011)


@pytest.mark.parametrize("others_compute", [None, lambda: False])
def test_threads_do_not_pause_otherwise(clock: Clock, others_compute: Callable[[], bool] | None) -> None:
    assert pauses_s(clock, [1.0, 1.0], others_compute) == [0.0, 0.0]
