"""Waiting for what another thread or process does."""

import asyncio
import time
from collections.abc import Callable

LIMIT_S = 60.0


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
