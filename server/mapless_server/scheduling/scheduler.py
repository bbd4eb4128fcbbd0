"""The scheduler: admits jobs, selects what each thread computes next, and ends jobs whose deadline has passed.

A state machine without threads, waiting or a clock: times are passed in, so that it is tested on a virtual clock.
"""

import itertools
import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress

from .admission import Admission, Ledger, WorkQueueOptions
from .costs import CostModel, FirstSteps, StageCosts
from .expected import Expected
from .failing import FAILING, Failing
from .fair_queue import FairQueue, FurtherQueue, further
from .further import Further, When
from .jobs import (
    Abandoned,
    AnyFallback,
    AnyJob,
    AnyNext,
    AnyResult,
    AnyStep,
    Batch,
    Done,
    Ending,
    Expired,
    Flow,
    Next,
    Observer,
    Quota,
    Refusal,
    Refused,
    Stage,
    StageLoad,
    StageRecord,
)
from .lanes import BatchLimit, Lane
from .shares import Shares
from .timers import Timers

FIRST_STAGE_INTERVAL = 4
"""One of so many batches of a lane is of the first stage, if several stages wait."""


class Scheduler:
    """Manages jobs from admission to their end; not thread-safe."""

    def __init__(
        self,
        stages: Sequence[Stage],
        lanes: Mapping[str, int],
        options: WorkQueueOptions,
        observer: Observer,
        ending_of: Callable[[Exception], Ending] = lambda _: Ending.FAILED,
        quota: Quota | None = None,
        low: Mapping[str, int] | None = None,
    ) -> None:
        """Makes an idle scheduler.

        Args:
            stages: the stages, in the order in which jobs go through them.
            lanes: number of threads of each lane.
            options: options of the queue.
            observer: receives the events.
            ending_of: function that returns how a job ends whose stage returned this exception.
            quota: quota of the tenants; None if they are not limited.
            low: number of threads of low priority that lanes have besides, for what waits aside; None for none.
        """
        self.costs = CostModel()
        self._options = options
        self._observer = observer
        self._ending_of = ending_of
        self._quota = quota
        self._stages = {stage.name: stage for stage in stages}
        self._stage_costs = StageCosts(self.costs, self._stages)
        self.failing = Failing()
        self._shares = Shares()
        self._queues: dict[str, FairQueue[AnyJob]] = {stage.name: FairQueue(self._shares) for stage in stages}
        # Further steps of admitted jobs, which were not admitted with them.
        self._aside: dict[str, FurtherQueue[AnyJob]] = {it.name: FurtherQueue(self._shares) for it in stages}
        self._running: Counter[str] = Counter()
        self._lanes: dict[str, Lane] = {}
        for name, count in lanes.items():
            own = [stage for stage in stages if stage.lane == name]
            queues, aside = [self._queues[it.name] for it in own], [self._aside[it.name] for it in own]
            low_count = 0 if low is None else low.get(name, 0)
            self._lanes[name] = Lane(count, own, queues, aside, count, low_count, low_count)
        self._limits: dict[tuple[str, str], BatchLimit] = {}
        self._first_steps = FirstSteps()
        self._ledger = Ledger(self._shares)
        self._admission = Admission(options, lanes, self._ledger)
        self._further = Further(options, self._stages, self._lanes, self._stage_costs, self._ledger, self._admission)
        self._timers = Timers()
        self._batch_number = itertools.count(1)

    @property
    def jobs(self) -> frozenset[AnyJob]:
        """The jobs that are admitted and have not ended."""
        return frozenset(self._ledger.jobs)

    @property
    def backlog_s(self) -> float:
        """Predicted computing time of the jobs, per thread, of the lane with the most of it."""
        return max(self._ledger.booked_s(name) / lane.threads for name, lane in self._lanes.items())

    @property
    def busy_s(self) -> float:
        """Computing time so far, per thread, of the lane with the most of it."""
        return max(lane.busy_s / lane.threads for lane in self._lanes.values())

    @property
    def next_due_s(self) -> float | None:
        """Time of the next necessary call of `expire`; None if there is no job."""
        return self._timers.next_due_s

    def load(self, stage: str) -> StageLoad:
        """The jobs of a stage."""
        queue, aside = self._queues[stage], self._aside[stage]
        return StageLoad(len(queue) + len(aside), queue.cost_s, self._running[stage])

    def gets_cheap_steps(self, flow: Flow, now_s: float) -> bool:
        """Whether a caller's last photographs all failed, while others ask whose photographs do not."""
        others_ask = self._ledger.others_wait(flow) or self.failing.others_ask(flow, now_s)
        return others_ask and self.failing.is_to_be_cut(flow, now_s)

    def admit(self, job: AnyJob, now_s: float) -> None:
        """Admits a job, which then ends exactly once; raises Refused without any change."""
        if job.flow.caller != FAILING:  # else it was refused before
            job.owner = job.flow
        job.flow = self.failing.queued_as(job.owner, now_s)
        cost_s = self._stage_costs.of(job.step, job.flow, now_s)
        self.failing.asked(job.flow, now_s)
        if not job.continues:
            self._first_steps.remember(job.flow, job.step)
        with self._refusals_reported(job.flow, now_s):
            self._admission.check(job, cost_s, now_s)
            # The server's own jobs have no tenant and are free; a job that continues others is charged when it ends.
            if not job.continues:
                job.charged_s = self._charged(job.owner, cost_s.total(), now_s)
        self._observer.admitted(cost_s.total())
        self._ledger.open(job, self._admission.bookable(cost_s))
        if job.gives_way:
            self._ledger.set_aside(job)
        self._enqueue(job, cost_s.total(), now_s)

    def hold(self, flow: Flow, size_bytes: int, now_s: float) -> None:
        """Books memory that a call needs besides its jobs, until `release`; raises Refused if there is no room."""
        with self._refusals_reported(flow, now_s):
            self._admission.check_memory(flow, size_bytes)
        self._ledger.hold(flow, size_bytes)

    def release(self, flow: Flow, size_bytes: int) -> None:
        """Undoes `hold`."""
        self._ledger.release(flow, size_bytes)

    def check_room(self, flow: Flow, step: AnyStep, now_s: float) -> None:
        """Raises Refused if a caller's job would not be admitted, whatever its deadline.

        That is a job as the caller's last one with this stage as its first, or with this step if there was none.
        """
        owner, flow = flow, self.failing.queued_as(flow, now_s)
        step = self._first_steps.last(flow, step)
        with self._refusals_reported(flow, now_s):
            cost_s = self._stage_costs.of(step, flow, now_s)
            self._admission.check_queue(flow, cost_s)
            if (charged_s := self._charged(owner, cost_s.total(), now_s)) and self._quota is not None:
                self._quota.settle(owner.tenant, owner.named_caller, charged_s, 0.0, now_s)

    def _charged(self, owner: Flow, cost_s: float, now_s: float) -> float:
        """Charges a tenant with a predicted time and returns it; 0 for the server's own jobs, which have no tenant."""
        if self._quota is None or not owner.tenant:
            return 0.0
        wait_s = self._quota.charge(owner.tenant, owner.named_caller, cost_s, now_s)
        if wait_s > 0:
            raise Refused(Refusal.TENANT_QUOTA, "the tenant's computing time is used up", wait_s)
        return cost_s

    def has_work(self, lane_name: str, is_low: bool = False) -> bool:
        """Whether a job waits for an idle thread of a lane, of low priority or not."""
        return self._lanes[lane_name].has_work(is_low)

    def computes(self, lane_name: str) -> bool:
        """Whether a thread of a lane computes that is not of low priority; for threads without the queue's lock."""
        lane = self._lanes[lane_name]
        return lane.free < lane.threads

    def take(self, lane_name: str, now_s: float, is_low: bool = False) -> Batch | None:
        """Selects what a thread of a lane computes now; None if all threads are busy or no job waits.

        A thread of low priority computes what waits aside, and then no other thread of the lane does.
        """
        self.expire(now_s)
        lane = self._lanes[lane_name]
        if not lane.has_work(is_low):
            return None
        if is_low:
            stage = lane.first_aside()
            return None if stage is None else self._take_aside(lane, stage, lambda _: True, now_s, is_low=True)
        expected: Expected | None = None

        def is_allowed(job: AnyJob) -> bool:
            nonlocal expected
            waits_aside = job.begins_until_s is not None
            if not lane.has_one_left(waits_aside):
                return True
            step_s = self._stage_costs.of_step(job, now_s)
            if step_s <= self._options.quantum_s:
                return True
            expected = expected or Expected(lane.arrivals, self._shares, now_s)
            flow, long_s = (further(job.flow), math.inf) if waits_aside else (job.flow, step_s)
            return not (expected.shorter(flow, step_s) or expected.first(flow, long_s))

        waiting = [it for it, queue in zip(lane.stages, lane.queues, strict=True) if any(map(is_allowed, queue))]
        if not lane.low_threads and (aside := lane.stage_of_aside(is_allowed)) is not None:
            return self._take_aside(lane, aside, is_allowed, now_s)
        if not waiting:
            return None
        # Late stages first: jobs that have begun hold memory, and time has been spent on them.
        is_first_due = lane.passed_over >= FIRST_STAGE_INTERVAL - 1
        stage = waiting[0] if is_first_due else waiting[-1]
        lane.passed_over = 0 if stage is waiting[0] else lane.passed_over + 1
        jobs = self._pop_batch(self._queues[stage.name], stage, is_allowed, now_s)
        for job in jobs:
            self._observer.waited(stage.name, now_s - job.waits_since_s)
        return self._begin(lane, stage, jobs, now_s)

    def _take_aside(
        self, lane: Lane, stage: Stage, is_allowed: Callable[[AnyJob], bool], now_s: float, is_low: bool = False
    ) -> Batch:
        """Selects jobs that wait aside for a stage."""
        jobs = self._pop_batch(self._aside[stage.name], stage, is_allowed, now_s)
        for job in jobs:
            job.begins_until_s = None
            self._timers.set(job)
            if not job.gives_way:
                self._ledger.resume(job, self._admission.bookable(self._stage_costs.of(job.step, job.flow, now_s)))
        return self._begin(lane, stage, jobs, now_s, is_low)

    def _begin(self, lane: Lane, stage: Stage, jobs: tuple[AnyJob, ...], now_s: float, is_low: bool = False) -> Batch:
        for job in jobs:
            job.is_computed = True
        self._running[stage.name] += len(jobs)
        batch = Batch(stage, jobs, now_s, next(self._batch_number))
        lane.begin(batch.number, is_low)
        if not is_low and self._stage_costs.of_step(jobs[0], now_s) > self._options.quantum_s:
            lane.long[batch.number] = jobs[0].is_aside
        return batch

    def finish(self, batch: Batch, results: Sequence[AnyResult], now_s: float, processor_s: float = 0.0) -> None:
        """Handles the results of a batch: each of its jobs ends or continues, unless it has ended meanwhile.

        The batch took `processor_s` of processor time.
        """
        stage, seconds = batch.stage, now_s - batch.start_s
        lane = self._lanes[stage.lane]
        lane.finish(batch.number, seconds)
        self._running[stage.name] -= len(batch.jobs)
        bucket = batch.jobs[0].step.bucket
        self._observer.computed(stage.name, bucket, len(batch.jobs), seconds)
        if (limit := self._limits.get((stage.name, bucket))) is not None:
            limit.fitted(len(batch.jobs))
        unusual_s = max(job.unusual_s for job in batch.jobs)
        share_s = seconds / len(batch.jobs)
        for job, result in zip(batch.jobs, results, strict=True):
            # Failures are not learned from, since they come early; abandoned jobs only if they took long already.
            usual_s = max(0.0, seconds - unusual_s) / len(batch.jobs)
            is_slow = isinstance(result, Abandoned) and usual_s > self._stage_costs.of_step(job, now_s)
            if is_slow or not isinstance(result, Exception):
                self._stage_costs.learn(job, usual_s, isinstance(result, Done), now_s)
            self._charge(job, share_s - job.charged_step_s)
            job.is_aside = False
            job.used_s += share_s
            job.unusual_s = 0.0
            job.is_computed = False
            times_s = (job.waits_since_s, batch.start_s, now_s)
            spent_s = processor_s / len(batch.jobs)
            job.records.append(StageRecord(stage.name, *times_s, batch.number, len(batch.jobs), spent_s))
            if job.is_over:
                continue
            if isinstance(result, Next):
                self._continue(job, result, now_s)
            elif isinstance(result, Done):
                self._end(job, result.ending, result.value, now_s)
            else:
                self._end(job, self._ending_of(result), result, now_s)

    def cancel(self, job: AnyJob, now_s: float) -> None:
        """Ends a job whose caller does not wait for it any more."""
        if not job.is_over:
            self._end(job, Ending.CANCELLED, Abandoned(), now_s)

    def expire(self, now_s: float) -> None:
        """Ends the jobs that are due, waiting or being computed."""
        while (job := self._timers.pop_due(now_s)) is not None:
            if job.fallback is None:
                error = Expired("the deadline passed while the call waited or was computed")
                self._end(job, Ending.EXPIRED, error, now_s)
            else:
                self._give_fallback(job, job.fallback, now_s)

    def limit_batch(self, stage: str, bucket: str, failed: int) -> None:
        """Limits the number of jobs of a bucket that are computed together, because `failed` did not fit in memory.

        After some batches that fit one more is tried, since another program may have had the memory.
        """
        self._limits.setdefault((stage, bucket), BatchLimit(failed)).failed(failed)

    def drain(self) -> None:
        """Admits nothing from now on."""
        self._admission.close()

    def fail_all(self, error: Exception, now_s: float) -> None:
        """Ends all jobs, because nothing will be computed any more."""
        self._admission.close()
        try:
            for job in self.jobs:
                self._end(job, Ending.FAILED, error, now_s)
        finally:  # even if the observer raises
            for job in self.jobs:
                self._ledger.close(job)
                job.end(Ending.FAILED, error)

    @contextmanager
    def _refusals_reported(self, flow: Flow, now_s: float) -> Iterator[None]:
        try:
            yield
        except Refused as refused:
            if refused.reason in (Refusal.QUEUE_FULL, Refusal.TOO_MUCH_MEMORY):
                self._further.refused(flow, now_s)
            self._observer.refused(refused.reason)
            raise

    def _continue(self, job: AnyJob, result: AnyNext, now_s: float) -> None:
        """Queues a job for its next step, or ends it with its fallback; see `Next` and `Further`."""
        job.fallback = result.fallback
        if job.fallback is None:
            job.step = result.steps[0]
            cost_s = self._stage_costs.of(job.step, job.flow, now_s)
            in_order_s = cost_s.total()
            cost_s &= job.booked_s  # it was admitted for no more
        else:
            job.step, when, cost_s = self._further.choose(job, result, now_s)
            in_order_s = cost_s.total()
            if when is When.NEVER:
                self._give_fallback(job, job.fallback, now_s)
                return
            if when is When.ASIDE:
                self._ledger.set_aside(job)
                self._enqueue_aside(job, in_order_s, job.due_s - in_order_s, now_s)
                return
        self._ledger.rebook(job, self._admission.bookable(cost_s))
        self._enqueue(job, in_order_s, now_s)

    def _enqueue(self, job: AnyJob, cost_s: float, now_s: float) -> None:
        """Lets a job wait for its step; the cost includes later stages."""
        if job.gives_way or job.flow.caller == FAILING:
            self._enqueue_aside(job, cost_s, job.due_s, now_s)
            return
        job.waits_since_s = now_s
        self._queue_of(job).push(job, job.flow, cost_s)
        self._lanes[self._stages[job.step.stage].lane].arrivals.append((job.flow, cost_s, now_s))
        self._timers.set(job)

    def _enqueue_aside(self, job: AnyJob, cost_s: float, until_s: float, now_s: float) -> None:
        """Lets a job wait aside for its step, at most until a time."""
        job.is_aside = True
        job.begins_until_s = until_s
        job.waits_since_s = now_s
        self._queue_of(job).push(job, job.flow, cost_s)
        self._timers.set(job)

    def _queue_of(self, job: AnyJob) -> FairQueue[AnyJob]:
        """The queue in which a job waits for its step."""
        return (self._queues if job.begins_until_s is None else self._aside)[job.step.stage]

    def _pop_batch(
        self, queue: FairQueue[AnyJob], stage: Stage, is_allowed: Callable[[AnyJob], bool], now_s: float
    ) -> tuple[AnyJob, ...]:
        """Removes the next job and others to be computed with it, and charges for them what is predicted."""

        def charge(job: AnyJob) -> None:
            job.charged_step_s = self._stage_costs.of_step(job, now_s)
            self._charge(job, job.charged_step_s)

        jobs = [queue.pop(charge, is_allowed)]
        bucket = jobs[0].step.bucket
        limit = self._limits.get((stage.name, bucket))
        at_most = stage.max_batch if limit is None else min(stage.max_batch, limit.size)
        with suppress(IndexError):
            while len(jobs) < at_most:
                jobs.append(queue.pop(charge, lambda job: job.step.bucket == bucket))
        return tuple(jobs)

    def _charge(self, job: AnyJob, seconds: float) -> None:
        """Gives a job's client the computing time of its step, and all further steps together if it is one of them."""
        self._shares.charge(job.flow, seconds)
        if job.is_aside:
            self._shares.charge(further(job.flow), seconds, tenant_s=0.0)

    def _end(self, job: AnyJob, ending: Ending, value: object, now_s: float) -> None:
        stage, queue = self._stages[job.step.stage], self._queue_of(job)
        if job in queue:
            queue.remove(job)
            job.records.append(StageRecord(stage.name, job.waits_since_s, now_s, now_s, batch=0, jobs=0))
        self._ledger.close(job)
        job.end(ending, value)  # before the observer and the quota, which may raise
        if self._quota is not None and job.owner.tenant:
            # The batch that it is in has not been added to `used_s` yet.
            used_s = max(job.used_s, job.charged_s) if job.is_computed else job.used_s
            self._quota.settle(job.owner.tenant, job.owner.named_caller, job.charged_s, used_s, now_s)
        self._observer.ended(stage.name, ending)

    def _give_fallback(self, job: AnyJob, fallback: AnyFallback, now_s: float) -> None:
        done = fallback.make(job.step.payload)
        self._end(job, done.ending, done.value, now_s)
