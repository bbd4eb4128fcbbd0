"""Whether the event loop keeps up."""

import asyncio
import logging
import time
from collections.abc import Callable

from .metrics import Metrics

log = logging.getLogger(__name__)

TICK_S = 0.05
"""The timer's period, by which a lag may be underestimated; waking up five times as often costs 1 to 2 % of a core."""
WARN_S = 1.0
"""Less is usual where other processes take the processors; the metric has all."""


async def watch_event_loop(metrics: Metrics, is_alive: Callable[[], bool] = lambda: True) -> None:
    """Measures until it is cancelled, and calls `beat` as long as the scheduler is alive."""
    while True:
        due_s = time.monotonic() + TICK_S
        await asyncio.sleep(TICK_S)
        lag_s = max(0.0, time.monotonic() - due_s)
        metrics.loop_lagged(lag_s)
        if lag_s > WARN_S:
            log.warning("the event loop was blocked", extra={"lag_ms": round(1000 * lag_s)})
        if is_alive():
            metrics.beat()
