"""What jobs cost: predicted by their kind, and booked while they are admitted."""

from __future__ import annotations

from collections import Counter, OrderedDict

from .jobs import Flow, Job

MAX_KINDS = 1000
FIRST_GUESS_S = 0.25
"""Predicted before anything is observed."""
MEMORY = 10
"""About so many of the last jobs of a kind count."""


class CostModel:
    """Predicts the computing time of a job in a stage: an average over jobs of its kind that favours recent ones."""

    def __init__(self) -> None:
        self._kinds: OrderedDict[tuple[str, str], tuple[int, float]] = OrderedDict()

    def forget(self) -> None:
        """Forgets all observations."""
        self._kinds.clear()

    def predict(self, stage: str, kind: str) -> float:
        """Seconds. For an unknown kind, the average over all kinds in the stage."""
        known = self._kinds.get((stage, kind)) or self._kinds.get((stage, ""))
        return FIRST_GUESS_S if known is None else known[1]

    def observe(self, stage: str, kind: str, seconds: float) -> None:
        """A job took so long; its share, if it was computed with others."""
        for key in ((stage, kind), (stage, "")):
            count, mean_s = self._kinds.pop(key, (0, 0.0))
            count = min(count + 1, MEMORY)
            self._kinds[key] = (count, mean_s + (seconds - mean_s) / count)
        while len(self._kinds) > MAX_KINDS:
            self._kinds.popitem(last=False)


class Ledger:
    """Predicted computing time, by lane, and memory of the admitted jobs: in total and per caller.

    Attributes:
        jobs: those that are admitted and have not ended.
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
        """Books memory that a call of several jobs holds beside them."""
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
        """Computing time before a new job of cost `own_s` is done, if all callers get equal shares.

        The caller's other jobs come first, and from every other caller as much as from this one.
        """
        until_done_s = self.booked_s(lane, flow) + own_s
        of_others = (it.booked_s[lane] for other, it in self._flows.items() if other != flow)
        return until_done_s - own_s + sum(min(other_s, until_done_s) for other_s in of_others)

    def _of(self, flow: Flow | None) -> _Holdings:
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
