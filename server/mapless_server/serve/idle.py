"""Idle time: how a server finds it, and the memory that it gives back then."""

import asyncio
import logging
import time
from collections.abc import Sequence

from mapless_server.engine.query import Tier
from mapless_server.method.features.extractors import KeepsMemory
from mapless_server.scheduling import WorkQueue

from .libraries import trim_heap

log = logging.getLogger(__name__)

IDLE_SHARE = 0.05
"""A process that uses less of a core is idle: the event loop's own timers use a hundredth."""
_LOOKS = 50


async def until_idle(queue: WorkQueue, quiet_s: float) -> None:
    """Returns when the queue has computed nothing for so long."""
    busy_s, since_s = queue.busy_s, time.monotonic()
    while time.monotonic() - since_s < quiet_s:
        await asyncio.sleep(quiet_s / _LOOKS)
        if queue.job_count or queue.busy_s > busy_s:
            busy_s, since_s = queue.busy_s, time.monotonic()


async def release_when_idle(tiers: Sequence[Tier], quiet_s: float) -> None:
    """Gives memory that is kept for the next photograph back to the system, each time the process becomes idle.

    That is 140 MB after EdgePoint2 at 640x480, 320 after 1024x768; getting it again takes one query 20 to 40 ms. Work
    in the background counts, too.
    """
    last_s = released_s = 0.0
    while True:
        await asyncio.sleep(quiet_s)
        now_s = time.process_time()
        least_s = IDLE_SHARE * quiet_s
        if now_s - last_s < least_s < now_s - released_s:
            released_s = now_s  # what is computed while memory is released needs it again
            await asyncio.to_thread(release_memory, tiers)
        last_s = now_s


def release_memory(tiers: Sequence[Tier]) -> None:
    """Gives back what extractors and the heap keep and do not use."""
    for tier in tiers:
        if isinstance(tier.extractor, KeepsMemory):
            tier.extractor.release_memory()
    trim_heap()
