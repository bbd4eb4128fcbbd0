"""Callers that are likely to need a thread soon, by the jobs that came last, and so would wait for a long step."""

import math
from collections.abc import Iterable

from .jobs import Flow
from .shares import Shares

LATELY_S = 1.0
"""While others that have been given less have asked within this time, a caller's long steps leave them one thread.
Evidence: queue-lately."""
SHORTER = 1.25
"""So many times less such a job must take: of callers whose steps take about as long, none leaves a thread idle.
Evidence: queue-shorter."""
MUCH_SHORTER = 4
"""A job that takes so many times less than the steps of others does not wait for them, if a lane has two threads."""


class Expected:
    """Expected jobs of a lane at one moment. Each answer takes microseconds, however many have come and wait."""

    def __init__(self, arrivals: Iterable[tuple[Flow, float, float]], shares: Shares, now_s: float) -> None:
        """`arrivals` are jobs that have come to wait: owner, predicted time with later stages, time of arrival."""
        self._shares = shares
        long_from_s: dict[tuple[str, str], float] = {}
        lately = dict[tuple[str, str], float]()
        for flow, its_s, came_s in arrivals:  # without `min` and `max`, which take most of the time here
            ago_s, from_s, group = now_s - came_s, MUCH_SHORTER * its_s, flow[:2]
            if ago_s > from_s:
                from_s = ago_s
            known_s = long_from_s.get(group)
            if known_s is None or from_s < known_s:
                long_from_s[group] = from_s
            if ago_s <= LATELY_S:
                lately[group] = min(its_s, lately.get(group, math.inf))
        # That of a caller itself does not count, so two are enough.
        self._long_from_s = sorted((it, group) for group, it in long_from_s.items())[:2]
        self._lately = [(its_s, group, shares.given_s(Flow(*group))) for group, its_s in lately.items()]

    def shorter(self, flow: Flow, seconds: float) -> bool:
        """Whether much shorter jobs are likely to come while a caller's step of this time is computed.

        They are if one of another caller has come within as long a time.
        """
        return any(it <= seconds and group != flow.group for it, group in self._long_from_s)

    def first(self, flow: Flow, seconds: float) -> bool:
        """Whether one who comes before a caller is likely to need a thread soon for less time than its step takes.

        It is if it has asked lately.
        """
        tenant_s, caller_s = self._shares.given_s(flow)
        return any(
            SHORTER * its_s <= seconds
            and (given_s[0] < tenant_s or (group[0] == flow.tenant and given_s[1] < caller_s))
            for its_s, group, given_s in self._lately
        )
