"""Limits each tenant's computing time by a token bucket of seconds.

Times are arguments. There is no lock here: the work queue calls from many threads with its own lock.
"""

from collections.abc import Callable
from dataclasses import dataclass

_ROUNDING_S = 1e-9
"""Far below any job's cost: after the wait that was returned, rounding must not reject the job again."""

_SWEEP_AT_LEAST = 64
"""Number of buckets from which full ones are removed."""


@dataclass
class _Bucket:
    """The remaining seconds of computing (negative: debt) at a time."""

    level_s: float
    at_s: float


class RateLimiter:
    """Admits jobs of tenants, each tenant at its own rate."""

    def __init__(
        self, rate: float, burst_s: float, rate_of: Callable[[str], float | None] = lambda tenant: None
    ) -> None:
        """A tenant may use `rate` seconds of computing per second, 0 for no limit, and save up `burst_s`, above 0.

        A tenant may have its own rate (`rate_of`), which may change at any time. ValueError if a number is out of its
        range.
        """
        if not rate >= 0:
            raise ValueError(f"rate must be at least 0, is {rate}")
        if not burst_s > 0:
            raise ValueError(f"burst_s must be above 0, is {burst_s}")
        self._rate = rate
        self._burst_s = burst_s
        self._rate_of = rate_of
        # A full bucket is the same as an absent one.
        self._buckets: dict[str, _Bucket] = {}
        self._sweep_at = _SWEEP_AT_LEAST

    def charge(self, tenant: str, cost_s: float, now_s: float) -> float:
        """Admits a job, charges for it and returns 0; otherwise returns the seconds until it would be admitted.

        A job that costs more than the burst is admitted when the bucket is full, and leaves a debt. `cost_s` is the
        predicted computing time, `now_s` the time by any monotonic clock.
        """
        rate = self._rate_for(tenant)
        if rate == 0:
            return 0.0
        level_s = self._level_s(tenant, rate, now_s)
        missing_s = min(cost_s, self._burst_s) - level_s
        if missing_s > _ROUNDING_S:
            return missing_s / rate
        self._keep(tenant, level_s - cost_s, now_s)
        return 0.0

    def settle(self, tenant: str, predicted_s: float, actual_s: float, now_s: float) -> None:
        """Replaces the predicted cost of an admitted job by the actual one."""
        rate = self._rate_for(tenant)
        if rate > 0:
            self._keep(tenant, self._level_s(tenant, rate, now_s) + predicted_s - actual_s, now_s)

    def _rate_for(self, tenant: str) -> float:
        own = self._rate_of(tenant)
        return self._rate if own is None else own

    def _level_s(self, tenant: str, rate: float, now_s: float) -> float:
        bucket = self._buckets.get(tenant)
        if bucket is None:
            return self._burst_s
        return min(self._burst_s, bucket.level_s + rate * max(0.0, now_s - bucket.at_s))

    def _keep(self, tenant: str, level_s: float, now_s: float) -> None:
        if level_s >= self._burst_s:
            self._buckets.pop(tenant, None)
            return
        self._buckets[tenant] = _Bucket(level_s, now_s)
        if len(self._buckets) >= self._sweep_at:
            self._forget_full(now_s)

    def _forget_full(self, now_s: float) -> None:
        """Removes full buckets; runs again at twice the remaining number, so that its cost per job is constant."""
        self._buckets = {
            tenant: bucket
            for tenant, bucket in self._buckets.items()
            if self._level_s(tenant, self._rate_for(tenant), now_s) < self._burst_s
        }
        self._sweep_at = max(_SWEEP_AT_LEAST, 2 * len(self._buckets))
