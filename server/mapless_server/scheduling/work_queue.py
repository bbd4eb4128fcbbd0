"""The worker queue's hands: threads that compute what the schedule says, and callers who wait on the event loop."""

from __future__ import annotations

import asyncio
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from enum import Enum
from typing import Any

from .admission import ScheduleOptions
from .fair import Flow
from .jobs import Batch, Job, Stage, Step, Verdict, Visit
from .observer import Ending, Observer
from .schedule import Quota, Schedule

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
        stall_limit_s: a batch of which nothing is heard for longer, neither its end nor a job's `check`, hangs: its
            thread is lost, and so, in the end, is the server.
        heartbeat_s: the queue looks after itself at least so often.
    """

    schedule: ScheduleOptions = field(default_factory=ScheduleOptions)
    stall_limit_s: float = 120.0
    heartbeat_s: float = 1.0

    def __post_init__(self) -> None:
        if not (self.stall_limit_s > 0 and self.heartbeat_s > 0):
            raise ValueError(f"senseless options: {self}")


class WorkQueue:
    """Computes jobs. Its methods are called on one event loop, but for those that say otherwise.

    The threads take what they compute from the schedule themselves, one at a time: going through the event loop for
    every step would cost as much as a small step does, and leave threads idle whenever the loop is busy.
    """

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
        self._lanes = tuple(lanes)
        self._schedule = Schedule(
            list(stages),
            {lane.name: lane.threads for lane in lanes},
            options.schedule,
            observer,
            lambda error: failure_of(error).value or Ending.FAILED,
            quota,
        )
        # Whoever touches the schedule holds it, for microseconds; each lane's idle threads wait for news.
        self._lock = threading.Lock()
        self._news = {lane.name: threading.Condition(self._lock) for lane in lanes}
        self._computing: set[Batch] = set()
        self._threads: list[threading.Thread] = []
        self._is_closed = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._task: asyncio.Task[None] | None = None
        self._wake = asyncio.Event()
        self._wakes_at_s = math.inf
        self.on_fatal: Callable[[Fatal], None] = lambda _: None
        self.heartbeat_s = time.monotonic()

    @property
    def job_count(self) -> int:
        """Those that are admitted and have not ended."""
        with self._lock:
            return len(self._schedule.jobs)

    @property
    def backlog_s(self) -> float:
        """Computing time predicted for what is admitted and has not ended, of the lane that has most of it a thread."""
        with self._lock:
            return self._schedule.backlog_s

    @property
    def busy_s(self) -> float:
        """Seconds of computing so far, of the lane that has computed most a thread."""
        with self._lock:
            return self._schedule.busy_s

    def is_alive_within(self, limit_s: float) -> bool:
        """Whether what is admitted will be computed, as far as was seen in so many seconds."""
        runs = self._task is not None and not self._task.done() and not self._is_closed
        return runs and time.monotonic() - self.heartbeat_s < limit_s

    def start(self) -> None:
        """Begins to compute; the first job does so, too."""
        if self._task is None:
            self._loop = asyncio.get_running_loop()
            self._task = self._loop.create_task(self._keep_time(), name="work queue")
            self._threads = [
                threading.Thread(target=self._work, args=(lane.name,), name=f"{lane.name}_{i}", daemon=True)
                for lane in self._lanes
                for i in range(lane.threads)
            ]
            for thread in self._threads:
                thread.start()

    async def submit(
        self,
        flow: Flow,
        step: Step,
        deadline_s: float,
        size_bytes: int,
        visits: list[Visit] | None = None,
        *,
        continues: bool = False,
    ) -> tuple[Any, Sequence[Visit]]:
        """Lets a job in, and waits for it; whoever is cancelled while waiting gives up the job's place.

        Args:
            flow: whose job it is.
            step: its first.
            deadline_s: when its result is of no use any more, `time.monotonic`.
            size_bytes: memory that it holds.
            visits: gets the stages that it goes through, for who wants to know how far it came if it fails.
            continues: whether it completes what other jobs of the same call have computed: then it is let in however
                full the queue is, and while the server drains, since else all that was in vain.

        Returns:
            Its result, and the stages that it went through.

        Raises:
            Refused: there is no room for it.
            Expired: its deadline passed.
            Fatal: the queue has ended.
            Exception: whatever its stage gave for it.
        """
        loop = asyncio.get_running_loop()
        future: asyncio.Future[Any] = loop.create_future()

        def on_end(_: Ending, value: Any) -> None:  # in whatever thread ends the job
            loop.call_soon_threadsafe(_resolve, future, value)

        job = Job(flow, step, deadline_s, size_bytes, on_end, [] if visits is None else visits, continues)
        with self._lock:
            if continues and self._is_closed:
                raise Fatal("the server has stopped")
            self._schedule.admit(job, time.monotonic())
            self._spread_news()
        self.start()
        try:
            return await future, job.visits
        finally:
            if not job.is_over:
                with self._lock:
                    self._schedule.cancel(job, time.monotonic())

    @contextmanager
    def hold(self, flow: Flow, size_bytes: int) -> Iterator[None]:
        """Books memory that a call of several jobs holds all the while, which its jobs then need not say.

        Raises:
            Refused: there is no room for it.
        """
        with self._lock:
            self._schedule.hold(flow, size_bytes)
        try:
            yield
        finally:
            with self._lock:
                self._schedule.release(flow, size_bytes)

    def check_room(self, step: Step) -> None:
        """Raises Refused if nobody would be admitted who began with a step like this."""
        with self._lock:
            self._schedule.check_room(step)

    def forget_costs(self) -> None:
        """What was computed up to now tells nothing of what is to come."""
        with self._lock:
            self._schedule.costs.forget()

    def drain(self) -> None:
        """Lets nobody in any more."""
        with self._lock:
            self._schedule.drain()

    async def close(self, limit_s: float = 30.0) -> None:
        """Ends everything; returns when the threads are through with the step that they are at.

        A thread that is not by then is left behind: it ends with the process.
        """
        self._end_all(Fatal("the server has stopped"))
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        await asyncio.to_thread(self._join, time.monotonic() + limit_s)

    def _join(self, until_s: float) -> None:
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))
            if thread.is_alive():
                log.error("the thread %s still computes and is left behind", thread.name)

    def _end_all(self, error: Fatal) -> None:
        with self._lock:
            self._is_closed = True
            try:
                self._schedule.fail_all(error, time.monotonic())
            finally:  # it may be the schedule that is broken
                for news in self._news.values():
                    news.notify_all()

    async def _keep_time(self) -> None:
        """Ends what is due and looks for threads that hang, as long as the queue lives."""
        try:
            while True:
                self._wake.clear()
                with self._lock:
                    now_s = self.heartbeat_s = time.monotonic()
                    self._schedule.expire(now_s)
                    self._look_for_stalls(now_s)
                    due_s = self._schedule.next_due_s
                    self._wakes_at_s = min(math.inf if due_s is None else due_s, now_s + self._options.heartbeat_s)
                timer = asyncio.get_running_loop().call_later(max(0.0, self._wakes_at_s - now_s), self._wake.set)
                await self._wake.wait()
                timer.cancel()
        except Exception as error:
            self._die(error)

    def _spread_news(self) -> None:
        """With the lock held, after the schedule has changed: wakes who has something to do now."""
        for news in self._news.values():
            news.notify()
        due_s = self._schedule.next_due_s
        if due_s is not None and due_s < self._wakes_at_s and self._loop is not None:
            self._wakes_at_s = due_s
            self._loop.call_soon_threadsafe(self._wake.set)

    def _look_for_stalls(self, now_s: float) -> None:
        for batch in self._computing:
            silent_s = now_s - max(batch.start_s, *(job.checked_s for job in batch.jobs))
            if silent_s > self._options.stall_limit_s:
                raise Fatal(f"the stage {batch.stage.name} has computed for {silent_s:.0f} s in one step: it hangs")

    def _die(self, error: BaseException) -> None:
        """Nothing will be computed any more: everybody is told, and so is the owner."""
        if self._is_closed:
            return
        fatal = error if isinstance(error, Fatal) else Fatal(f"the work queue failed: {error!r}")
        log.critical("%s", fatal, exc_info=error)
        if self._task is not None:
            self._task.cancel()
        try:
            self._end_all(fatal)
        finally:
            self.on_fatal(fatal)

    def _work(self, lane: str) -> None:
        """A lane's thread."""
        assert self._loop is not None
        try:
            while (batch := self._next_batch(lane)) is not None:
                verdicts = self._verdicts(batch.stage, batch.jobs)
                with self._lock:
                    self._computing.discard(batch)
                    self._schedule.finish(batch, verdicts, time.monotonic())
                    self._spread_news()
                # What a thread that waits for news still holds is not freed.
                del batch, verdicts
        except BaseException as error:  # whatever it is, it must be heard of
            self._loop.call_soon_threadsafe(self._die, error)

    def _next_batch(self, lane: str) -> Batch | None:
        """What is to be computed next, as soon as there is something; None if there will be nothing any more."""
        with self._lock:
            while not self._is_closed:
                batch = self._schedule.take(lane, time.monotonic())
                if batch is not None:
                    self._computing.add(batch)
                    self._news[lane].notify()  # one piece of news may be work for several
                    return batch
                self._news[lane].wait()
        return None

    def _verdicts(self, stage: Stage, jobs: Sequence[Job]) -> list[Verdict]:
        """What the stage says of each job."""
        try:
            verdicts = list(self._compute[stage.name](jobs))
            if len(verdicts) != len(jobs):
                raise RuntimeError(f"the stage {stage.name} gave {len(verdicts)} verdicts for {len(jobs)} jobs")
        except Exception as error:
            failure = self._checked(error)
            if len(jobs) == 1:
                return [error]
            log.warning("%s: %d jobs at a time failed, trying them in halves: %s", stage.name, len(jobs), repr(error))
        else:
            for verdict in verdicts:
                if isinstance(verdict, Exception):
                    self._checked(verdict)
            return verdicts
        # Out here the exception is gone, and with it what the failed attempt held of the device's memory.
        half = len(jobs) // 2
        if failure is Failure.OF_MEMORY:
            with self._lock:
                self._schedule.limit_batch(stage.name, jobs[0].step.bucket, half)
        return self._verdicts(stage, jobs[:half]) + self._verdicts(stage, jobs[half:])

    def _checked(self, error: Exception) -> Failure:
        """What the exception means; Fatal if nothing is to be trusted any more."""
        failure = self._failure_of(error)
        if failure is Failure.OF_MEMORY:
            self._observer.ran_out_of_memory()
        if failure is Failure.OF_DEVICE:
            raise Fatal(f"the device is lost: {error}") from error
        return failure


def _resolve(future: asyncio.Future[Any], value: Any) -> None:
    if future.done():
        return
    if isinstance(value, StopIteration):  # which a future takes for its own
        value = RuntimeError(f"the stage raised {value!r}")
    if isinstance(value, Exception):
        future.set_exception(value)
    else:
        future.set_result(value)
