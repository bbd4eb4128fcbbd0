"""The autoscaling policy: the number of replicas follows the devices' queued and used computing time.

Serve's own measure, the number of calls, means little if one takes 20 ms and another a second. A replica's queue has
the predicted and the actual costs of its calls.
"""

import time
from collections.abc import Callable, Iterable
from typing import Protocol

from ray.serve.config import AutoscalingContext

QUEUED, BUSY = "queued_device_seconds", "busy_device_share"
"""Names of a replica's figures: computing that is admitted and not done, seconds; share of time spent computing."""

TARGET_QUEUED_S = 0.5
"""A quarter of what a replica admits by default (`max_queued_s`): callers wait half a second more, and calls that
arrive before new replicas are warm are still admitted."""
TARGET_BUSY = 0.7
"""Above it, queues grow steeply; see docs/results.md, "Load"."""


class Load(Protocol):
    """The load of a replica's queue: seconds per thread, of the busiest lane."""

    @property
    def backlog_s(self) -> float:
        """Computing time of admitted jobs that is not used yet."""

    @property
    def busy_s(self) -> float:
        """Computing time used since the start."""


class Reporter:
    """Makes the policy's figures from a queue's load, once a period."""

    def __init__(self, load: Load, clock: Callable[[], float] = time.monotonic) -> None:
        self._load = load
        self._clock = clock
        self._busy_s, self._read_s = load.busy_s, clock()

    def report(self) -> dict[str, float]:
        """The figures by name; the share is of the time since the last report."""
        busy_s, now_s = self._load.busy_s, self._clock()
        share = (busy_s - self._busy_s) / max(now_s - self._read_s, 1e-9)
        self._busy_s, self._read_s = busy_s, now_s
        return {QUEUED: self._load.backlog_s, BUSY: min(share, 1.0)}


def replicas_for(queued_s: Iterable[float], busy: Iterable[float]) -> float:
    """The number of replicas that meet both targets with an evenly shared load.

    The queued computing time is that of each replica, a new one that has not reported being idle; `busy` its used
    share, 0 to 1.
    """
    return max(sum(queued_s) / TARGET_QUEUED_S, sum(busy) / TARGET_BUSY)


def by_device_seconds(context: AutoscalingContext) -> tuple[float, dict[str, object]]:
    """Serve's autoscaling policy; Serve applies the config's limits and delays."""
    reported = context.aggregated_metrics or {}
    if not reported.get(QUEUED):  # no replica has reported yet
        return context.target_num_replicas, {}
    return replicas_for(reported[QUEUED].values(), reported.get(BUSY, {}).values()), {}
