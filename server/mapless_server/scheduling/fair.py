"""Whose turn it is: deficit round robin over callers, tenants first."""

from __future__ import annotations

from collections import Counter, OrderedDict
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass, field
from itertools import zip_longest
from typing import Generic, NamedTuple, TypeVar

J = TypeVar("J", bound=Hashable)


class Flow(NamedTuple):
    """Whose a job is. Tenants share equally, and so do the clients of a tenant."""

    tenant: str
    client: str


@dataclass
class _Account(Generic[J]):
    """A caller's waiting jobs with their costs, first come first, and the computing time to its credit."""

    jobs: OrderedDict[J, float] = field(default_factory=OrderedDict)
    credit_s: float = 0.0


class FairQueue(Generic[J]):
    """Waiting jobs in the order in which they are to be computed.

    Deficit round robin (Shreedhar and Varghese, 1996) in its overdrawing form: each caller in turn is given a quantum
    of time and served while it has credit; what its last job costs beyond that it pays back in later rounds, as long as
    it goes on waiting for more. So over any time in which two callers both wait, what they get differs by no more than
    a quantum and two jobs, whatever they send and however much.
    """

    def __init__(self, quantum_s: float) -> None:
        """A caller alone in its tenant gets `quantum_s` a round; it needs to be no smaller than a typical job."""
        self._quantum_s = quantum_s
        # Of those who wait, in the order of their turns.
        self._accounts: OrderedDict[Flow, _Account[J]] = OrderedDict()
        self._members: Counter[str] = Counter()
        self._flow_of: dict[J, Flow] = {}
        self._cost_s = 0.0

    def __len__(self) -> int:
        return len(self._flow_of)

    def __contains__(self, job: object) -> bool:
        return job in self._flow_of

    def __iter__(self) -> Iterator[J]:
        return iter(self._flow_of)

    @property
    def callers(self) -> int:
        """Those whose jobs wait; of nobody else is anything kept."""
        return len(self._accounts)

    @property
    def cost_s(self) -> float:
        """Of all that wait."""
        return self._cost_s if self._flow_of else 0.0  # without what rounding has left

    def push(self, job: J, flow: Flow, cost_s: float) -> None:
        """Lets a job wait, behind those of its caller."""
        account = self._accounts.get(flow)
        if account is None:
            account = self._accounts[flow] = _Account()
            self._members[flow.tenant] += 1
        account.jobs[job] = cost_s
        self._flow_of[job] = flow
        self._cost_s += cost_s

    def remove(self, job: J) -> None:
        """Takes out a job that is not to be computed any more; its caller is not charged."""
        flow = self._flow_of.pop(job)
        self._cost_s -= self._accounts[flow].jobs.pop(job)
        self._forget_idle(flow)

    def pop(self) -> J:
        """Takes out the job whose turn it is. IndexError if nothing waits."""
        if not self._flow_of:
            raise IndexError("nothing waits")
        for flow in list(self._accounts):
            if self._accounts[flow].credit_s > 0:
                return self._charge(flow, next(iter(self._accounts[flow].jobs)))
            self._begin_turn(flow, 1)
        # All were in debt: the further rounds in which nobody would be served are gone through at once.
        idle_rounds = min(int(-it.credit_s / self._share_s(flow)) for flow, it in self._accounts.items())
        for flow in list(self._accounts):
            self._begin_turn(flow, max(0, idle_rounds))
        return self.pop()

    def _begin_turn(self, flow: Flow, rounds: int) -> None:
        self._accounts[flow].credit_s += rounds * self._share_s(flow)
        self._accounts.move_to_end(flow)

    def _share_s(self, flow: Flow) -> float:
        """What a caller is credited in a round."""
        return self._quantum_s / self._members[flow.tenant]

    def pop_alike(self, is_alike: Callable[[J], bool], at_most: int) -> list[J]:
        """Takes out further jobs, to be computed along with one, of each caller in turn; all are charged."""
        if at_most < 1:
            return []
        flows = list(self._accounts)
        alike = [list(filter(is_alike, self._accounts[flow].jobs)) for flow in flows]
        in_turn = [
            (flow, job) for of_round in zip_longest(*alike) for flow, job in zip(flows, of_round, strict=True) if job
        ]
        return [self._charge(flow, job) for flow, job in in_turn[:at_most]]

    def _charge(self, flow: Flow, job: J) -> J:
        account = self._accounts[flow]
        cost_s = account.jobs.pop(job)
        account.credit_s -= cost_s
        self._cost_s -= cost_s
        del self._flow_of[job]
        self._forget_idle(flow)
        return job

    def _forget_idle(self, flow: Flow) -> None:
        """Neither credit nor debt is kept of those who do not wait: callers come and go without end."""
        if not self._accounts[flow].jobs:
            del self._accounts[flow]
            self._members[flow.tenant] -= 1
            if not self._members[flow.tenant]:
                del self._members[flow.tenant]
