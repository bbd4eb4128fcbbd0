"""Waiting for what another thread or process does."""

import asyncio
import time
from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

LIMIT_S = 60.0
T = TypeVar("T")


def with_enough_time(call: Callable[[float], T], *late: type[Exception]) -> T:
    """The result of a call with the first of the limits 1, 2, 4, ... seconds within which this machine makes it."""
    for limit_s in (1.0, 2.0, 4.0, 8.0, 16.0):
        with suppress(*late):
            return call(limit_s)
    return call(LIMIT_S)


def wait_until(condition: Callable[[], object]) -> None:
    """Returns when it holds, and fails where it never does."""
    deadline_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline_s, "it did not come about"
        time.sleep(0.005)


async def until(condition: Callable[[], object]) -> None:
    """The same on an event loop, in a task of its own."""

    async def wait() -> None:
        while not condition():
            await asyncio.sleep(0.002)

    await asyncio.wait_for(wait(), LIMIT_S)
