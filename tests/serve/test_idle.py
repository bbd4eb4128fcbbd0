"""An idle server gives memory back; one that computes keeps it."""

import asyncio
import time
from typing import Any, cast

import pytest
from support.servers import StandInExtractor, StandInReconstructor

from mapless_server.engine.query import Tier
from mapless_server.method.pipeline import Pipeline
from mapless_server.serve.idle import IDLE_SHARE, release_when_idle

LIMIT_S = 30.0


class Keeper(StandInExtractor):
    """Counts how often it gave its memory back."""

    released = 0

    def release_memory(self) -> None:
        self.released += 1


@pytest.fixture
def used_s(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """Processor time that the process has used, as the server sees it."""
    used = [10.0]
    monkeypatch.setattr("time.process_time", lambda: used[0])
    return used


async def until(condition: Any) -> None:
    end_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < end_s
        await asyncio.sleep(0.01)


async def test_memory_is_given_back_once_after_each_work(used_s: list[float]) -> None:
    keeper, quiet_s = Keeper(), 0.02
    tier = Tier(keeper, Pipeline(cast(Any, StandInReconstructor())))
    task = asyncio.ensure_future(release_when_idle([tier], quiet_s))
    try:
        await until(lambda: keeper.released == 1)
        await asyncio.sleep(5 * quiet_s)
        assert keeper.released == 1
        used_s[0] += IDLE_SHARE * LIMIT_S  # so much that it counts however late the task looks
        await until(lambda: keeper.released == 2)
    finally:
        task.cancel()
