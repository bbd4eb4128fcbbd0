"""What the queue handles: jobs, the steps that they need, and what a stage says of a job it has computed."""

from __future__ import annotations

import math
import threading
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from .fair import Flow
from .observer import Ending, Refusal


class Over(Exception):
    """Nobody wants the result of this job any more; raised within a stage, by `Job.check`, to end its computation."""


class Refused(Exception):
    """A job is not admitted.

    Attributes:
        reason: why.
        retry_after_s: when another try may succeed, seconds; None if the same job never will.
    """

    def __init__(self, reason: Refusal, message: str, retry_after_s: float | None = None) -> None:
        super().__init__(message)
        self.reason = reason
        self.retry_after_s = retry_after_s


class Expired(Exception):
    """The job's deadline passed."""


@dataclass(frozen=True)
class Stage:
    """One kind of computation.

    Attributes:
        name: of the stage.
        lane: the threads that compute it.
        then: the stage that usually follows; None for the last.
        max_batch: jobs that are computed together at the most.
    """

    name: str
    lane: str
    then: str | None = None
    max_batch: int = 1


@dataclass(frozen=True, eq=False)
class Step:
    """What a job needs next.

    Attributes:
        stage: which computation.
        kind: jobs of one kind cost about the same there.
        bucket: jobs of one bucket can be computed together.
        payload: what the stage computes with.
    """

    stage: str
    kind: str
    bucket: str
    payload: Any


@dataclass(frozen=True, eq=False)
class Done:
    """The job has ended well; `value` is its result."""

    value: Any
    ending: Ending = Ending.OK


@dataclass(frozen=True, eq=False)
class Fallback:
    """What is given if nothing better is there by `at_s` of the queue's clock."""

    give: Callable[[], Done]
    at_s: float


@dataclass(frozen=True, eq=False)
class Next:
    """The job needs another step. From now on the fallback, if any, stands for expiry."""

    step: Step
    fallback: Fallback | None = None


@dataclass(frozen=True)
class Visit:
    """A job's time in a stage, by the queue's clock.

    Attributes:
        stage: which.
        queued_s: when it began to wait.
        start_s: when it began to be computed, or its waiting ended for good.
        end_s: when that ended.
        batch: number of the batch; 0 if it was not computed.
        jobs: in it.
    """

    stage: str
    queued_s: float
    start_s: float
    end_s: float
    batch: int
    jobs: int


@dataclass(eq=False)
class Job:
    """A call's work, from admission to its one and only ending.

    Attributes:
        flow: whose it is.
        step: what it needs now.
        deadline_s: when its result is of no use any more, by the queue's clock.
        size_bytes: memory that it holds.
        on_end: told how it ended and with what: the result, or the exception.
        visits: the stages that it has been through.
        continues: whether it completes what other jobs of its call have computed; then it is always let in.
        used_s: computing time it has had so far.
        fallback: what stands for expiry.
        waits_since_s: when it began to wait for the step, by the queue's clock.
        booked_s: computing time that is still predicted for it, by lane.
        charged_s: computing time that its tenant was charged at admission.
        unusual_s: computing time of the batch at hand that tells nothing of the jobs to come; its stage says so.
        is_computed: whether it is in a batch.
        checked_s: when a stage last called `check`, `time.monotonic`: a sign of life of the thread that computes it.
        timer_s: the `due_s` that the schedule has noted.
    """

    flow: Flow
    step: Step
    deadline_s: float
    size_bytes: int
    on_end: Callable[[Ending, Any], None]
    visits: list[Visit] = field(default_factory=list)
    continues: bool = False
    used_s: float = 0.0
    fallback: Fallback | None = None
    waits_since_s: float = 0.0
    booked_s: Counter[str] = field(default_factory=Counter)
    charged_s: float = 0.0
    unusual_s: float = 0.0
    is_computed: bool = False
    checked_s: float = -math.inf
    timer_s: float = -math.inf
    _over: threading.Event = field(default_factory=threading.Event)

    @property
    def is_over(self) -> bool:
        """Whether it has ended; a stage may still be at it."""
        return self._over.is_set()

    @property
    def due_s(self) -> float:
        """When it is ended, whatever it is at."""
        return self.deadline_s if self.fallback is None else min(self.fallback.at_s, self.deadline_s)

    def check(self) -> None:
        """For stages, between their steps, from any thread: raises Over if nobody wants the result any more."""
        self.checked_s = time.monotonic()
        if self._over.is_set():
            raise Over

    def end(self, ending: Ending, value: Any) -> None:
        """For the schedule alone."""
        assert not self._over.is_set()
        self._over.set()
        self.on_end(ending, value)


@dataclass(frozen=True, eq=False)
class Batch:
    """Jobs that are computed together, of one stage and bucket.

    Attributes:
        stage: which.
        jobs: one at least.
        start_s: when it began, by the queue's clock.
        number: of the batch since the start.
    """

    stage: Stage
    jobs: tuple[Job, ...]
    start_s: float
    number: int


Verdict = Next | Done | Exception
"""What a stage says of one job."""
