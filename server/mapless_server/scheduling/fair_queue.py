"""The order in which waiting jobs are computed: callers take turns, so that none takes the time of the others."""

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

from .jobs import Flow

J = TypeVar("J", bound=Hashable)

MAX_DEBTORS = 100
"""Members of a group without waiting jobs of which it is kept how much they have been served."""


class _Group(Generic[J]):
    """A member of the queue's tree: all, a tenant, a caller, or a client, which has jobs instead of members.

    Attributes:
        served_s: computing time that it has been given, on the scale of its own group: a member that begins to wait
            does not catch up on what others were given before.
        begun_s: the largest `served_s` of a member when it was chosen.
        waiting: its members that have waiting jobs.
        idle: its last members that have none.
        jobs: of a client, with their costs, first in first out.
    """

    __slots__ = ("begun_s", "idle", "jobs", "served_s", "waiting")

    def __init__(self) -> None:
        self.served_s = self.begun_s = 0.0
        self.waiting: OrderedDict[str, _Group[J]] = OrderedDict()
        self.idle: OrderedDict[str, _Group[J]] = OrderedDict()
        self.jobs: OrderedDict[J, float] = OrderedDict()

    def enter(self, name: str) -> "_Group[J]":
        """The member of this name, which now waits."""
        member = self.waiting.get(name)
        if member is None:
            member = self.waiting[name] = self.idle.pop(name, None) or _Group()
            member.served_s = max(member.served_s, self.begun_s)
        return member

    def leave_if_empty(self, name: str) -> None:
        """Moves a member without waiting jobs to the idle ones."""
        member = self.waiting[name]
        if member.jobs or member.waiting:
            return
        self.idle[name] = self.waiting.pop(name)
        if len(self.idle) > MAX_DEBTORS:  # members come and go without end
            self.idle.popitem(last=False)

    def first(self, is_allowed: Callable[[J], bool]) -> J | None:
        """The job whose turn it is among the allowed ones; None if none waits."""
        if self.jobs:
            return next(filter(is_allowed, self.jobs), None)
        for member in sorted(self.waiting.values(), key=_served_s):
            if (job := member.first(is_allowed)) is not None:
                return job
        return None


def _served_s(member: _Group[J]) -> float:
    return member.served_s


class FairQueue(Generic[J]):
    """Waiting jobs in the order in which they are to be computed.

    Start-time fair queueing (Goyal, Vin and Cheng, 1996) on three levels: the next job is that of the tenant which has
    been given the least computing time, of its callers that with the least, and of the caller's clients that with the
    least. A job is charged when it is chosen. So while two members of a group wait, what they are given differs by at
    most one job of each, whatever they send, and under how many names they send it within their own groups. A member
    stays charged while it has no jobs: the next step of a long job waits until others had as much.
    """

    def __init__(self) -> None:
        self._all: _Group[J] = _Group()
        self._flow_of: dict[J, Flow] = {}
        self._cost_s = 0.0

    def __len__(self) -> int:
        return len(self._flow_of)

    def __contains__(self, job: object) -> bool:
        return job in self._flow_of

    def __iter__(self) -> Iterator[J]:
        return iter(self._flow_of)

    @property
    def cost_s(self) -> float:
        """Sum of the costs of all waiting jobs."""
        return self._cost_s if self._flow_of else 0.0  # without rounding errors

    def push(self, job: J, flow: Flow, cost_s: float) -> None:
        """Adds a job behind those of its client."""
        group = self._all
        for name in flow:
            group = group.enter(name)
        group.jobs[job] = cost_s
        self._flow_of[job] = flow
        self._cost_s += cost_s

    def remove(self, job: J) -> float:
        """Removes a job without charging for it; returns its cost."""
        groups, names = self._path(job), self._flow_of.pop(job)
        cost_s = groups[-1].jobs.pop(job)
        self._cost_s -= cost_s
        for group, name in reversed([*zip(groups, names, strict=False)]):
            group.leave_if_empty(name)
        return cost_s

    def pop(self, is_allowed: Callable[[J], bool] = lambda _: True) -> J:
        """Removes the next of the allowed jobs and charges for it; raises IndexError if none waits."""
        job = self._all.first(is_allowed)
        if job is None:
            raise IndexError("nothing waits")
        *groups, client = self._path(job)
        for group, member in zip(groups, [*groups[1:], client], strict=True):
            group.begun_s = max(group.begun_s, member.served_s)
        return self._charge(job)

    def pop_alike(self, is_alike: Callable[[J], bool], at_most: int) -> list[J]:
        """Removes further jobs to compute with the last one, in the order of turns, and charges for them."""
        jobs: list[J] = []
        while len(jobs) < at_most and (job := self._all.first(is_alike)) is not None:
            jobs.append(self._charge(job))
        return jobs

    def _path(self, job: J) -> list[_Group[J]]:
        """The groups that a job belongs to, from all to its client."""
        groups = [self._all]
        for name in self._flow_of[job]:
            groups.append(groups[-1].waiting[name])
        return groups

    def _charge(self, job: J) -> J:
        members = self._path(job)[1:]
        cost_s = self.remove(job)
        for member in members:
            member.served_s += cost_s
        return job
