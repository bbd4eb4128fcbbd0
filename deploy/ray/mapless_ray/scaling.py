"""How many replicas there should be, by the devices' seconds: those that wait, and those that are spent.

Serve's own measure, the number of calls, says little where one takes 20 ms and another a second. The queue of a replica
knows what its calls are predicted to cost, and what they did cost.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable
from typing import Protocol

from ray.serve.config import AutoscalingContext

QUEUED, BUSY = "queued_device_seconds", "busy_device_share"
"""What replicas report: computing that is admitted and not done, seconds; and the share of the time they computed."""

TARGET_QUEUED_S = 0.5
"""A quarter of what a replica admits by default (`max_queued_s`): callers wait half a second more, and there is room
for what arrives before new replicas are warm."""
TARGET_BUSY = 0.7
"""Queues grow steeply beyond; see BENCHMARKS.md, "Under load". Fewer replicas are enough only below it."""


class Load(Protocol):
    """What a replica's queue says of itself; seconds of the lane that has most of them, a thread."""

    @property
    def backlog_s(self) -> float:
        """Computing that is admitted and not done."""

    @property
    def busy_s(self) -> float:
        """Computing that was done since the start."""


class Reporter:
    """Turns a queue's readings into what the policy needs; asked once a period by Serve."""

    def __init__(self, load: Load, clock: Callable[[], float] = time.monotonic) -> None:
        self._load = load
        self._clock = clock
        self._busy_s, self._read_s = load.busy_s, clock()

    def report(self) -> dict[str, float]:
        """The readings by name; the share is of the time since the last report."""
        busy_s, now_s = self._load.busy_s, self._clock()
        share = (busy_s - self._busy_s) / max(now_s - self._read_s, 1e-9)
        self._busy_s, self._read_s = busy_s, now_s
        return {QUEUED: self._load.backlog_s, BUSY: min(share, 1.0)}


def replicas_for(queued_s: Iterable[float], busy: Iterable[float]) -> float:
    """How many replicas would have neither too much waiting nor too little time, sharing what there is evenly.

    Args:
        queued_s: of each replica that has reported; a new one that has not is idle.
        busy: likewise, 0 to 1.
    """
    return max(sum(queued_s) / TARGET_QUEUED_S, sum(busy) / TARGET_BUSY)


def by_device_seconds(context: AutoscalingContext) -> tuple[float, dict[str, object]]:
    """Serve's autoscaling policy; the config's limits and delays are applied to it by Serve."""
    reported = context.aggregated_metrics or {}
    if not reported.get(QUEUED):  # nobody has reported yet
        return context.target_num_replicas, {}
    return replicas_for(reported[QUEUED].values(), reported.get(BUSY, {}).values()), {}
