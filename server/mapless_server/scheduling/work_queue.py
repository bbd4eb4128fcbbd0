"""The worker queue's hands: threads that compute what the schedule says, and callers who wait on the event loop."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from .fair import Flow
from .jobs import Batch, Job, Stage, Step, Verdict, Visit
from .observer import Ending, Observer
from .schedule import Quota, Schedule, ScheduleOptions

log = logging.getLogger(__name__)

Compute = Callable[[Sequence[Job]], Sequence[Verdict]]
"""Computes the step of jobs of one stage and bucket: a verdict for each, in their order. An exception that it raises
instead is put down to the guilty job alone, by computing them again in halves."""


class Failure(Enum):
    """What an exception of a stage means."""

    OF_REQUEST = Ending.REFUSED_INPUT
    """The caller's mistake."""
    OF_ITEM = Ending.FAILED
    """Ours, with this job; others may fare better."""
    OF_MEMORY = Ending.OUT_OF_MEMORY
    """Too much at a time."""
    OF_DEVICE = None
    """Nothing that is computed from now on is to be trusted."""


class Fatal(Exception):
    """The queue cannot go on; the message is one sentence for the operator."""


@dataclass(frozen=True)
class Lane:
    """Threads that compute some of the stages.

    Attributes:
        name: of the threads, too.
        threads: how many.
    """

    name: str
    threads: int


@dataclass(frozen=True)
class WorkQueueOptions:
    """Options of the work queue.

    Attributes:
        stall_limit_s: a batch that is computed for longer hangs: its thread is lost, and so, in the end, is the server.
        heartbeat_s: the queue looks after itself at least so often.
    """

    schedule: ScheduleOptions = field(default_factory=ScheduleOptions)
    stall_limit_s: float = 120.0
    heartbeat_s: float = 1.0

    def __post_init__(self) -> None:
        if not (self.stall_limit_s > 0 and self.heartbeat_s > 0):
            raise ValueError(f"senseless options: {self}")


class WorkQueue:
    """Computes jobs. All methods are called on one event loop."""

    def __init__(
        self,
        stages: Mapping[Stage, Compute],
        lanes: Sequence[Lane],
        options: WorkQueueOptions,
        observer: Observer,
        failure_of: Callable[[Exception], Failure] = lambda _: Failure.OF_ITEM,
        quota: Quota | None = None,
    ) -> None:
        """An idle queue; it begins to compute with `start`.

        Args:
            stages: in the order in which jobs go through them.
            lanes: those that the stages name.
            options: see there.
            observer: is told what happens.
            failure_of: what exceptions mean.
            quota: of tenants, if they have one.
        """
        self._options = options
        self._observer = observer
        self._failure_of = failure_of
        self._compute = {stage.name: compute for stage, compute in stages.items()}
        self._schedule = Schedule(
            list(stages),
            {lane.name: lane.threads for lane in lanes},
            options.schedule,
            observer,
            lambda error: failure_of(error).value or Ending.FAILED,
            quota,
        )
        self._pools = {lane.name: ThreadPoolExecutor(lane.threads, lane.name) for lane in lanes}
        self._computing: set[Batch] = set()
        self._wake = asyncio.Event()
        self._task: asyncio.Task[None] | None = None
        self.on_fatal: Callable[[Fatal], None] = lambda _: None
        self.heartbeat_s = time.monotonic()

    @property
    def job_count(self) -> int:
        """Those that are admitted and have not ended."""
        return len(self._schedule.jobs)

    def is_alive_within(self, limit_s: float) -> bool:
        """Whether what is admitted will be computed, as far as was seen in so many seconds."""
        runs = self._task is not None and not self._task.done()
        return runs and time.monotonic() - self.heartbeat_s < limit_s

    def start(self) -> None:
        """Begins to compute; the first job does so, too."""
        if self._task is None:
            self._task = asyncio.get_running_loop().create_task(self._run(), name="work queue")

    async def submit(self, flow: Flow, step: Step, deadline_s: float, size_bytes: int) -> tuple[Any, Sequence[Visit]]:
        """Lets a job in, and waits for it; whoever is cancelled while waiting gives up the job's place.

        Args:
            flow: whose job it is.
            step: its first.
            deadline_s: when its result is of no use any more, `time.monotonic`.
            size_bytes: memory that it holds.

        Returns:
            Its result, and the stages that it went through.

        Raises:
            Refused: there is no room for it.
            Expired: its deadline passed.
            Fatal: the queue has ended.
            Exception: whatever its stage gave for it.
        """
        self.start()
        future: asyncio.Future[Any] = asyncio.get_running_loop().create_future()

        def on_end(_: Ending, value: Any) -> None:
            if future.done():
                return
            if isinstance(value, Exception):
                future.set_exception(value)
            else:
                future.set_result(value)

        job = Job(flow, step, deadline_s, size_bytes, on_end)
        self._schedule.admit(job, time.monotonic())
        self._wake.set()
        try:
            return await future, job.visits
        finally:
            self._schedule.cancel(job, time.monotonic())  # unless it has ended

    def drain(self) -> None:
        """Lets nobody in any more."""
        self._schedule.drain()

    async def close(self) -> None:
        """Ends everything; returns when the threads are through with the step that they are at."""
        self._schedule.fail_all(Fatal("the server has stopped"), time.monotonic())
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        for pool in self._pools.values():
            await asyncio.to_thread(pool.shutdown, wait=True, cancel_futures=True)

    async def _run(self) -> None:
        loop = asyncio.get_running_loop()
        try:
            while True:
                self._wake.clear()
                now_s = self.heartbeat_s = time.monotonic()
                self._look_for_stalls(now_s)
                self._schedule.expire(now_s)
                self._start_batches(loop)
                due_s = self._schedule.next_due_s
                wait_s = self._options.heartbeat_s if due_s is None else min(due_s - now_s, self._options.heartbeat_s)
                timer = loop.call_later(max(0.0, wait_s), self._wake.set)
                await self._wake.wait()
                timer.cancel()
        except Exception as error:
            self._die(error)

    def _start_batches(self, loop: asyncio.AbstractEventLoop) -> None:
        for lane, pool in self._pools.items():
            while (batch := self._schedule.take(lane, time.monotonic())) is not None:
                self._computing.add(batch)
                pool.submit(self._compute_batch, batch, loop)

    def _compute_batch(self, batch: Batch, loop: asyncio.AbstractEventLoop) -> None:
        """In a lane's thread."""
        try:
            verdicts: list[Verdict] | BaseException = self._verdicts(batch.stage, batch.jobs)
        except BaseException as error:  # whatever it is, it must reach the loop, or nobody would hear of it
            verdicts = error
        loop.call_soon_threadsafe(self._completed, batch, verdicts, time.monotonic())

    def _completed(self, batch: Batch, verdicts: list[Verdict] | BaseException, now_s: float) -> None:
        self._computing.discard(batch)
        try:
            if isinstance(verdicts, BaseException):
                raise verdicts
            self._schedule.finish(batch, verdicts, now_s)
        except BaseException as error:
            self._die(error)
        self._wake.set()

    def _look_for_stalls(self, now_s: float) -> None:
        for batch in self._computing:
            if now_s - batch.start_s > self._options.stall_limit_s:
                raise Fatal(f"the stage {batch.stage.name} has computed for {now_s - batch.start_s:.0f} s: it hangs")

    def _die(self, error: BaseException) -> None:
        """Nothing will be computed any more: everybody is told, and so is the owner."""
        fatal = error if isinstance(error, Fatal) else Fatal(f"the work queue failed: {error!r}")
        log.critical("%s", fatal, exc_info=error)
        self._schedule.fail_all(fatal, time.monotonic())
        if self._task is not None:
            self._task.cancel()
        self.on_fatal(fatal)

    def _verdicts(self, stage: Stage, jobs: Sequence[Job]) -> list[Verdict]:
        """In a lane's thread: what the stage says of each job."""
        try:
            verdicts = list(self._compute[stage.name](jobs))
            if len(verdicts) != len(jobs):
                raise RuntimeError(f"the stage {stage.name} gave {len(verdicts)} verdicts for {len(jobs)} jobs")
        except Exception as error:
            failure = self._checked(error)
            if len(jobs) == 1:
                return [error]
            half = len(jobs) // 2
            if failure is Failure.OF_MEMORY:
                self._schedule.limit_batch(stage.name, jobs[0].step.bucket, half)
            log.warning("%s: %d jobs at a time failed, trying them in halves: %r", stage.name, len(jobs), error)
            return self._verdicts(stage, jobs[:half]) + self._verdicts(stage, jobs[half:])
        for verdict in verdicts:
            if isinstance(verdict, Exception):
                self._checked(verdict)
        return verdicts

    def _checked(self, error: Exception) -> Failure:
        """What the exception means; Fatal if nothing is to be trusted any more."""
        failure = self._failure_of(error)
        if failure is Failure.OF_MEMORY:
            self._observer.ran_out_of_memory()
        if failure is Failure.OF_DEVICE:
            raise Fatal(f"the device is lost: {error}") from error
        return failure
