"""Shares of the computing time that each tenant, caller and client has been given, and so whose turn it is."""

import itertools
from collections import OrderedDict
from collections.abc import Iterator

from .jobs import Flow

CREDIT_S = 10.0
"""Computing time by which a member that has used less than others may be preferred, when it comes again. Evidence:
queue-credit."""
Turn = tuple[float | int, ...]
"""Sorts clients in the order in which they are served."""
MAX_IDLE = 100
"""Members of a group without jobs of which it is kept what they have been given."""


class _Member:
    """All, a tenant, a caller of it, or a client of that.

    Attributes:
        served_s: computing time that it has been given, on the scale of its own group.
        number: the order in which members of a group got jobs, of those with the same time.
        jobs: number of its jobs.
        least_s: the largest so far of the least `served_s` of its active members.
        equal_s: time that an active member would have been given with equal shares, within what they have been given.
        active: its members that have jobs.
        idle: its last members that have none.
    """

    __slots__ = ("active", "equal_s", "idle", "jobs", "least_s", "number", "served_s")

    def __init__(self) -> None:
        self.served_s = self.least_s = self.equal_s = 0.0
        self.number = self.jobs = 0
        self.active: dict[str, _Member] = {}
        self.idle: OrderedDict[str, _Member] = OrderedDict()

    def begin_s(self, name: str, has_credit: bool = True) -> float:
        """The `served_s` of a member, or that with which it would begin.

        A new one begins with an equal share, so that ever new ones do not keep an old one waiting. One that has had
        less than others is preferred, but not for all the time that it was away, and not at all without credit.
        """
        if (member := self.active.get(name)) is not None:
            return member.served_s
        known = self.idle.get(name)
        return self.equal_s if known is None else max(known.served_s, self.least_s - CREDIT_S * has_credit)

    def enter(self, name: str, number: int, has_credit: bool) -> "_Member":
        """Counts a job of a member."""
        member = self.active.get(name)
        if member is None:
            begin_s = self.begin_s(name, has_credit)
            member = self.active[name] = self.idle.pop(name) if name in self.idle else _Member()
            member.served_s, member.number = begin_s, number
        member.jobs += 1
        return member

    def leave(self, name: str) -> None:
        """Undoes `enter`."""
        member = self.active[name]
        member.jobs -= 1
        if not member.jobs:
            self.idle[name] = self.active.pop(name)
            if len(self.idle) > MAX_IDLE:  # members come and go without end
                self.idle.popitem(last=False)

    def charge(self, name: str, seconds: float) -> "_Member | None":
        """Gives a member computing time, or takes it back; None if nothing is known of it any more."""
        member = self.active.get(name) or self.idle.get(name)
        if member is not None:
            member.served_s += seconds
            if self.active:
                served_s = [it.served_s for it in self.active.values()]
                self.least_s = max(self.least_s, min(served_s))
                self.equal_s = min(max(self.equal_s + seconds / len(served_s), self.least_s), max(served_s))
        return member


class Shares:
    """The order in which those who have jobs are served.

    Start-time fair queueing (Goyal, Vin and Cheng, 1996) on three levels: first comes the tenant that has been given
    the least computing time, of its callers that with the least, and of the caller's clients that with the least. So
    who calls under many names divides the share of the one whose names they are. Time is charged when a step begins, as
    predicted, and corrected when it has ended. Who uses less than its share is served first whenever it comes.
    """

    def __init__(self) -> None:
        self._all = _Member()
        self._numbers = itertools.count()

    def enter(self, flow: Flow, caller_has_credit: bool = True) -> None:
        """Counts a job of a client; its caller, if it was away, may be preferred to others, or not."""
        member, number = self._all, next(self._numbers)
        for name, has_credit in zip(flow, (True, caller_has_credit, True), strict=True):
            member = member.enter(name, number, has_credit)

    def leave(self, flow: Flow) -> None:
        """Undoes `enter`."""
        group = self._all
        for name in flow:
            member = group.active[name]
            group.leave(name)
            group = member

    def charge(self, flow: Flow, seconds: float, tenant_s: float | None = None) -> None:
        """Gives a client computing time, and its tenant as much or `tenant_s`; a negative one is taken back."""
        member = self._all.charge(flow.tenant, seconds if tenant_s is None else tenant_s)
        for name in flow[1:]:
            if member is None:
                return
            member = member.charge(name, seconds)

    def turn(self, flow: Flow) -> Turn:
        """Sorts clients that have jobs in the order in which they are served."""
        return tuple(key for it in self._members(flow) for key in (it.served_s, it.number))

    def given_s(self, flow: Flow) -> tuple[float, float]:
        """Computing time that a client's tenant, and its caller among that tenant's, have been given or begin with.

        Neither needs to have jobs; the caller of an unknown tenant begins with nothing.
        """
        tenant = self._all.active.get(flow.tenant) or self._all.idle.get(flow.tenant)
        return self._all.begin_s(flow.tenant), 0.0 if tenant is None else tenant.begin_s(flow.caller)

    def lead_s(self, flow: Flow, other: Flow) -> float:
        """Computing time by which a client's tenant, caller or client is ahead of another's, at their first difference.

        Neither needs to have jobs.
        """
        group: _Member | None = self._all
        for name, other_name in zip(flow, other, strict=True):
            if name != other_name:
                return 0.0 if group is None else group.begin_s(name) - group.begin_s(other_name)
            group = None if group is None else group.active.get(name) or group.idle.get(name)
        return 0.0

    def _members(self, flow: Flow) -> Iterator[_Member]:
        group = self._all
        for name in flow:
            group = group.active[name]
            yield group
