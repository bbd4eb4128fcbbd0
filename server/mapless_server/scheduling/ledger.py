"""What admitted jobs hold: predicted computing time by lane, and memory, in all and by caller."""

from __future__ import annotations

from collections import Counter

from .fair import Flow
from .jobs import Job


class Ledger:
    """The books of the schedule; they count exactly the jobs that are admitted and have not ended, and what calls hold.

    Attributes:
        jobs: these jobs.
    """

    def __init__(self) -> None:
        self.jobs: set[Job] = set()
        self._flows: dict[Flow, _Holdings] = {}
        self._all = _Holdings()

    def open(self, job: Job, cost_s: Counter[str]) -> None:
        """Books a job that is admitted."""
        self.jobs.add(job)
        of_flow = self._flows.setdefault(job.flow, _Holdings())
        for holdings in (of_flow, self._all):
            holdings.jobs += 1
            holdings.size_bytes += job.size_bytes
        self.rebook(job, cost_s)

    def rebook(self, job: Job, cost_s: Counter[str]) -> None:
        """So much computing is predicted for it by now, by lane."""
        for holdings in (self._flows[job.flow], self._all):
            holdings.booked_s.subtract(job.booked_s)
            holdings.booked_s.update(cost_s)
        job.booked_s = cost_s

    def close(self, job: Job) -> None:
        """The job has ended."""
        self.rebook(job, Counter())
        self.jobs.remove(job)
        for holdings in (self._flows[job.flow], self._all):
            holdings.jobs -= 1
            holdings.size_bytes -= job.size_bytes
            if not holdings.jobs:
                holdings.booked_s.clear()  # rounding has left something
        self._forget(job.flow)

    def hold(self, flow: Flow, size_bytes: int) -> None:
        """Books memory that a call of several jobs holds, whether one of them is admitted or not."""
        for holdings in (self._flows.setdefault(flow, _Holdings()), self._all):
            holdings.size_bytes += size_bytes

    def release(self, flow: Flow, size_bytes: int) -> None:
        """The call holds it no longer."""
        for holdings in (self._flows[flow], self._all):
            holdings.size_bytes -= size_bytes
        self._forget(flow)

    def _forget(self, flow: Flow) -> None:
        held = self._flows[flow]
        if not (held.jobs or held.size_bytes):
            del self._flows[flow]

    def size_bytes(self, flow: Flow | None = None) -> int:
        """Memory that a caller's jobs hold, or all."""
        return self._of(flow).size_bytes

    def booked_s(self, lane: str, flow: Flow | None = None) -> float:
        """Computing time predicted for a caller's jobs, or all."""
        return self._of(flow).booked_s[lane]

    def ahead_s(self, flow: Flow, lane: str, own_s: float) -> float:
        """What is computed before and while a job of so much cost waits, if everybody gets the same share.

        Its caller's other jobs come first, and as much of every other caller.
        """
        until_done_s = self.booked_s(lane, flow) + own_s
        of_others = (it.booked_s[lane] for other, it in self._flows.items() if other != flow)
        return until_done_s - own_s + sum(min(other_s, until_done_s) for other_s in of_others)

    def _of(self, flow: Flow | None) -> _Holdings:
        return self._all if flow is None else self._flows.get(flow, _NOTHING)


class _Holdings:
    def __init__(self) -> None:
        self.jobs = 0
        self.size_bytes = 0
        self.booked_s: Counter[str] = Counter()


_NOTHING = _Holdings()
