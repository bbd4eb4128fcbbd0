"""Lanes of threads, and how many jobs of a bucket fit in memory together: what the scheduler keeps of them."""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from .fair_queue import FairQueue, FurtherQueue
from .jobs import AnyJob, Flow, Stage

_ARRIVALS = 64


@dataclass
class Lane:
    """A group of threads.

    Attributes:
        threads: number of threads.
        stages: the stages that they compute, in the order in which jobs go through them.
        queues: the jobs that wait for each of them.
        aside: those that wait for each until a thread would be idle otherwise, or their turn as one caller comes.
        free: number of idle threads.
        low_threads: number of threads besides, of low priority, which compute what waits aside; 0 if the others do.
        low_free: number of idle ones of them.
        passed_over: batches since the first stage that has waiting jobs was served.
        busy_s: sum of the threads' computing times so far, without those of low priority.
        long: numbers of the batches that the threads compute of which a step is predicted to take more than a quantum,
            and whether it is one that waited aside.
        low: numbers of the batches that threads of low priority compute.
        arrivals: for each of the last jobs that have come to wait, not aside: owner, predicted time with later stages,
            time of arrival.
    """

    threads: int
    stages: Sequence[Stage]
    queues: Sequence[FairQueue[AnyJob]]
    aside: Sequence[FurtherQueue[AnyJob]]
    free: int
    low_threads: int = 0
    low_free: int = 0
    passed_over: int = 0
    busy_s: float = 0.0
    long: dict[int, bool] = field(default_factory=dict)
    low: set[int] = field(default_factory=set)
    arrivals: deque[tuple[Flow, float, float]] = field(default_factory=lambda: deque(maxlen=_ARRIVALS))

    def has_work(self, is_low: bool) -> bool:
        """Whether a job waits for an idle thread, of low priority or not."""
        if is_low:
            return self.low_free > 0 and any(self.aside)
        return self.free > 0 and (any(self.queues) or (not self.low_threads and any(self.aside)))

    def begin(self, batch: int, is_low: bool) -> None:
        """Counts a batch that is computed from now on."""
        if is_low:
            self.low_free -= 1
            self.low.add(batch)
        else:
            self.free -= 1

    def finish(self, batch: int, seconds: float) -> None:
        """Undoes `begin`, after so long."""
        self.long.pop(batch, None)
        if batch in self.low:
            self.low.remove(batch)
            self.low_free += 1
        else:
            self.free += 1
            self.busy_s += seconds

    def first_aside(self) -> Stage | None:
        """The stage of the job aside whose turn it is among them; None if none waits."""
        turns = [(turn, -i) for i, it in enumerate(self.aside) if (turn := it.turn(lambda _: True))]
        return self.stages[-min(turns)[1]] if turns else None

    def stage_of_aside(self, is_allowed: Callable[[AnyJob], bool]) -> Stage | None:
        """The stage of the job aside whose turn it is; None if one that waits in order comes first, or none waits."""
        turns = [(turn, -i) for i, it in enumerate(self.aside) if (turn := it.turn(is_allowed))]
        in_order = [turn for it in self.queues if (turn := it.turn(is_allowed))]
        first = min(turns, default=None)
        return self.stages[-first[1]] if first and (not in_order or first[0] < min(in_order)) else None

    def has_one_left(self, waits_aside: bool) -> bool:
        """Whether all threads but one compute long steps.

        Those that waited aside count for others of them only: what was admitted does not wait because of them.
        """
        long = sum(waits_aside or not waited_aside for waited_aside in self.long.values())
        return long >= self.threads - 1 > 0


_TRY_LARGER_AFTER = 64
"""Batches of the size that a bucket is limited to, before a larger one is tried; twice as many after each trial."""


@dataclass
class BatchLimit:
    """The number of jobs of a bucket that fit in memory together.

    Attributes:
        size: the number.
        batches: batches of this size that have fitted since it changed.
        trials: how often a larger size was tried.
        fits: the size before the last trial, which had fitted; 0 before any, or if something has failed since.
    """

    size: int
    batches: int = 0
    trials: int = 0
    fits: int = 0

    def fitted(self, size: int) -> None:
        """Counts a batch; raises the limit by one when it has been kept for long enough."""
        self.batches += size == self.size
        if self.batches >= _TRY_LARGER_AFTER << min(self.trials, 10):
            self.size, self.batches, self.trials, self.fits = self.size + 1, 0, self.trials + 1, self.size

    def failed(self, size: int) -> None:
        """Lowers the limit, since a batch did not fit: to the size before the trial, otherwise to half of the batch."""
        lower = self.fits if 0 < self.fits < size else size // 2
        self.size, self.batches, self.fits = max(1, min(lower, self.size)), 0, 0
