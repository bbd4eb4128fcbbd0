"""A blocked event loop is measured, and a dead scheduler does not pass for one that is alive."""

import asyncio
import logging
import time

import pytest

from mapless_server.observability.event_loop import TICK_S, watch_event_loop
from mapless_server.observability.metrics import Metrics


class Heard(Metrics):
    def __init__(self) -> None:
        super().__init__()
        self.lags_s: list[float] = []
        self.beats = 0

    def loop_lagged(self, seconds: float) -> None:
        self.lags_s.append(seconds)

    def beat(self) -> None:
        self.beats += 1


async def test_a_blocked_loop_is_measured_and_logged(
    caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("mapless_server.observability.event_loop.WARN_S", 0.1)
    heard = Heard()
    caplog.set_level(logging.WARNING)
    watching = asyncio.create_task(watch_event_loop(heard))
    while not heard.lags_s:
        await asyncio.sleep(0.001)
    time.sleep(0.3)
    count = len(heard.lags_s)
    while len(heard.lags_s) == count:
        await asyncio.sleep(0.001)
    watching.cancel()
    with pytest.raises(asyncio.CancelledError):
        await watching
    assert max(heard.lags_s) >= 0.29 - TICK_S
    assert min(heard.lags_s) >= 0
    assert heard.beats == len(heard.lags_s)
    record = next(r for r in caplog.records if r.getMessage() == "the event loop was blocked")
    assert vars(record)["lag_ms"] >= 1000 * (0.29 - TICK_S)


async def test_a_dead_scheduler_does_not_beat() -> None:
    heard = Heard()
    watching = asyncio.create_task(watch_event_loop(heard, is_alive=lambda: len(heard.lags_s) <= 2))
    while len(heard.lags_s) < 5:
        await asyncio.sleep(0.001)
    watching.cancel()
    assert heard.beats == 2
