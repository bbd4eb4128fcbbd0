"""Limits each tenant's computing time by a token bucket of seconds.

Times are arguments. There is no lock here: the work queue calls from many threads with its own lock.
"""

from collections.abc import Callable

_ROUNDING_S = 1e-9
"""Far below any job's cost: after the wait that was returned, rounding must not reject the job again."""

_SWEEP_AT_LEAST = 64
"""Number of buckets from which full ones are removed."""


class _Bucket:
    """Seconds of computing that are left, at most a burst; negative: debt. A new one is full.

    Attributes:
        used_s: time of the last change.
    """

    def __init__(self) -> None:
        self._missing_s = 0.0
        self.used_s = 0.0

    def level_s(self, rate: float, burst_s: float, now_s: float) -> float:
        """Returns the time that is left now, seconds."""
        return burst_s - max(0.0, self._missing_s - rate * max(0.0, now_s - self.used_s))

    def wait_s(self, cost_s: float, rate: float, burst_s: float, now_s: float) -> float:
        """Time until a job of this cost would be admitted; 0 if it is."""
        missing_s = min(cost_s, burst_s) - self.level_s(rate, burst_s, now_s)
        return missing_s / rate if missing_s > _ROUNDING_S else 0.0

    def add(self, seconds: float, rate: float, burst_s: float, now_s: float) -> None:
        """Adds what is left, or takes it if it is negative."""
        self._missing_s = max(0.0, burst_s - self.level_s(rate, burst_s, now_s) - seconds)
        self.used_s = now_s


class _Tenant:
    """The buckets of a tenant, and of its callers that have used some of their part lately."""

    def __init__(self) -> None:
        self.whole = _Bucket()
        self._callers: dict[str, _Bucket] = {}

    def of(self, caller: str) -> _Bucket:
        """The bucket of a caller, which is kept."""
        return self._callers.setdefault(caller, _Bucket())

    def caller_count(self, caller: str, rate: float, burst_s: float, now_s: float) -> int:
        """Number of the callers that have used anything in the time in which a burst is saved up, with this one.

        Forgets the others. One that comes now and then counts all the time, or the others' parts would fill its own.
        """
        since_s = now_s - burst_s / rate
        self._callers = {name: it for name, it in self._callers.items() if it.used_s > since_s}
        return len(self._callers) + (caller not in self._callers)


class RateLimiter:
    """Admits jobs of tenants, each tenant at its own rate, of which each of its tokens in use is sure of an equal part.

    A token that uses less than its part is admitted also when the others have used up the tenant's time; the tenant is
    charged all the same, so that together they keep its rate.
    """

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
        self._tenants: dict[str, _Tenant] = {}
        self._sweep_at = _SWEEP_AT_LEAST

    def charge(self, tenant: str, caller: str, cost_s: float, now_s: float) -> float:
        """Admits a job, charges for it and returns 0; otherwise returns the seconds until it would be admitted.

        A job that costs more than the burst is admitted when the bucket is full, and leaves a debt. `caller` is the
        name of the token, empty without one; `cost_s` is the predicted computing time, `now_s` the time by any
        monotonic clock.
        """
        rate = self._rate_for(tenant)
        if rate == 0:
            return 0.0
        has = self._tenants.setdefault(tenant, _Tenant())
        wait_s = has.whole.wait_s(cost_s, rate, self._burst_s, now_s)
        if caller and wait_s > 0:
            count = has.caller_count(caller, rate, self._burst_s, now_s)
            wait_s = min(wait_s, has.of(caller).wait_s(cost_s, rate / count, self._burst_s / count, now_s))
        if wait_s <= 0:
            self._add(tenant, caller, -cost_s, rate, now_s)
        return max(0.0, wait_s)

    def settle(self, tenant: str, caller: str, predicted_s: float, actual_s: float, now_s: float) -> None:
        """Replaces the predicted cost of an admitted job by the actual one."""
        rate = self._rate_for(tenant)
        if rate > 0:
            self._add(tenant, caller, predicted_s - actual_s, rate, now_s)

    def _add(self, tenant: str, caller: str, seconds: float, rate: float, now_s: float) -> None:
        has = self._tenants.setdefault(tenant, _Tenant())
        has.whole.add(seconds, rate, self._burst_s, now_s)
        if caller:
            count = has.caller_count(caller, rate, self._burst_s, now_s)
            has.of(caller).add(seconds, rate / count, self._burst_s / count, now_s)
        if len(self._tenants) >= self._sweep_at:
            self._forget_full(now_s)

    def _rate_for(self, tenant: str) -> float:
        own = self._rate_of(tenant)
        return self._rate if own is None else own

    def _forget_full(self, now_s: float) -> None:
        """Removes full buckets; runs again at twice the remaining number, so that its cost per job is constant."""
        self._tenants = {
            name: it
            for name, it in self._tenants.items()
            if it.whole.level_s(self._rate_for(name), self._burst_s, now_s) < self._burst_s
        }
        self._sweep_at = max(_SWEEP_AT_LEAST, 2 * len(self._tenants))
