"""Which jobs are admitted, and in which order they are computed, so that no caller can take the room of the others.

The cost of a job is predicted from jobs of its kind (`CostModel`), and booked while it is admitted (`Ledger`). A job is
refused if it cannot be computed in time (`Admission`). Those that wait take turns by caller and tenant (`FairQueue`).
"""

import math
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Hashable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import zip_longest
from statistics import median_low
from typing import Generic, TypeVar

from .jobs import Flow, Job, Refusal, Refused

J = TypeVar("J", bound=Hashable)


@dataclass(frozen=True)
class WorkQueueOptions:
    """Bounds of admission, order of computing, and supervision of the threads.

    Attributes:
        max_queued_s: largest predicted computing time of the admitted jobs, seconds per thread of a lane, besides a
            caller's only job (see `Admission.check_queue`). The result of a job admitted beyond it would be late, and a
            longer queue has no higher throughput.
        max_bytes: largest memory of admitted jobs, and of calls that consist of several jobs, together.
        quantum_s: computing time credited to a caller in each round of the fair queue; about what one job of a stage
            takes.
        stall_limit_s: a batch without any progress (its end, or a job's `check`) for longer is considered hung: its
            thread is lost, and the queue ends.
        heartbeat_s: interval of supervision.
    """

    max_queued_s: float = 2.0
    max_bytes: int = 256 * 2**20
    quantum_s: float = 0.2
    stall_limit_s: float = 120.0
    heartbeat_s: float = 1.0

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not value > 0:
                raise ValueError(f"WorkQueueOptions.{name} must be above 0, is {value}")


FLOW_SHARE = 0.75
"""That one caller may use of what other callers leave of either bound, so that there is always room for the next."""
TIME_MARGIN = 1.2
"""A job is admitted if at least so many times its predicted time remains until its deadline. Predictions are averages,
and a result that comes too late is wasted for everyone."""
FIRST_GUESS_S = 0.25
"""Predicted before anything is observed."""
_EXPECTED = ", if reached"
"""Of a stage's name, where jobs that did not reach it count."""
MEMORY = 10
"""About so many of the last jobs of a kind count."""
MAX_OF_CALLERS = 4000
"""Predictions for single callers that are kept, about six of each."""
FORGOTTEN_S = 30.0
"""What a caller's jobs cost longer ago does not count: as long as it is refused, nothing corrects its prediction."""
MAX_BOOKED_SHARE = 0.25
"""Largest share of `max_queued_s` that is booked for one job, and that a caller's only job is refused for: otherwise
long ones would be admitted on an idle server only, and then leave no room for others."""


class CostModel:
    """Predicts the computing time of a job in a stage from earlier ones of its kind.

    Photographs of a caller resemble one another, and those of another caller may take fifty times as long: so its own
    jobs count, as an average with more weight for recent ones, which begins with what is typical. That is the median of
    all callers' last jobs.
    """

    def __init__(self) -> None:
        self._of_callers: OrderedDict[tuple[str, str, Flow], tuple[int, float, float]] = OrderedDict()
        self._of_all: dict[tuple[str, str], deque[float]] = {}

    def forget(self) -> None:
        """Forgets all observations."""
        self._of_callers.clear()
        self._of_all.clear()

    def predict(self, stage: str, kind: str, flow: Flow, now_s: float, is_certain: bool = True) -> float:
        """Predicted seconds; for an unknown kind, what is typical of all kinds in the stage.

        Unless it `is_certain` that the job reaches the stage, jobs that did not count as well, with nothing.
        """
        stage += "" if is_certain else _EXPECTED
        _, mean_s, seen_s = self._of_callers.get((stage, kind, flow), (0, 0.0, -math.inf))
        if now_s - seen_s <= FORGOTTEN_S:
            return mean_s
        known = self._of_all.get((stage, kind)) or self._of_all.get((stage, ""))
        return median_low(known) if known else FIRST_GUESS_S

    def observe(self, stage: str, kind: str, flow: Flow, seconds: float | None, now_s: float) -> None:
        """Records the computing time of a job, its share if it was computed with others; None if it was not reached."""
        if seconds is not None:
            self._observe(stage, kind, flow, seconds, now_s)
        self._observe(stage + _EXPECTED, kind, flow, seconds or 0.0, now_s)

    def _observe(self, stage: str, kind: str, flow: Flow, seconds: float, now_s: float) -> None:
        count, mean_s, seen_s = self._of_callers.pop((stage, kind, flow), (0, 0.0, -math.inf))
        if now_s - seen_s > FORGOTTEN_S:
            known = self._of_all.get((stage, kind))
            count, mean_s = (1, median_low(known)) if known else (0, 0.0)
        count = min(count + 1, MEMORY)
        self._of_callers[stage, kind, flow] = (count, mean_s + (seconds - mean_s) / count, now_s)
        if len(self._of_callers) > MAX_OF_CALLERS:
            self._of_callers.popitem(last=False)
        for key in (kind, ""):
            self._of_all.setdefault((stage, key), deque(maxlen=MEMORY)).append(seconds)


class Ledger:
    """Predicted computing time, by lane, and memory of the admitted jobs: in total and per caller.

    Attributes:
        jobs: jobs that are admitted and have not ended.
    """

    def __init__(self) -> None:
        self.jobs: set[Job] = set()
        self._aside: set[Job] = set()
        self._flows: dict[Flow, _Holdings] = {}
        self._all = _Holdings()

    def open(self, job: Job, cost_s: Counter[str]) -> None:
        """Books an admitted job."""
        self.jobs.add(job)
        of_flow = self._flows.setdefault(job.flow, _Holdings())
        for holdings in (of_flow, self._all):
            holdings.jobs += 1
            holdings.size_bytes += job.size_bytes
        self.rebook(job, cost_s)

    def rebook(self, job: Job, cost_s: Counter[str]) -> None:
        """Replaces the computing time predicted for a job, by lane."""
        for holdings in (self._flows[job.flow], self._all):
            for lane, seconds in job.booked_s.items():  # Counter's methods take ten times as long
                holdings.booked_s[lane] -= seconds
            for lane, seconds in cost_s.items():
                holdings.booked_s[lane] += seconds
        job.booked_s = cost_s

    def set_aside(self, job: Job) -> None:
        """Counts a job for nothing but its memory, because it waits until a thread is idle otherwise."""
        self.rebook(job, Counter())
        self._aside.add(job)
        for holdings in (self._flows[job.flow], self._all):
            holdings.aside += 1

    def resume(self, job: Job, cost_s: Counter[str]) -> None:
        """Undoes `set_aside`, with the computing time that is now predicted."""
        self._aside.remove(job)
        for holdings in (self._flows[job.flow], self._all):
            holdings.aside -= 1
        self.rebook(job, cost_s)

    def close(self, job: Job) -> None:
        """Removes a job that has ended."""
        if job in self._aside:
            self.resume(job, Counter())
        self.rebook(job, Counter())
        self.jobs.remove(job)
        for holdings in (self._flows[job.flow], self._all):
            holdings.jobs -= 1
            holdings.size_bytes -= job.size_bytes
            if not holdings.jobs:
                holdings.booked_s.clear()  # removes rounding errors
        self._forget_if_empty(job.flow)

    def hold(self, flow: Flow, size_bytes: int) -> None:
        """Books memory that a call of several jobs needs besides these jobs."""
        for holdings in (self._flows.setdefault(flow, _Holdings()), self._all):
            holdings.size_bytes += size_bytes

    def release(self, flow: Flow, size_bytes: int) -> None:
        """Undoes `hold`."""
        for holdings in (self._flows[flow], self._all):
            holdings.size_bytes -= size_bytes
        self._forget_if_empty(flow)

    def size_bytes(self, flow: Flow | None = None) -> int:
        """Memory held by one caller, or by all."""
        return self._of(flow).size_bytes

    def job_count(self, flow: Flow | None = None) -> int:
        """Number of jobs of one caller, or of all, without those that are set aside."""
        holdings = self._of(flow)
        return holdings.jobs - holdings.aside

    def booked_s(self, lane: str, flow: Flow | None = None) -> float:
        """Computing time predicted for the jobs of one caller, or of all."""
        return self._of(flow).booked_s[lane]

    def ahead_s(self, flow: Flow, lane: str, own_s: float) -> float:
        """Computing time until a new job of cost `own_s` is done, if all callers get equal shares.

        The caller's other jobs come first, and other callers get as much computing time as this one.
        """
        until_done_s = self.booked_s(lane, flow) + own_s
        return until_done_s - own_s + self.of_others_s(flow, lane, until_done_s)

    def of_others_s(self, flow: Flow, lane: str, share_s: float) -> float:
        """Computing time predicted for the jobs of all callers but one, of each at most `share_s`."""
        of_others = (it.booked_s[lane] for other, it in self._flows.items() if other != flow)
        return sum(min(other_s, share_s) for other_s in of_others)

    def _of(self, flow: Flow | None) -> "_Holdings":
        return self._all if flow is None else self._flows.get(flow, _NOTHING)

    def _forget_if_empty(self, flow: Flow) -> None:
        held = self._flows[flow]
        if not (held.jobs or held.size_bytes):
            del self._flows[flow]


class _Holdings:
    def __init__(self) -> None:
        self.jobs = 0
        self.aside = 0
        self.size_bytes = 0
        self.booked_s: Counter[str] = Counter()


_NOTHING = _Holdings()


MIN_RETRY_S = 0.1
UNKNOWN_RETRY_S = 1.0
"""Suggested where it cannot be predicted when there will be room."""


class Admission:
    """Decides from the ledger which jobs are admitted."""

    def __init__(self, options: WorkQueueOptions, threads: Mapping[str, int], ledger: Ledger) -> None:
        """`threads` is the number of threads of each lane."""
        self._options = options
        self._threads = threads
        self._ledger = ledger
        self._is_closed = False

    def close(self) -> None:
        """Refuses every job from now on."""
        self._is_closed = True

    def check(self, job: Job, cost_s: Counter[str], now_s: float) -> None:
        """Raises Refused if a job with this predicted computing time, by lane, cannot be admitted."""
        ledger = self._ledger
        self._check_size(job.size_bytes)
        if now_s >= job.deadline_s:
            raise Refused(Refusal.DEADLINE_INFEASIBLE, "the deadline has passed")
        if job.continues:
            return
        self.check_queue(job.flow, cost_s)
        self.check_memory(job.flow, job.size_bytes)
        if not ledger.job_count():
            return
        own_s = cost_s.total()
        waits_s = (ledger.ahead_s(job.flow, lane, it) / self._threads[lane] for lane, it in cost_s.items())
        late_s = now_s + TIME_MARGIN * (max(waits_s) + own_s) - job.deadline_s
        if late_s > 0:
            retry_s = None if now_s + own_s > job.deadline_s else max(MIN_RETRY_S, late_s)
            message = f"the answer would come after the deadline, by about {late_s:.1g} s"
            raise Refused(Refusal.DEADLINE_INFEASIBLE, message, retry_s)

    def check_queue(self, flow: Flow, cost_s: Counter[str]) -> None:
        """Raises Refused if no job of this cost can be admitted for a caller, whatever its deadline and size.

        An idle server admits any cost: the prediction may be wrong, and only computing corrects it. A caller without
        jobs is also admitted if its job would be done soon although all others got as much of the server as it does.
        """
        if self._is_closed:
            raise Refused(Refusal.DRAINING, "the server is stopping", UNKNOWN_RETRY_S)
        ledger = self._ledger
        if not ledger.job_count():
            return
        own_jobs = ledger.job_count(flow)
        is_first = not own_jobs
        for lane, own_s in (self.bookable(cost_s) if is_first else cost_s).items():
            excess_s = self._excess_s(flow, lane, own_s)
            if is_first:
                excess_s = min(excess_s, ledger.ahead_s(flow, lane, own_s) + own_s - self._bound_s(lane))
            if excess_s > 0:
                message = f"as much is admitted already as can be computed soon; this caller's jobs in it: {own_jobs}"
                raise Refused(Refusal.QUEUE_FULL, message, max(MIN_RETRY_S, excess_s / self._threads[lane]))

    def check_memory(self, flow: Flow, size_bytes: int) -> None:
        """Raises Refused if a caller cannot have this much more memory; a single caller may have all of it."""
        self._check_size(size_bytes)
        all_bytes, held_bytes = self._ledger.size_bytes(), self._ledger.size_bytes(flow)
        is_first = not (all_bytes or self._ledger.jobs)
        if not size_bytes or is_first:
            return
        if held_bytes + size_bytes > self._share(self._options.max_bytes, all_bytes, held_bytes):
            raise Refused(Refusal.TOO_MUCH_MEMORY, "the calls in progress hold too much memory", UNKNOWN_RETRY_S)

    def _check_size(self, size_bytes: int) -> None:
        most = self._options.max_bytes
        if size_bytes > most:
            raise Refused(Refusal.TOO_LARGE, f"the call holds {size_bytes} bytes, {most} are allowed")

    def fits(self, job: Job, cost_s: Counter[str]) -> bool:
        """Whether an admitted job may continue although it now needs more than it was admitted with.

        The only job may, since no other job waits.
        """
        if len(self._ledger.jobs) == 1:
            return True
        added_s = {lane: own_s - job.booked_s[lane] for lane, own_s in cost_s.items()}
        return all(it <= 0 or self._excess_s(job.flow, lane, it) <= 0 for lane, it in added_s.items())

    def has_turn(self, job: Job, cost_s: Counter[str]) -> bool:
        """Whether an admitted job, its caller's only one, may continue although its caller's share is too small for it.

        It may if it would be done soon although all others got as much of the server, as a first job is admitted.
        """
        ledger, flow = self._ledger, job.flow
        if ledger.job_count(flow) > 1:
            return False
        return all(ledger.of_others_s(flow, lane, it) + it <= self._bound_s(lane) for lane, it in cost_s.items())

    def bookable(self, cost_s: Counter[str]) -> Counter[str]:
        """The part of a job's cost that is booked."""
        return Counter({lane: min(own_s, MAX_BOOKED_SHARE * self._bound_s(lane)) for lane, own_s in cost_s.items()})

    def _excess_s(self, flow: Flow, lane: str, added_s: float) -> float:
        """Computing time by which a caller would exceed its bound with this much more."""
        held_s = self._ledger.booked_s(lane, flow)
        return held_s + added_s - self._share(self._bound_s(lane), self._ledger.booked_s(lane), held_s)

    def _bound_s(self, lane: str) -> float:
        return self._options.max_queued_s * self._threads[lane]

    def _share(self, bound: float, held: float, held_by_flow: float) -> float:
        """The part of a bound that one caller may have, given what it and all callers have."""
        return FLOW_SHARE * (bound - (held - held_by_flow))


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
