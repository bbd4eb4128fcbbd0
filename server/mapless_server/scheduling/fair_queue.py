"""The order of waiting jobs: deficit round robin over callers, with equal shares for tenants."""

from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Generic, TypeVar

from .jobs import Flow

J = TypeVar("J", bound=Hashable)


@dataclass
class _Account(Generic[J]):
    """A caller's waiting jobs with their costs, first in first out, and the computing time it has left."""

    jobs: OrderedDict[J, float] = field(default_factory=OrderedDict)
    credit_s: float = 0.0


class FairQueue(Generic[J]):
    """Waiting jobs in the order in which they are to be computed.

    Deficit round robin (Shreedhar and Varghese, 1996) with overdrawing: each caller in turn is credited a quantum of
    time and served while it has credit. If its last job costs more, it pays the rest back in later rounds, as long as
    it has jobs waiting. So while two callers both wait, their shares differ by at most a quantum and two jobs, whatever
    they send.
    """

    def __init__(self, quantum_s: float) -> None:
        """A tenant's only caller gets `quantum_s` per round, which should be at least the cost of a typical job."""
        self._quantum_s = quantum_s
        # Callers with waiting jobs only, in the order of their turns.
        self._accounts: OrderedDict[Flow, _Account[J]] = OrderedDict()
        self._callers_of_tenant: Counter[str] = Counter()
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
        """Adds a job behind those of its caller."""
        account = self._accounts.get(flow)
        if account is None:
            account = self._accounts[flow] = _Account()
            self._callers_of_tenant[flow.tenant] += 1
        account.jobs[job] = cost_s
        self._flow_of[job] = flow
        self._cost_s += cost_s

    def remove(self, job: J) -> float:
        """Removes a job without charging its caller; returns its cost."""
        flow = self._flow_of.pop(job)
        cost_s = self._accounts[flow].jobs.pop(job)
        self._cost_s -= cost_s
        # Callers come and go without end, so neither credit nor debt is kept without waiting jobs.
        if not self._accounts[flow].jobs:
            del self._accounts[flow]
            self._callers_of_tenant[flow.tenant] -= 1
            if not self._callers_of_tenant[flow.tenant]:
                del self._callers_of_tenant[flow.tenant]
        return cost_s

    def pop(self) -> J:
        """Removes the next job and charges its caller; raises IndexError if none waits."""
        if not self._flow_of:
            raise IndexError("nothing waits")
        for flow in list(self._accounts):
            if self._accounts[flow].credit_s > 0:
                return self._charge(next(iter(self._accounts[flow].jobs)))
            self._begin_turn(flow, 1)
        # All are in debt: skip the rounds in which no caller would be served.
        idle_rounds = min(int(-it.credit_s / self._share_s(flow)) for flow, it in self._accounts.items())
        for flow in list(self._accounts):
            self._begin_turn(flow, max(0, idle_rounds))
        return self.pop()

    def pop_alike(self, is_alike: Callable[[J], bool], at_most: int) -> list[J]:
        """Removes further jobs to compute with the last one, from each caller in turn, and charges for them."""
        if at_most < 1:
            return []
        alike = [list(filter(is_alike, account.jobs)) for account in self._accounts.values()]
        in_turn = [job for of_round in zip_longest(*alike) for job in of_round if job is not None]
        return [self._charge(job) for job in in_turn[:at_most]]

    def _begin_turn(self, flow: Flow, rounds: int) -> None:
        self._accounts[flow].credit_s += rounds * self._share_s(flow)
        self._accounts.move_to_end(flow)

    def _share_s(self, flow: Flow) -> float:
        """The credit of a caller per round, seconds."""
        return self._quantum_s / self._callers_of_tenant[flow.tenant]

    def _charge(self, job: J) -> J:
        account = self._accounts[self._flow_of[job]]
        account.credit_s -= self.remove(job)
        return job
