"""The queue's promise to who computes: no step begins that nobody waits for."""

from __future__ import annotations

import asyncio
import threading
import time

import pytest

from mapless_server.errors import DeadlineExceeded, Overloaded
from mapless_server.turns import Turn, Turns


def test_a_turn_is_over_at_its_deadline_or_when_abandoned() -> None:
    Turn(time.monotonic() + 60).check()
    with pytest.raises(DeadlineExceeded):
        Turn(time.monotonic() - 1e-3).check()
    turn = Turn(time.monotonic() + 60)
    turn.abandon()
    with pytest.raises(DeadlineExceeded), turn.stage("never begins"):
        raise AssertionError
    assert turn.stage_seconds == {}


def test_a_stage_that_is_done_twice_counts_twice() -> None:
    turn = Turn(time.monotonic() + 60)
    for _ in range(2):
        with turn.stage("sleep"):
            time.sleep(0.01)
    assert turn.stage_seconds["sleep"] >= 0.02


def test_as_many_are_admitted_as_compute_and_may_wait() -> None:
    async def run() -> None:
        turns = Turns(workers=1, max_waiting=1)
        with turns.place(), turns.place():
            assert turns.admitted_count == 2
            with pytest.raises(Overloaded) as caught, turns.place():
                raise AssertionError
            assert caught.value.retry_after_s is not None
        assert turns.admitted_count == 0
        assert await turns.run(lambda turn: threading.current_thread().name, time.monotonic() + 60) == "engine_0"
        turns.close()

    asyncio.run(run())
