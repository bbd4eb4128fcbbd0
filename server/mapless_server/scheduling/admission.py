"""Admission of jobs, so that no caller can take the room of the others.

The predicted cost of a job is booked while it is admitted (`Ledger`). A job is refused if it cannot be computed in time
(`Admission`).
"""

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from .failing import FAILING
from .jobs import AnyJob, Flow, Refusal, Refused
from .shares import Shares


@dataclass(frozen=True)
class WorkQueueOptions:
    """Bounds of admission, order of computing, and supervision of the threads.

    Attributes:
        max_queued_s: largest predicted computing time of the admitted jobs, seconds per thread of a lane, of a
            caller and of those who come first (see `Admission.check_queue`). The result of a job admitted beyond it
            would be late, and a longer queue has no higher throughput. Together, any number of callers book more only
            by a logarithm: of equal ones, the k-th a k-th of it.
        max_bytes: largest memory of admitted jobs, and of calls that consist of several jobs, together.
        quantum_s: a step that is predicted to take longer is a long one, of which one thread is kept free; about what
            one job of a stage takes.
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


CLIENT_SHARE = 0.75
"""Share that one client may book of its caller's room, so that there is room for other clients.
Evidence: queue-client-share."""
MEMORY_SHARE = CLIENT_SHARE**0.5
"""Share that one caller may hold of the memory that others leave, and a client of its caller's part."""
TIME_MARGIN = 1.2
"""A job is admitted if at least so many times its predicted time remains until its deadline. Predictions are averages,
and a result that comes too late is wasted for everyone."""
MAX_BOOKED_SHARE = 0.25
"""Largest share of `max_queued_s` that is booked for one job, and that a caller's only job is refused for: otherwise
long ones would be admitted on an idle server only, and then leave no room for others."""


class Ledger:
    """Predicted computing time, by lane, and memory of the admitted jobs: in total, per caller and per client.

    Attributes:
        jobs: jobs that are admitted and have not ended.
    """

    def __init__(self, shares: Shares) -> None:
        """Counts those who have jobs in the shares, too."""
        self._shares = shares
        self.jobs: set[AnyJob] = set()
        self._aside: set[AnyJob] = set()
        self._clients: dict[Flow, _Holdings] = {}
        self._callers: dict[tuple[str, str], _Holdings] = {}
        self._all = _Holdings()

    def open(self, job: AnyJob, cost_s: Counter[str]) -> None:
        """Books an admitted job."""
        self.jobs.add(job)
        self._shares.enter(job.flow)
        for holdings in self._holding(job.flow):
            holdings.jobs += 1
            holdings.size_bytes += job.size_bytes
        self.rebook(job, cost_s)

    def rebook(self, job: AnyJob, cost_s: Counter[str]) -> None:
        """Replaces the computing time predicted for a job, by lane; none is booked for one that is set aside."""
        if job in self._aside:
            return
        for holdings in self._holding(job.flow):
            for lane, seconds in job.booked_s.items():  # Counter's methods take ten times as long
                holdings.booked_s[lane] -= seconds
            for lane, seconds in cost_s.items():
                holdings.booked_s[lane] += seconds
        job.booked_s = cost_s

    def set_aside(self, job: AnyJob) -> None:
        """Counts a job for nothing but its memory, because it waits aside, until `resume`; no change if it was."""
        if job in self._aside:
            return
        self.rebook(job, Counter())
        self._aside.add(job)
        for holdings in self._holding(job.flow):
            holdings.aside += 1

    def resume(self, job: AnyJob, cost_s: Counter[str]) -> None:
        """Undoes `set_aside`, if it was, with the computing time that is now predicted."""
        if job not in self._aside:
            return
        self._aside.remove(job)
        for holdings in self._holding(job.flow):
            holdings.aside -= 1
        self.rebook(job, cost_s)

    def close(self, job: AnyJob) -> None:
        """Removes a job that has ended."""
        if job in self._aside:
            self.resume(job, Counter())
        self.rebook(job, Counter())
        self.jobs.remove(job)
        self._shares.leave(job.flow)
        for holdings in self._holding(job.flow):
            holdings.jobs -= 1
            holdings.size_bytes -= job.size_bytes
            if not holdings.jobs:
                holdings.booked_s.clear()  # removes rounding errors
        self._forget_if_empty(job.flow)

    def hold(self, flow: Flow, size_bytes: int) -> None:
        """Books memory that a call of several jobs needs besides these jobs."""
        for holdings in self._holding(flow):
            holdings.size_bytes += size_bytes

    def release(self, flow: Flow, size_bytes: int) -> None:
        """Undoes `hold`."""
        for holdings in self._holding(flow):
            holdings.size_bytes -= size_bytes
        self._forget_if_empty(flow)

    def size_bytes(self, flow: Flow | None = None) -> int:
        """Memory held by one client, or by all."""
        return self._of(flow).size_bytes

    def size_bytes_of_caller(self, flow: Flow) -> int:
        """Memory held by a client's caller."""
        return self._callers.get(flow.group, _NOTHING).size_bytes

    def job_count(self, flow: Flow | None = None) -> int:
        """Number of jobs of one client, or of all, without those that are set aside."""
        return self._of(flow).in_order

    def others_wait(self, flow: Flow) -> bool:
        """Whether jobs of another caller, which does not fail, are admitted, without those that are set aside."""
        others = (it for group, it in self._callers.items() if group != flow.group and group[1] != FAILING)
        return any(it.in_order for it in others)

    def booked_s(self, lane: str, flow: Flow | None = None) -> float:
        """Computing time predicted for the jobs of one client, or of all."""
        return self._of(flow).booked_s[lane]

    def booked_s_of_caller(self, lane: str, flow: Flow) -> float:
        """Computing time predicted for the jobs of a client's caller."""
        return self._callers.get(flow.group, _NOTHING).booked_s[lane]

    def ahead_s(self, flow: Flow, lane: str, own_s: float) -> float:
        """Computing time until a new job of cost `own_s` is done, without its own, in the order of `Shares`.

        The client's other jobs come first, and of its caller's other clients, the tenant's other callers, and other
        tenants what brings them to as much as it has been given then.
        """
        until_done_s = self.booked_s(lane, flow) + own_s
        return until_done_s - own_s + self.of_others_s(flow, lane, until_done_s)

    def of_others_s(self, flow: Flow, lane: str, share_s: float) -> float:
        """Computing time of other clients, callers and tenants until a client has been given `share_s` more."""
        of_clients_s = self.of_clients_s(flow, lane, share_s)
        return of_clients_s + self.of_callers_s(flow, lane, share_s + of_clients_s)

    def of_clients_s(self, flow: Flow, lane: str, share_s: float) -> float:
        """Computing time of the caller's other clients until this one has been given `share_s` more."""
        return sum(
            min(it.booked_s[lane], max(0.0, share_s - self._shares.lead_s(other, flow)))
            for other, it in self._clients.items()
            if other.group == flow.group and other != flow
        )

    def of_callers_s(self, flow: Flow, lane: str, share_s: float) -> float:
        """Computing time of other callers and tenants until a client's caller has been given `share_s` more."""
        others_s, of_tenants_s, of_tenant = 0.0, Counter[str](), dict[str, Flow]()
        for group, it in self._callers.items():
            other = Flow(*group)
            if other.tenant != flow.tenant:
                of_tenants_s[other.tenant] += it.booked_s[lane]
                of_tenant[other.tenant] = other
            elif group != flow.group:
                others_s += min(it.booked_s[lane], max(0.0, share_s - self._shares.lead_s(other, flow)))
        total_s = share_s + others_s
        for tenant, other in of_tenant.items():
            others_s += min(of_tenants_s[tenant], max(0.0, total_s - self._shares.lead_s(other, flow)))
        return others_s

    def _of(self, flow: Flow | None) -> "_Holdings":
        return self._all if flow is None else self._clients.get(flow, _NOTHING)

    def _holding(self, flow: Flow) -> tuple["_Holdings", "_Holdings", "_Holdings"]:
        """Returns the holdings of the client, of its caller and of all, to be changed."""
        if (of_client := self._clients.get(flow)) is None:
            of_client = self._clients[flow] = _Holdings()
        if (of_caller := self._callers.get(flow.group)) is None:
            of_caller = self._callers[flow.group] = _Holdings()
        return of_client, of_caller, self._all

    def _forget_if_empty(self, flow: Flow) -> None:
        if self._clients[flow].is_empty:
            del self._clients[flow]
        if self._callers[flow.group].is_empty:
            del self._callers[flow.group]


class _Holdings:
    def __init__(self) -> None:
        self.jobs = 0
        self.aside = 0
        self.size_bytes = 0
        self.booked_s: Counter[str] = Counter()

    @property
    def in_order(self) -> int:
        """Number of jobs without those that are set aside."""
        return self.jobs - self.aside

    @property
    def is_empty(self) -> bool:
        return not (self.jobs or self.size_bytes)


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

    def check(self, job: AnyJob, cost_s: Counter[str], now_s: float) -> None:
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
        """Raises Refused if no job of this cost can be admitted for a client, whatever its deadline and size.

        An idle server admits any cost: the prediction may be wrong, and only computing corrects it.
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
            if excess_s > 0:
                message = f"as much is admitted already as can be computed soon; this caller's jobs in it: {own_jobs}"
                raise Refused(Refusal.QUEUE_FULL, message, max(MIN_RETRY_S, excess_s / self._threads[lane]))

    def check_memory(self, flow: Flow, size_bytes: int) -> None:
        """Raises Refused if a client cannot have this much more memory; a single one may have all of it."""
        self._check_size(size_bytes)
        ledger = self._ledger
        is_first = not (ledger.size_bytes() or ledger.jobs)
        if not size_bytes or is_first:
            return
        by_caller = ledger.size_bytes_of_caller(flow)
        of_caller = MEMORY_SHARE * (self._options.max_bytes - (ledger.size_bytes() - by_caller))
        of_client = MEMORY_SHARE * (of_caller - (by_caller - ledger.size_bytes(flow)))
        if by_caller + size_bytes > of_caller or ledger.size_bytes(flow) + size_bytes > of_client:
            raise Refused(Refusal.TOO_MUCH_MEMORY, "the calls in progress hold too much memory", UNKNOWN_RETRY_S)

    def _check_size(self, size_bytes: int) -> None:
        most = self._options.max_bytes
        if size_bytes > most:
            raise Refused(Refusal.TOO_LARGE, f"the call holds {size_bytes} bytes, {most} are allowed")

    def has_turn(self, job: AnyJob, cost_s: Counter[str]) -> bool:
        """Whether an admitted job, its client's only one, may continue although the share is too small for it.

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
        """Computing time by which a client or its caller would exceed its part of the bound with this much more.

        The caller's part is what those leave who come first: who has been given less than others may book all of it,
        also while their long jobs fill the queue. The first job of a client may use all that the caller's others leave.
        """
        ledger = self._ledger
        of_caller_s = ledger.booked_s_of_caller(lane, flow) + added_s
        part_s = self._bound_s(lane) - ledger.of_callers_s(flow, lane, of_caller_s)
        of_client_s = ledger.booked_s(lane, flow) + added_s
        left_s = part_s - ledger.of_clients_s(flow, lane, of_client_s)
        share = CLIENT_SHARE if ledger.job_count(flow) else 1.0
        return max(of_caller_s - part_s, of_client_s - share * left_s)

    def _bound_s(self, lane: str) -> float:
        return self._options.max_queued_s * self._threads[lane]
