"""The order in which waiting jobs are computed: callers take turns, so that none takes the time of the others."""

from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Generic, TypeVar

from .jobs import Flow

J = TypeVar("J", bound=Hashable)

MAX_DEBTORS = 100
"""Callers without waiting jobs whose debts are kept."""


@dataclass
class _Account(Generic[J]):
    """A caller's waiting jobs with their costs, first in first out, and the computing time it has left."""

    jobs: OrderedDict[J, float] = field(default_factory=OrderedDict)
    credit_s: float = 0.0


class FairQueue(Generic[J]):
    """Waiting jobs in the order in which they are to be computed.

    Deficit round robin (Shreedhar and Varghese, 1996) with overdrawing: each caller in turn is credited a quantum of
    time and served while it has credit. If its last job costs more, it pays the rest back in later rounds, also if its
    next job comes later, as the next step of a long one does. So while two callers both wait, their shares differ by at
    most a quantum and two jobs, whatever they send.
    """

    def __init__(self, quantum_s: float) -> None:
        """A tenant's only caller gets `quantum_s` per round, which should be at least the cost of a typical job."""
        self._quantum_s = quantum_s
        # Callers with waiting jobs or debts, in the order of their turns.
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
        self._forget_if_settled(flow)
        if len(self._accounts) > len(self._flow_of) + MAX_DEBTORS:  # callers come and go without end
            debtor = next(it for it, account in self._accounts.items() if not account.jobs)
            self._accounts[debtor].credit_s = 0.0
            self._forget_if_settled(debtor)
        return cost_s

    def pop(self, is_allowed: Callable[[J], bool] = lambda _: True) -> J:
        """Removes the next of the allowed jobs and charges its caller; raises IndexError if none waits."""
        while True:
            for flow in list(self._accounts):
                account = self._accounts[flow]
                if account.credit_s > 0 and (job := next(filter(is_allowed, account.jobs), None)) is not None:
                    return self._charge(job)
                self._begin_turn(flow, 1)
            # All are in debt: skip the rounds in which no caller would be served.
            waiting = [flow for flow, account in self._accounts.items() if any(map(is_allowed, account.jobs))]
            if not waiting:
                raise IndexError("nothing waits")
            idle_rounds = min(int(-self._accounts[it].credit_s / self._share_s(it)) for it in waiting)
            for flow in list(self._accounts):
                self._begin_turn(flow, max(0, idle_rounds))

    def pop_alike(self, is_alike: Callable[[J], bool], at_most: int) -> list[J]:
        """Removes further jobs to compute with the last one, from each caller in turn, and charges for them."""
        if at_most < 1:
            return []
        alike = [list(filter(is_alike, account.jobs)) for account in self._accounts.values()]
        in_turn = [job for of_round in zip_longest(*alike) for job in of_round if job is not None]
        return [self._charge(job) for job in in_turn[:at_most]]

    def _begin_turn(self, flow: Flow, rounds: int) -> None:
        account, share_s = self._accounts[flow], self._share_s(flow)
        account.credit_s = min(account.credit_s + rounds * share_s, max(share_s, account.credit_s))
        self._accounts.move_to_end(flow)
        self._forget_if_settled(flow)

    def _forget_if_settled(self, flow: Flow) -> None:
        """Forgets a caller that neither waits nor is in debt."""
        if self._accounts[flow].jobs or self._accounts[flow].credit_s < 0:
            return
        del self._accounts[flow]
        self._callers_of_tenant[flow.tenant] -= 1
        if not self._callers_of_tenant[flow.tenant]:
            del self._callers_of_tenant[flow.tenant]

    def _share_s(self, flow: Flow) -> float:
        """The credit of a caller per round, seconds."""
        return self._quantum_s / self._callers_of_tenant[flow.tenant]

    def _charge(self, job: J) -> J:
        account = self._accounts[self._flow_of[job]]
        account.credit_s -= account.jobs[job]
        self.remove(job)
        return job
