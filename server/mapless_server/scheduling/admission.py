"""Who is let in: no more than can be computed in time, and room is left for those who come later."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

from .fair import Flow
from .jobs import Job, Refused
from .ledger import Ledger
from .observer import Refusal

MIN_RETRY_S = 0.1
RETRY_ELSEWHERE_S = 1.0
"""When to come again where nothing tells when there will be room."""


@dataclass(frozen=True)
class ScheduleOptions:
    """Options of the schedule.

    Attributes:
        max_queued_s: predicted computing time that may be admitted and not done, seconds a thread. Whoever is let in
            later would get an old answer; and a full queue never drains sooner for being longer.
        max_bytes: memory that admitted jobs may hold, and calls of several jobs until their last one is done.
        flow_share: of what others have left of either bound, what one caller may fill. So there is always room for one
            who comes later.
        caution: a job is let in if so many times the time predicted for it is left. Predictions are means, and what is
            computed and comes too late is lost for everybody.
        floor: every so many batches of a lane one is of the stage that was passed over for later ones.
        quantum_s: of the fair queues; about what one job of a stage takes.
    """

    max_queued_s: float = 2.0
    max_bytes: int = 256 * 2**20
    flow_share: float = 0.75
    caution: float = 1.2
    floor: int = 4
    quantum_s: float = 0.2

    def __post_init__(self) -> None:
        bounds = (self.max_queued_s, self.max_bytes, self.flow_share, self.quantum_s)
        if not (all(bound > 0 for bound in bounds) and self.flow_share <= 1 <= self.caution and self.floor >= 2):
            raise ValueError(f"senseless options: {self}")


class Admission:
    """The door of the schedule. What it decides follows from the ledger; it keeps nothing itself."""

    def __init__(self, options: ScheduleOptions, threads: Mapping[str, int], ledger: Ledger) -> None:
        """For each lane, its number of threads."""
        self._options = options
        self._threads = threads
        self._ledger = ledger
        self._is_closed = False

    def close(self) -> None:
        """Lets nobody in from now on."""
        self._is_closed = True

    def check(self, job: Job, cost_s: Counter[str], now_s: float) -> None:
        """Raises Refused if a job for which so much computing is predicted, by lane, cannot be let in."""
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
        late_s = now_s + options.caution * (max(waits_s) + own_s) - job.deadline_s
        if late_s > 0:
            retry_s = None if now_s + own_s > job.deadline_s else max(MIN_RETRY_S, late_s)
            message = f"the answer would come after the deadline, by about {late_s:.1g} s"
            raise Refused(Refusal.DEADLINE_INFEASIBLE, message, retry_s)

    def check_queue(self, flow: Flow, cost_s: Counter[str]) -> None:
        """Raises Refused if a caller cannot be let in with any job of this cost, whatever its deadline and size.

        An idle server tries anything: what is predicted may be wrong, and only trying mends that.
        """
        if self._is_closed:
            raise Refused(Refusal.DRAINING, "the server is stopping", RETRY_ELSEWHERE_S)
        for lane, own_s in cost_s.items() if self._ledger.jobs else ():
            excess_s = self._excess_s(flow, lane, own_s)
            if excess_s > 0:
                message = "as much is admitted already as can be computed soon"
                raise Refused(Refusal.QUEUE_FULL, message, max(MIN_RETRY_S, excess_s / self._threads[lane]))

    def check_memory(self, flow: Flow, size_bytes: int) -> None:
        """Raises Refused if a caller cannot hold so much more; where nobody holds anything it can hold all there is."""
        self._check_size(size_bytes)
        all_bytes, held_bytes = self._ledger.size_bytes(), self._ledger.size_bytes(flow)
        is_first = not (all_bytes or self._ledger.jobs)
        if not size_bytes or is_first:
            return
        if held_bytes + size_bytes > self._share(self._options.max_bytes, all_bytes, held_bytes):
            raise Refused(Refusal.TOO_MUCH_MEMORY, "the calls in progress hold too much memory", RETRY_ELSEWHERE_S)

    def _check_size(self, size_bytes: int) -> None:
        most = self._options.max_bytes
        if size_bytes > most:
            raise Refused(Refusal.TOO_LARGE, f"the call holds {size_bytes} bytes, {most} are allowed")

    def fits(self, job: Job, cost_s: Counter[str]) -> bool:
        """Whether a job that was let in may go on although it needs more than it was let in for."""
        added_s = {lane: own_s - job.booked_s[lane] for lane, own_s in cost_s.items()}
        return all(it <= 0 or self._excess_s(job.flow, lane, it) <= 0 for lane, it in added_s.items())

    def _excess_s(self, flow: Flow, lane: str, added_s: float) -> float:
        """Computing time by which a caller would be over what it may hold, if it got so much more."""
        bound_s = self._options.max_queued_s * self._threads[lane]
        held_s = self._ledger.booked_s(lane, flow)
        return held_s + added_s - self._share(bound_s, self._ledger.booked_s(lane), held_s)

    def _share(self, bound: float, held: float, held_by_flow: float) -> float:
        """What one caller may hold of a bound, given what all hold and it does."""
        return self._options.flow_share * (bound - (held - held_by_flow))
