"""Admission: a job is refused if it cannot be computed in time, and no caller can take the room of the others.

The cost of a job is predicted from jobs of its kind (`CostModel`), and booked while it is admitted (`Ledger`).
"""

from collections import Counter, OrderedDict
from collections.abc import Mapping

from .jobs import Flow, Job, Refusal, Refused
from .options import WorkQueueOptions

MAX_KINDS = 1000
FIRST_GUESS_S = 0.25
"""Predicted before anything is observed."""
MEMORY = 10
"""About so many of the last jobs of a kind count."""


class CostModel:
    """Predicts the computing time of a job in a stage: an average over its kind, with more weight for recent jobs."""

    def __init__(self) -> None:
        self._kinds: OrderedDict[tuple[str, str], tuple[int, float]] = OrderedDict()

    def forget(self) -> None:
        """Forgets all observations."""
        self._kinds.clear()

    def predict(self, stage: str, kind: str) -> float:
        """Predicted seconds; for an unknown kind, the average over all kinds in the stage."""
        known = self._kinds.get((stage, kind)) or self._kinds.get((stage, ""))
        return FIRST_GUESS_S if known is None else known[1]

    def observe(self, stage: str, kind: str, seconds: float) -> None:
        """Records the computing time of a job; its share, if it was computed with others."""
        for key in ((stage, kind), (stage, "")):
            count, mean_s = self._kinds.pop(key, (0, 0.0))
            count = min(count + 1, MEMORY)
            self._kinds[key] = (count, mean_s + (seconds - mean_s) / count)
        while len(self._kinds) > MAX_KINDS:
            self._kinds.popitem(last=False)


class Ledger:
    """Predicted computing time, by lane, and memory of the admitted jobs: in total and per caller.

    Attributes:
        jobs: jobs that are admitted and have not ended.
    """

    def __init__(self) -> None:
        self.jobs: set[Job] = set()
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
            holdings.booked_s.subtract(job.booked_s)
            holdings.booked_s.update(cost_s)
        job.booked_s = cost_s

    def close(self, job: Job) -> None:
        """Removes a job that has ended."""
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

    def booked_s(self, lane: str, flow: Flow | None = None) -> float:
        """Computing time predicted for the jobs of one caller, or of all."""
        return self._of(flow).booked_s[lane]

    def ahead_s(self, flow: Flow, lane: str, own_s: float) -> float:
        """Computing time until a new job of cost `own_s` is done, if all callers get equal shares.

        The caller's other jobs come first, and other callers get as much computing time as this one.
        """
        until_done_s = self.booked_s(lane, flow) + own_s
        of_others = (it.booked_s[lane] for other, it in self._flows.items() if other != flow)
        return until_done_s - own_s + sum(min(other_s, until_done_s) for other_s in of_others)

    def _of(self, flow: Flow | None) -> "_Holdings":
        return self._all if flow is None else self._flows.get(flow, _NOTHING)

    def _forget_if_empty(self, flow: Flow) -> None:
        held = self._flows[flow]
        if not (held.jobs or held.size_bytes):
            del self._flows[flow]


class _Holdings:
    def __init__(self) -> None:
        self.jobs = 0
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
        options, ledger = self._options, self._ledger
        self._check_size(job.size_bytes)
        if now_s >= job.deadline_s:
            raise Refused(Refusal.DEADLINE_INFEASIBLE, "the deadline has passed")
        if job.continues:
            return
        self.check_queue(job.flow, cost_s)
        self.check_memory(job.flow, job.size_bytes)
        if not ledger.jobs:
            return
        own_s = cost_s.total()
        waits_s = (ledger.ahead_s(job.flow, lane, it) / self._threads[lane] for lane, it in cost_s.items())
        late_s = now_s + options.time_margin * (max(waits_s) + own_s) - job.deadline_s
        if late_s > 0:
            retry_s = None if now_s + own_s > job.deadline_s else max(MIN_RETRY_S, late_s)
            message = f"the answer would come after the deadline, by about {late_s:.1g} s"
            raise Refused(Refusal.DEADLINE_INFEASIBLE, message, retry_s)

    def check_queue(self, flow: Flow, cost_s: Counter[str]) -> None:
        """Raises Refused if no job of this cost can be admitted for a caller, whatever its deadline and size.

        An idle server admits any cost: the prediction may be wrong, and only computing corrects it.
        """
        if self._is_closed:
            raise Refused(Refusal.DRAINING, "the server is stopping", UNKNOWN_RETRY_S)
        for lane, own_s in cost_s.items() if self._ledger.jobs else ():
            excess_s = self._excess_s(flow, lane, own_s)
            if excess_s > 0:
                message = "as much is admitted already as can be computed soon"
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

        The only job may, since no other job waits. It is booked `within_bounds`, so that others are still admitted.
        """
        if len(self._ledger.jobs) == 1:
            return True
        added_s = {lane: own_s - job.booked_s[lane] for lane, own_s in cost_s.items()}
        return all(it <= 0 or self._excess_s(job.flow, lane, it) <= 0 for lane, it in added_s.items())

    def within_bounds(self, job: Job, cost_s: Counter[str]) -> Counter[str]:
        """The part of an admitted job's cost that its caller may have, but no less than it was admitted with."""
        bounded_s: Counter[str] = Counter()
        for lane, own_s in cost_s.items():
            room_s = max(0.0, -self._excess_s(job.flow, lane, 0.0))
            bounded_s[lane] = min(own_s, job.booked_s[lane] + room_s)  # type: ignore[assignment]  # not int
        return bounded_s

    def _excess_s(self, flow: Flow, lane: str, added_s: float) -> float:
        """Computing time by which a caller would exceed its bound with this much more."""
        bound_s = self._options.max_queued_s * self._threads[lane]
        held_s = self._ledger.booked_s(lane, flow)
        return held_s + added_s - self._share(bound_s, self._ledger.booked_s(lane), held_s)

    def _share(self, bound: float, held: float, held_by_flow: float) -> float:
        """The part of a bound that one caller may have, given what it and all callers have."""
        return self._options.flow_share * (bound - (held - held_by_flow))
