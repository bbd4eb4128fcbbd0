"""Admission: a job is refused if it cannot be computed in time, and no caller can take the room of the others."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping

from .costs import Ledger
from .jobs import Flow, Job, Refusal, Refused
from .options import WorkQueueOptions

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
        """Raises Refused if a caller cannot hold so much more; the first caller may hold all there is."""
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
        """Whether an admitted job may continue although it now needs more than it was admitted with."""
        added_s = {lane: own_s - job.booked_s[lane] for lane, own_s in cost_s.items()}
        return all(it <= 0 or self._excess_s(job.flow, lane, it) <= 0 for lane, it in added_s.items())

    def _excess_s(self, flow: Flow, lane: str, added_s: float) -> float:
        """Computing time by which a caller would exceed its bound with so much more."""
        bound_s = self._options.max_queued_s * self._threads[lane]
        held_s = self._ledger.booked_s(lane, flow)
        return held_s + added_s - self._share(bound_s, self._ledger.booked_s(lane), held_s)

    def _share(self, bound: float, held: float, held_by_flow: float) -> float:
        """What one caller may hold of a bound, given what it and all callers hold."""
        return self._options.flow_share * (bound - (held - held_by_flow))
