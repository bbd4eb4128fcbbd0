"""The executor: threads that compute what the scheduler selects, and callers that wait on the event loop."""

import asyncio
import logging
import math
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from enum import Enum
from functools import partial

from .admission import WorkQueueOptions
from .jobs import (
    AnyJob,
    AnyResult,
    AnyStep,
    Batch,
    Ending,
    Flow,
    Job,
    Observer,
    PayloadT,
    Quota,
    Stage,
    StageLoad,
    ValueT,
)
from .processor import give_way, lower_priority, processor_s
from .scheduler import Scheduler

log = logging.getLogger(__name__)

ComputeBatch = Callable[[Sequence[AnyJob]], Sequence[AnyResult]]
"""Computes a step of jobs of one stage and bucket: a result for each, in order. If it raises instead, the batch is
computed again in halves, so that only the job that causes the exception fails."""

_Crew = tuple[str, bool]
"""Threads of a lane: those of low priority, or the others."""


class Failure(Enum):
    """Kinds of a stage's exceptions; the value is how the job ends."""

    BAD_INPUT = Ending.REFUSED_INPUT
    """The caller's error."""
    JOB_FAILED = Ending.FAILED
    """A server error with this job; other jobs may succeed."""
    OUT_OF_MEMORY = Ending.OUT_OF_MEMORY
    DEVICE_LOST = None
    """Nothing computed from now on can be trusted; the queue ends."""


class Fatal(Exception):
    """The queue cannot continue; the message is one sentence for the operator."""


class WorkQueue:
    """Computes jobs. Methods must be called on one event loop, unless stated otherwise.

    The threads take batches from the scheduler themselves: passing every step through the event loop would cost as much
    as a small step, and leave threads idle whenever the loop is busy.

    Attributes:
        on_fatal: called on the event loop when the queue cannot continue.
        heartbeat_s: time of the queue's last check of itself, by `time.monotonic`.
    """

    def __init__(
        self,
        stages: Mapping[Stage, ComputeBatch],
        lanes: Mapping[str, int],
        options: WorkQueueOptions,
        observer: Observer,
        failure_of: Callable[[Exception], Failure] = lambda _: Failure.JOB_FAILED,
        quota: Quota | None = None,
        low: Mapping[str, int] | None = None,
    ) -> None:
        """Makes an idle queue; arguments as of `Scheduler`, and `failure_of`, which classifies exceptions of stages."""
        self._options = options
        self._observer = observer
        self._failure_of = failure_of
        self._compute = {stage.name: compute for stage, compute in stages.items()}
        self._crews = {(lane, False): count for lane, count in lanes.items()}
        self._crews |= {(lane, True): count for lane, count in (low or {}).items()}

        def ending_of(error: Exception) -> Ending:
            return failure_of(error).value or Ending.FAILED

        self._scheduler = Scheduler(list(stages), lanes, options, observer, ending_of, quota, low)
        # Guards the scheduler; held for microseconds. Each crew's idle threads wait on a condition of it. The
        # event loop is called after a change: it wakes at once, and may need the lock next.
        self._lock = threading.Lock()
        self._for_loop: list[Callable[[], object]] = []
        self._wakes_threads = {crew: threading.Condition(self._lock) for crew in self._crews}
        self._computing: set[Batch] = set()
        self._threads: list[threading.Thread] = []
        self._is_closed = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._timer_task: asyncio.Task[None] | None = None
        self._wakes_timer = asyncio.Event()
        self._timer_at_s = math.inf
        self.on_fatal: Callable[[Fatal], None] = lambda _: None
        self.heartbeat_s = time.monotonic()

    @property
    def job_count(self) -> int:
        """Number of jobs that are admitted and have not ended."""
        with self._lock:
            return len(self._scheduler.jobs)

    @property
    def prompt_count(self) -> int:
        """Number of those of them that do not give way."""
        with self._lock:
            return sum(not job.gives_way for job in self._scheduler.jobs)

    @property
    def backlog_s(self) -> float:
        """Predicted computing time of the admitted jobs, per thread, of the lane with the most of it."""
        with self._lock:
            return self._scheduler.backlog_s

    @property
    def busy_s(self) -> float:
        """Computing time so far, per thread, of the lane with the most of it."""
        with self._lock:
            return self._scheduler.busy_s

    def load(self, stage: str) -> StageLoad:
        """The jobs of a stage."""
        with self._lock:
            return self._scheduler.load(stage)

    def is_alive_within(self, limit_s: float) -> bool:
        """Whether the queue runs and has checked itself within the last `limit_s` seconds."""
        runs = self._timer_task is not None and not self._timer_task.done() and not self._is_closed
        return runs and time.monotonic() - self.heartbeat_s < limit_s

    def start(self) -> None:
        """Starts the threads; the first job does so, too."""
        if self._timer_task is None:
            self._loop = asyncio.get_running_loop()
            self._timer_task = self._loop.create_task(self._run_timer(), name="work queue")
            self._threads = [
                threading.Thread(
                    target=self._run_thread, args=(crew,), name=f"{crew[0]}_{'low_' if crew[1] else ''}{i}", daemon=True
                )
                for crew, count in self._crews.items()
                for i in range(count)
            ]
            for thread in self._threads:
                thread.start()

    async def run(self, job: Job[PayloadT, ValueT]) -> ValueT:
        """Submits a job and waits for its result; cancelling the wait cancels the job.

        ValueError if the job has been run already; Refused if there is no room for it; Expired if its deadline passed;
        Fatal if the queue has ended; or the exception with which its stage failed.
        """
        if job.is_over:
            raise ValueError("a job that has ended cannot be run again")
        loop = asyncio.get_running_loop()
        future: asyncio.Future[ValueT] = loop.create_future()

        def on_end(_: Ending, value: ValueT | Exception) -> None:  # in whatever thread ends the job
            self._for_loop.append(partial(loop.call_soon_threadsafe, _resolve, future, value))

        job.on_end = on_end
        with self._changing():
            if job.continues and self._is_closed:
                raise Fatal("the server has stopped")
            self._scheduler.admit(job, time.monotonic())
            self._notify()
        self.start()
        try:
            return await future
        finally:
            if not job.is_over:
                with self._changing():
                    self._scheduler.cancel(job, time.monotonic())

    @contextmanager
    def hold(self, flow: Flow, size_bytes: int) -> Iterator[None]:
        """Books memory that a call of several jobs needs during the block; their own sizes then exclude it.

        Refused if there is no room for it.
        """
        with self._lock:
            self._scheduler.hold(flow, size_bytes, time.monotonic())
        try:
            yield
        finally:
            with self._lock:
                self._scheduler.release(flow, size_bytes)

    def check_room(self, flow: Flow, step: AnyStep) -> None:
        """Raises Refused if a caller's next job would not be admitted, whatever its deadline.

        It is taken for one like the last whose first step had the same stage, or with this step if there was none.
        """
        with self._lock:
            self._scheduler.check_room(flow, step, time.monotonic())

    def answered(self, flow: Flow, is_localized: bool) -> None:
        """Counts whether a caller's photograph was localized, see `Failing`."""
        with self._lock:
            self._scheduler.failing.answered(flow, is_localized, time.monotonic())

    def gets_cheap_steps(self, flow: Flow) -> bool:
        """Whether a caller's last photographs all failed, while others ask whose photographs do not."""
        with self._lock:
            return self._scheduler.gets_cheap_steps(flow, time.monotonic())

    def forget_costs(self) -> None:
        """Forgets the observed computing times, because those of later jobs will differ."""
        with self._lock:
            self._scheduler.costs.forget()

    def drain(self) -> None:
        """Refuses all new jobs; admitted ones are still computed."""
        with self._lock:
            self._scheduler.drain()

    async def close(self, limit_s: float = 30.0) -> None:
        """Ends all jobs and waits until the threads have finished their current step.

        A thread that takes longer than `limit_s` is abandoned: it ends with the process.
        """
        self._end_all(Fatal("the server has stopped"))
        if self._timer_task is not None:
            self._timer_task.cancel()
            await asyncio.gather(self._timer_task, return_exceptions=True)
        await asyncio.to_thread(self._join, time.monotonic() + limit_s)

    def _join(self, until_s: float) -> None:
        for thread in self._threads:
            thread.join(max(0.0, until_s - time.monotonic()))
            if thread.is_alive():
                log.error("the thread %s still computes and is left behind", thread.name)

    @contextmanager
    def _changing(self) -> Iterator[None]:
        """Holds the lock during a change of the scheduler; then makes the calls to the event loop that follow."""
        calls: list[Callable[[], object]] = []
        try:
            with self._lock:
                try:
                    yield
                finally:
                    calls, self._for_loop = self._for_loop, calls
        finally:
            for call in calls:
                call()

    def _end_all(self, error: Fatal) -> None:
        with self._changing():
            self._is_closed = True
            try:
                self._scheduler.fail_all(error, time.monotonic())
            finally:  # even if the scheduler fails
                for condition in self._wakes_threads.values():
                    condition.notify_all()

    async def _run_timer(self) -> None:
        """Ends due jobs, detects hanging threads, and wakes those that may compute more, until the queue is closed."""
        try:
            while True:
                self._wakes_timer.clear()
                with self._changing():
                    now_s = self.heartbeat_s = time.monotonic()
                    self._scheduler.expire(now_s)
                    self._check_for_stalls(now_s)
                    due_s = self._scheduler.next_due_s
                    self._timer_at_s = min(math.inf if due_s is None else due_s, now_s + self._options.heartbeat_s)
                    self._notify()  # steps that were held back for shorter ones, which may not have come
                timer = asyncio.get_running_loop().call_later(max(0.0, self._timer_at_s - now_s), self._wakes_timer.set)
                await self._wakes_timer.wait()
                timer.cancel()
        except Exception as error:
            self._fail(error)

    def _notify(self, own: _Crew | None = None) -> None:
        """Wakes threads that have work, and the timer, after a change of the scheduler; the caller has the lock.

        The calling thread's own crew is left out: that thread is about to take the next batch, and then wakes another
        one if there is more. A thread woken in vain costs two switches between threads.
        """
        for crew, condition in self._wakes_threads.items():
            if crew != own and self._scheduler.has_work(*crew):
                condition.notify()
        due_s = self._scheduler.next_due_s
        if due_s is not None and due_s < self._timer_at_s and self._loop is not None:
            self._timer_at_s = due_s
            self._for_loop.append(partial(self._loop.call_soon_threadsafe, self._wakes_timer.set))

    def _check_for_stalls(self, now_s: float) -> None:
        for batch in self._computing:
            silent_s = now_s - max(batch.start_s, *(job.checked_s for job in batch.jobs))
            if silent_s > self._options.stall_limit_s:
                raise Fatal(f"the stage {batch.stage.name} has computed for {silent_s:.0f} s in one step: it hangs")

    def _fail(self, error: BaseException) -> None:
        """Ends the queue: all jobs fail, and the owner is notified once."""
        if self._is_closed:
            return
        fatal = error if isinstance(error, Fatal) else Fatal(f"the work queue failed: {error!r}")
        log.critical("%s", fatal, exc_info=error)
        if self._timer_task is not None:
            self._timer_task.cancel()
        try:
            self._end_all(fatal)
        finally:
            self.on_fatal(fatal)

    def _run_thread(self, crew: _Crew) -> None:
        assert self._loop is not None
        try:
            if crew[1]:
                lower_priority(partial(self._scheduler.computes, crew[0]))
            while (batch := self._next_batch(crew)) is not None:
                begin_s = processor_s()
                results = self._compute_batch(batch.stage, batch.jobs)
                spent_s = processor_s() - begin_s
                with self._changing():
                    self._computing.discard(batch)
                    self._scheduler.finish(batch, results, time.monotonic(), spent_s)
                    self._notify(crew)
                # An idle thread must not keep photographs and tensors alive.
                del batch, results
                give_way(math.inf)
        except BaseException as error:  # SystemExit too: the queue must not go on without this thread
            self._loop.call_soon_threadsafe(self._fail, error)

    def _next_batch(self, crew: _Crew) -> Batch | None:
        """Waits for the next batch; None when the queue is closed."""
        while True:
            with self._changing():
                if self._is_closed:
                    return None
                lane, is_low = crew
                batch = self._scheduler.take(lane, time.monotonic(), is_low)
                if batch is not None:
                    self._computing.add(batch)
                    if self._scheduler.has_work(*crew):
                        self._wakes_threads[crew].notify()
                    return batch
                if not self._for_loop:  # jobs that are due have ended, otherwise
                    self._wakes_threads[crew].wait()

    def _compute_batch(self, stage: Stage, jobs: Sequence[AnyJob]) -> list[AnyResult]:
        """Computes the stage's result for each job; if the stage raises, computes halves of the batch."""
        try:
            results = list(self._compute[stage.name](jobs))
            if len(results) != len(jobs):
                raise RuntimeError(f"the stage {stage.name} returned {len(results)} results for {len(jobs)} jobs")
        except Exception as error:
            failure = self._classify(error)
            if len(jobs) == 1:
                return [error]
            # As text, since log records may be kept, and with the exception its tensors.
            log.warning("%s: %d jobs together failed, trying them in halves: %s", stage.name, len(jobs), repr(error))
        else:
            for result in results:
                if isinstance(result, Exception):
                    self._classify(result)
            return results
        # Outside of the handler the exception is freed, and with it the failed attempt's tensors.
        half = len(jobs) // 2
        if failure is Failure.OUT_OF_MEMORY:
            with self._lock:
                self._scheduler.limit_batch(stage.name, jobs[0].step.bucket, len(jobs))
        return self._compute_batch(stage, jobs[:half]) + self._compute_batch(stage, jobs[half:])

    def _classify(self, error: Exception) -> Failure:
        """Classifies an exception; raises Fatal if the device is lost."""
        failure = self._failure_of(error)
        if failure is Failure.OUT_OF_MEMORY:
            self._observer.ran_out_of_memory()
        if failure is Failure.DEVICE_LOST:
            raise Fatal(f"the device is lost: {error}") from error
        return failure


def _resolve(future: asyncio.Future[ValueT], value: ValueT | Exception) -> None:
    if future.done():
        return
    if isinstance(value, StopIteration):  # which a future does not accept
        value = RuntimeError(f"the stage raised {value!r}")
    if isinstance(value, Exception):
        future.set_exception(value)
    else:
        future.set_result(value)
