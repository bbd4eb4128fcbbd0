"""How much computing each tenant may use: a bucket of seconds that fills at a steady rate and is drawn from by jobs.

Time is passed in. Nothing is locked here: calls come from many threads, one at a time, with the work queue locked.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

_ROUNDING_S = 1e-9
"""Far below any job's cost: who waited as long as told is not refused again by a last digit."""

_SWEEP_AT_LEAST = 64
"""Buckets that are held before full ones are looked for."""


@dataclass
class _Bucket:
    """What is left, seconds of computing (below 0: debt), at a moment."""

    level_s: float
    at_s: float


class RateLimiter:
    """Admits jobs of tenants, each at its own rate."""

    def __init__(
        self, rate: float, burst_s: float, rate_of: Callable[[str], float | None] = lambda tenant: None
    ) -> None:
        """A tenant may use `rate` seconds of computing a second and save up `burst_s`.

        Args:
            rate: 0 for no limit.
            burst_s: what a tenant has that did nothing for long; above 0.
            rate_of: a tenant's own rate, or None; it may change at any time.

        Raises:
            ValueError: a number out of its range.
        """
        if not (rate >= 0 and burst_s > 0):
            raise ValueError(f"senseless limits: {rate} seconds a second, at most {burst_s}")
        self._rate = rate
        self._burst_s = burst_s
        self._rate_of = rate_of
        # A full bucket says nothing that an absent one does not.
        self._buckets: dict[str, _Bucket] = {}
        self._sweep_at = _SWEEP_AT_LEAST

    def charge(self, tenant: str, cost_s: float, now_s: float) -> float:
        """Admits a job and charges for it, or says how long to wait before it would be, seconds; 0: admitted.

        A job that costs more than the burst is admitted when the bucket is full, and leaves a debt: else it never
        would be.

        Args:
            tenant: whose job.
            cost_s: what it is predicted to take, seconds of computing.
            now_s: the time, by any clock that does not go back.
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
        """Corrects the charge for an admitted job by what it took; 0 for one that took nothing."""
        rate = self._rate_for(tenant)
        if rate > 0:
            self._keep(tenant, self._level_s(tenant, rate, now_s) + predicted_s - actual_s, now_s)

    @property
    def bucket_count(self) -> int:
        """Tenants that are remembered."""
        return len(self._buckets)

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
        """Next time at twice as many as remain, so that sweeping costs a constant a job."""
        self._buckets = {
            tenant: bucket
            for tenant, bucket in self._buckets.items()
            if self._level_s(tenant, self._rate_for(tenant), now_s) < self._burst_s
        }
        self._sweep_at = max(_SWEEP_AT_LEAST, 2 * len(self._buckets))
