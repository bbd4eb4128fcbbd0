"""The jobs that wait for a stage, in the order in which they are to be computed."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Hashable, Iterator
from typing import Generic, TypeVar

from .failing import FAILING
from .jobs import Flow
from .shares import Shares, Turn

J = TypeVar("J", bound=Hashable)


class FairQueue(Generic[J]):
    """Waiting jobs, of each client first in, first out; whose turn it is among clients is that of `Shares`.

    A job is charged when it is chosen. So while two members of a group wait, what they are given differs by at most one
    job of each, whatever they send.
    """

    def __init__(self, shares: Shares) -> None:
        """Orders by these shares, which know of the waiting jobs."""
        self._shares = shares
        self._jobs: dict[Flow, OrderedDict[J, float]] = {}
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

    def turn(self, is_allowed: Callable[[J], bool]) -> Turn | None:
        """The turn of the client whose job is computed next, of the allowed jobs; None if none waits."""
        flows = (flow for flow, jobs in self._jobs.items() if any(map(is_allowed, jobs)))
        return min(map(self._shares.turn, flows), default=None)

    def push(self, job: J, flow: Flow, cost_s: float) -> None:
        """Adds a job behind those of its client."""
        self._jobs.setdefault(flow, OrderedDict())[job] = cost_s
        self._flow_of[job] = flow
        self._cost_s += cost_s

    def remove(self, job: J) -> float:
        """Removes a job; returns its cost."""
        flow = self._flow_of.pop(job)
        cost_s = self._jobs[flow].pop(job)
        if not self._jobs[flow]:
            del self._jobs[flow]
        self._cost_s -= cost_s
        return cost_s

    def pop(self, charge: Callable[[J], object], is_allowed: Callable[[J], bool] = lambda _: True) -> J:
        """Removes the next of the allowed jobs, and charges it; raises IndexError if none waits."""
        first = {flow: next(filter(is_allowed, jobs), None) for flow, jobs in self._jobs.items()}
        waiting = [flow for flow, job in first.items() if job is not None]
        if not waiting:
            raise IndexError("nothing waits")
        flow = min(waiting, key=self._shares.turn)
        job = first[flow]
        assert job is not None
        self.remove(job)
        charge(job)
        return job


FURTHER = "further steps\n"
"""The caller that all further steps of a tenant are; no caller can send a name with a line break."""


class FurtherQueue(FairQueue[J]):
    """Waiting jobs whose further steps were not admitted: together they get the share of one more caller.

    However many callers there are whose photographs are tried again and again, they take no more from the others than
    one more caller would, without credit for time in which there were none.
    Among the further steps those of each caller get an equal share.
    """

    def push(self, job: J, flow: Flow, cost_s: float) -> None:
        """Adds a job behind those of its caller."""
        flow = further(flow)
        self._shares.enter(flow, caller_has_credit=False)
        super().push(job, flow, cost_s)

    def remove(self, job: J) -> float:
        """Removes a job; returns its cost."""
        flow = self._flow_of[job]
        cost_s = super().remove(job)
        self._shares.leave(flow)
        return cost_s


def further(flow: Flow) -> Flow:
    """As whom a client's further steps are charged, and all that a failing caller asks for."""
    return Flow(flow.tenant, FURTHER, flow.client if flow.caller == FAILING else flow.caller)
