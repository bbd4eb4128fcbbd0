"""The worker queue's mind: who is admitted, what is computed next, who has waited in vain.

A state machine without threads, waiting or clock: times are passed in, so that it is tested on a virtual clock.
"""

from __future__ import annotations

import heapq
import itertools
import weakref
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

from .admission import Admission, ScheduleOptions
from .costs import Costs
from .fair import FairQueue, Flow
from .jobs import Batch, Done, Expired, Fallback, Job, Next, Over, Refused, Stage, Step, Verdict, Visit
from .ledger import Ledger
from .observer import Ending, Observer, Refusal

_TRY_ONE_IN = 8

_NOBODY = Flow("", "")
"""A caller without jobs."""

_ENDED_LISTED = 16


class Quota(Protocol):
    """Limits tenants to a rate of computing."""

    def charge(self, tenant: str, cost_s: float, now_s: float) -> float:
        """Books predicted computing time; if there is no room, books nothing and says how long to wait, seconds."""
        ...

    def settle(self, tenant: str, predicted_s: float, actual_s: float, now_s: float) -> None:
        """Replaces what was booked by what was used."""
        ...


@dataclass
class _Lane:
    """Threads, and the stages that they compute, the first one first.

    Attributes:
        threads: how many.
        stages: in the order in which jobs go through them.
        free: threads that have nothing to do.
        passed_over: batches since an earlier stage than the one served had its turn.
        busy_s: what the threads have computed so far, in sum.
    """

    threads: int
    stages: list[Stage]
    free: int
    passed_over: int = 0
    busy_s: float = 0.0


class Schedule:
    """Jobs between admission and their end. Not safe to use from several threads."""

    def __init__(
        self,
        stages: Sequence[Stage],
        lanes: Mapping[str, int],
        options: ScheduleOptions,
        observer: Observer,
        ending_of: Callable[[Exception], Ending] = lambda _: Ending.FAILED,
        quota: Quota | None = None,
    ) -> None:
        """The schedule of an idle server.

        Args:
            stages: in the order in which jobs go through them.
            lanes: number of threads of each.
            options: see there.
            observer: is told what happens.
            ending_of: how a job ends for which its stage gives this exception.
            quota: of tenants, if they have one.
        """
        self.costs = Costs()
        self._options = options
        self._observer = observer
        self._ending_of = ending_of
        self._quota = quota
        self._stages = {stage.name: stage for stage in stages}
        self._queues: dict[str, FairQueue[Job]] = {stage.name: FairQueue(options.quantum_s) for stage in stages}
        self._running: Counter[str] = Counter()
        self._lanes = {
            name: _Lane(count, [stage for stage in stages if stage.lane == name], count)
            for name, count in lanes.items()
        }
        self._max_batch: dict[tuple[str, str], int] = {}
        self._declined: Counter[tuple[str, str]] = Counter()
        self._ledger = Ledger()
        self._admission = Admission(options, lanes, self._ledger)
        # By reference: a job that has ended holds photographs, and must not be held until it would have been due.
        self._due: list[tuple[float, int, weakref.ref[Job]]] = []
        self._tick = itertools.count()
        self._batch_number = itertools.count(1)

    @property
    def jobs(self) -> frozenset[Job]:
        """Those that are admitted and have not ended."""
        return frozenset(self._ledger.jobs)

    @property
    def backlog_s(self) -> float:
        """Computing time predicted for the jobs, of the lane that has most of it a thread."""
        return max(self._ledger.booked_s(name) / lane.threads for name, lane in self._lanes.items())

    @property
    def busy_s(self) -> float:
        """What has been computed so far, of the lane that has computed most a thread."""
        return max(lane.busy_s / lane.threads for lane in self._lanes.values())

    @property
    def next_due_s(self) -> float | None:
        """When `expire` is to be called next; None if there is no job."""
        while self._due:
            due_s, _, reference = self._due[0]
            job = reference()
            if job is not None and not job.is_over and job.due_s == due_s:
                return due_s
            heapq.heappop(self._due)  # it ended, or is due at another time by now
        return None

    def admit(self, job: Job, now_s: float) -> None:
        """Lets a job in, which from then on ends exactly once; Refused, with nothing changed, if there is no room."""
        cost_s = self._predict(job.step)
        try:
            self._admission.check(job, cost_s, now_s)
            # Nobody's jobs, the server's own, are free; what continues others is charged what it took, when it ends.
            if self._quota is not None and job.flow.tenant and not job.continues:
                job.charged_s = cost_s.total()
                wait_s = self._quota.charge(job.flow.tenant, job.charged_s, now_s)
                if wait_s > 0:
                    raise Refused(Refusal.TENANT_QUOTA, "the tenant's computing time is used up", wait_s)
        except Refused as refused:
            self._observer.refused(refused.reason)
            raise
        self._observer.admitted(cost_s.total())
        self._ledger.open(job, cost_s)
        self._enqueue(job, now_s)

    def hold(self, flow: Flow, size_bytes: int) -> None:
        """Books memory that a call holds until it is released, beside its jobs; Refused if there is no room."""
        try:
            self._admission.check_memory(flow, size_bytes)
        except Refused as refused:
            self._observer.refused(refused.reason)
            raise
        self._ledger.hold(flow, size_bytes)

    def release(self, flow: Flow, size_bytes: int) -> None:
        """A call holds its memory no longer."""
        self._ledger.release(flow, size_bytes)

    def check_room(self, step: Step) -> None:
        """Raises Refused if even a caller with no other jobs would not be admitted with a job that begins like this."""
        try:
            self._admission.check_queue(_NOBODY, self._predict(step))
        except Refused as refused:
            self._observer.refused(refused.reason)
            raise

    def take(self, lane_name: str, now_s: float) -> Batch | None:
        """What a free thread of a lane computes now; None if all are busy or nothing waits."""
        self.expire(now_s)
        lane = self._lanes[lane_name]
        waiting = [stage for stage in lane.stages if self._queues[stage.name]]
        if not (lane.free and waiting):
            return None
        # What is begun is finished first: it holds memory, and time has been spent on it.
        stage = waiting[0] if lane.passed_over >= self._options.floor - 1 else waiting[-1]
        lane.passed_over = 0 if stage is waiting[0] else lane.passed_over + 1
        lane.free -= 1
        jobs = self._pop_batch(stage)
        for job in jobs:
            job.is_computed = True
            self._observer.waited(stage.name, now_s - job.waits_since_s)
        self._running[stage.name] += len(jobs)
        self._tell(stage)
        return Batch(stage, jobs, now_s, next(self._batch_number))

    def finish(self, batch: Batch, verdicts: Sequence[Verdict], now_s: float) -> None:
        """A batch was computed: each of its jobs ends or goes on, unless it has ended meanwhile."""
        stage, seconds = batch.stage, now_s - batch.start_s
        lane = self._lanes[stage.lane]
        lane.free += 1
        lane.busy_s += seconds
        self._running[stage.name] -= len(batch.jobs)
        self._observer.computed(stage.name, batch.jobs[0].step.bucket, len(batch.jobs), seconds)
        unusual_s = max(job.unusual_s for job in batch.jobs)
        share_s = seconds / len(batch.jobs)
        for job, verdict in zip(batch.jobs, verdicts, strict=True):
            # What fails, fails early. What was given up would have taken longer yet.
            usual_s = max(0.0, seconds - unusual_s) / len(batch.jobs)
            longer = isinstance(verdict, Over) and usual_s > self.costs.predict(stage.name, job.step.kind)
            if longer or not isinstance(verdict, Exception):
                self.costs.observe(stage.name, job.step.kind, usual_s)
            job.used_s += share_s
            job.unusual_s = 0.0
            job.is_computed = False
            job.visits.append(Visit(stage.name, job.waits_since_s, batch.start_s, now_s, batch.number, len(batch.jobs)))
            if job.is_over:
                continue
            if isinstance(verdict, Next):
                self._go_on(job, verdict, now_s)
            elif isinstance(verdict, Done):
                self._end(job, verdict.ending, verdict.value, now_s)
            else:
                self._end(job, self._ending_of(verdict), verdict, now_s)
        self._tell(stage)

    def cancel(self, job: Job, now_s: float) -> None:
        """Nobody waits for a job any more."""
        if not job.is_over:
            self._end(job, Ending.CANCELLED, None, now_s)

    def expire(self, now_s: float) -> None:
        """Ends the jobs whose time is over, wherever they are."""
        while (due_s := self.next_due_s) is not None and due_s <= now_s:
            job = heapq.heappop(self._due)[2]()
            assert job is not None
            if job.fallback is None:
                self._end(
                    job, Ending.EXPIRED, Expired("the deadline passed while the call waited or was computed"), now_s
                )
            else:
                self._give_fallback(job, job.fallback, now_s)

    def limit_batch(self, stage: str, bucket: str, size: int) -> None:
        """From now on no more jobs of a bucket are computed together: more did not fit the device."""
        self._max_batch[stage, bucket] = max(1, min(size, self._max_batch.get((stage, bucket), size)))

    def drain(self) -> None:
        """Admits nothing from now on."""
        self._admission.close()

    def fail_all(self, error: Exception, now_s: float) -> None:
        """Ends every job, because nothing will be computed any more."""
        self._admission.close()
        try:
            for job in self.jobs:
                self._end(job, Ending.FAILED, error, now_s)
        finally:  # it may be the observer that is broken
            for job in self.jobs:
                self._ledger.close(job)
                job.end(Ending.FAILED, error)

    def _predict(self, step: Step) -> Counter[str]:
        """Computing time of a step and of those that usually follow, by lane."""
        cost_s: Counter[str] = Counter()
        stage: Stage | None = self._stages[step.stage]
        while stage is not None:
            cost_s[stage.lane] += self.costs.predict(stage.name, step.kind)  # type: ignore[assignment]  # not int
            stage = self._stages[stage.then] if stage.then else None
        return cost_s

    def _go_on(self, job: Job, verdict: Next, now_s: float) -> None:
        """Lets a job wait for its next step, or gives what is at hand if that would come too late or cost too much."""
        job.step, job.fallback = verdict.step, verdict.fallback
        cost_s = self._predict(job.step)
        if job.fallback is None:
            cost_s &= job.booked_s  # it was admitted for no more
        elif not self._is_worthwhile(job, cost_s, now_s) and not self._tries_anyway(job.step):
            self._give_fallback(job, job.fallback, now_s)
            return
        self._ledger.rebook(job, cost_s)
        self._enqueue(job, now_s)

    def _is_worthwhile(self, job: Job, cost_s: Counter[str], now_s: float) -> bool:
        """Whether a job's next step fits the bounds, and its result will be there before the job is due."""
        lane_name = self._stages[job.step.stage].lane
        lane = self._lanes[lane_name]
        coming_first = lane.stages[lane.stages.index(self._stages[job.step.stage]) :]
        wait_s = sum(
            self.costs.predict(stage.name, other.step.kind)
            for stage in coming_first
            for other in self._queues[stage.name]
        )
        return self._admission.fits(job, cost_s) and now_s + wait_s / lane.threads + cost_s.total() <= job.due_s

    def _tries_anyway(self, step: Step) -> bool:
        """One in so many: only what is computed mends a prediction, and the fallback is given in time all the same."""
        self._declined[step.stage, step.kind] += 1
        return self._declined[step.stage, step.kind] % _TRY_ONE_IN == 0

    def _enqueue(self, job: Job, now_s: float) -> None:
        stage = self._stages[job.step.stage]
        job.waits_since_s = now_s
        # Its whole way counts, not this stage alone: where the first one is cheap, whoever comes in order comes first.
        self._queues[stage.name].push(job, job.flow, self._predict(job.step).total())
        if job.timer_s != job.due_s:
            job.timer_s = job.due_s
            heapq.heappush(self._due, (job.due_s, next(self._tick), weakref.ref(job)))
            self._forget_ended()
        self._tell(stage)

    def _forget_ended(self) -> None:
        """Keeps the list of what is due about as long as that of the jobs."""
        if len(self._due) > 2 * len(self._ledger.jobs) + _ENDED_LISTED:
            alive = {id(job) for job in self._ledger.jobs}
            self._due = [entry for entry in self._due if id(entry[2]()) in alive]
            heapq.heapify(self._due)

    def _pop_batch(self, stage: Stage) -> tuple[Job, ...]:
        queue = self._queues[stage.name]
        first = queue.pop()
        bucket = first.step.bucket
        at_most = min(stage.max_batch, self._max_batch.get((stage.name, bucket), stage.max_batch))
        return (first, *queue.pop_alike(lambda job: job.step.bucket == bucket, at_most - 1))

    def _end(self, job: Job, ending: Ending, value: Any, now_s: float) -> None:
        stage = self._stages[job.step.stage]
        waits = job in self._queues[stage.name]
        if waits:
            self._queues[stage.name].remove(job)
            job.visits.append(Visit(stage.name, job.waits_since_s, now_s, now_s, batch=0, jobs=0))
        self._ledger.close(job)
        job.end(ending, value)  # before anybody else is told, who may fail
        if waits:
            self._tell(stage)
        if self._quota is not None and job.flow.tenant:
            # What is computed just now was not counted yet.
            used_s = max(job.used_s, job.charged_s) if job.is_computed else job.used_s
            self._quota.settle(job.flow.tenant, job.charged_s, used_s, now_s)
        self._observer.ended(stage.name, ending)

    def _give_fallback(self, job: Job, fallback: Fallback, now_s: float) -> None:
        done = fallback.give()
        self._end(job, done.ending, done.value, now_s)

    def _tell(self, stage: Stage) -> None:
        queue = self._queues[stage.name]
        self._observer.queued(stage.name, len(queue), queue.cost_s)
        self._observer.running(stage.name, self._running[stage.name])
