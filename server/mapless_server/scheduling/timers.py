"""When jobs are due: what the scheduler has to end next, and when."""

import heapq
import itertools
import weakref

from .jobs import AnyJob

_OUTDATED = 16
"""So many outdated timers are kept in any case, so that they are not swept out too often."""


class Timers:
    """The jobs by the times at which they are due.

    With weak references, because a job holds photographs and must be freed when it ends, not when it is due.
    """

    def __init__(self) -> None:
        self._due: list[tuple[float, int, weakref.ref[AnyJob]]] = []
        self._tick = itertools.count()
        self._sweeps_at = _OUTDATED

    @property
    def next_due_s(self) -> float | None:
        """The next time at which a job is due; None if there is no job."""
        while self._due:
            due_s, _, reference = self._due[0]
            if _is_current(due_s, reference()):
                return due_s
            heapq.heappop(self._due)
        return None

    def pop_due(self, now_s: float) -> AnyJob | None:
        """Removes and returns the next job that is due; None if none is."""
        due_s = self.next_due_s
        return heapq.heappop(self._due)[2]() if due_s is not None and due_s <= now_s else None

    def set(self, job: AnyJob) -> None:
        """Adds a job, or moves it to the time at which it is due now."""
        if job.timer_s == job.due_s:
            return
        job.timer_s = job.due_s
        heapq.heappush(self._due, (job.due_s, next(self._tick), weakref.ref(job)))
        if len(self._due) > self._sweeps_at:  # else they would be kept until they are due
            self._due = [it for it in self._due if _is_current(it[0], it[2]())]
            heapq.heapify(self._due)
            self._sweeps_at = 2 * len(self._due) + _OUTDATED


def _is_current(due_s: float, job: AnyJob | None) -> bool:
    """Whether this timer's job has not ended, and is not due at another time now."""
    return job is not None and not job.is_over and job.due_s == due_s
