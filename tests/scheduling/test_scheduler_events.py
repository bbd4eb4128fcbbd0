"""In any order of events every job that the scheduler has admitted ends once, and nothing starves."""

from collections import Counter

from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from support.toy_scheduler import COST_S, LANES, OPTIONS, STAGES, Toy, onward, run_through

from mapless_server.scheduling import AnyJob, AnyResult, Done, Ending, Fallback, Refused
from mapless_server.scheduling.jobs import Batch

AT_MOST = 3
"""Times the bound: each of three callers may book all of it while it has been given less than the others."""


class Events(RuleBasedStateMachine):
    """Any order of arrivals, batches, failures, cancellations and passing time."""

    @initialize()
    def begin(self) -> None:
        self.toy = Toy()
        self.batches: list[Batch] = []
        self.admitted: list[AnyJob] = []
        self.refused = 0

    @rule(
        client=st.sampled_from(["a", "b", "c"]),
        lasts_s=st.floats(0.05, 6.0),
        size_bytes=st.integers(1, 400),
        stage=st.sampled_from(["describe", "prepare"]),
        bucket=st.sampled_from(["x", "y"]),
    )
    def arrive(self, client: str, lasts_s: float, size_bytes: int, stage: str, bucket: str) -> None:
        idle = not self.toy.scheduler.jobs
        job = self.toy.job(client, self.toy.now_s + lasts_s, size_bytes, stage, bucket)
        try:
            self.toy.scheduler.admit(job, self.toy.now_s)
        except Refused:
            assert not idle
            assert not job.is_over
            self.refused += 1
            return
        self.admitted.append(job)
        if not idle:
            for lane, threads in LANES.items():
                booked_s = sum(it.booked_s[lane] for it in self.toy.scheduler.jobs)
                assert booked_s <= AT_MOST * OPTIONS.max_queued_s * threads + 0.9  # one that an idle server tried
            assert sum(it.size_bytes for it in self.toy.scheduler.jobs) <= OPTIONS.max_bytes

    @rule(lane=st.sampled_from(sorted(LANES)))
    def compute(self, lane: str) -> None:
        batch = self.toy.scheduler.take(lane, self.toy.now_s)
        if batch is None:
            running = sum(it.stage.lane == lane for it in self.batches)
            waiting = [job for job in self.toy.scheduler.jobs if self._waits(job, lane)]
            assert running == LANES[lane] or not waiting or 0 < running == LANES[lane] - 1  # kept for short jobs
            return
        assert len(batch.jobs) <= batch.stage.max_batch
        for job in batch.jobs:
            assert not job.is_over
            assert self.toy.now_s < job.deadline_s
        self.batches.append(batch)

    @precondition(lambda self: self.batches)
    @rule(data=st.data())
    def complete(self, data: st.DataObject) -> None:
        batch = self.batches.pop(data.draw(st.integers(0, len(self.batches) - 1)))
        verdicts: list[AnyResult] = []
        for job in batch.jobs:
            fate = data.draw(st.sampled_from(["onward", "onward", "done", "fails", "fallback"]))
            due_s = self.toy.now_s + data.draw(st.floats(0.0, 3.0))
            fallback = (
                Fallback[object, object](lambda _: Done("coarse", Ending.DEGRADED), due_s)
                if fate == "fallback"
                else None
            )
            planted: dict[str, AnyResult] = {"done": Done(None), "fails": ValueError("planted")}
            verdicts.append(planted.get(fate) or onward(job, fallback))
        self.toy.scheduler.finish(batch, verdicts, self.toy.now_s)

    @precondition(lambda self: self.toy.scheduler.jobs)
    @rule(data=st.data())
    def cancel(self, data: st.DataObject) -> None:
        jobs = sorted(self.toy.scheduler.jobs, key=self.toy.jobs.index)
        self.toy.scheduler.cancel(data.draw(st.sampled_from(jobs)), self.toy.now_s)

    @rule(seconds=st.floats(0.0, 1.0), timer_is_late=st.booleans())
    def wait(self, seconds: float, timer_is_late: bool) -> None:
        self.toy.now_s += seconds
        if not timer_is_late:
            self.toy.scheduler.expire(self.toy.now_s)
            assert all(self.toy.now_s < job.due_s for job in self.toy.scheduler.jobs)

    def _waits(self, job: AnyJob, lane: str) -> bool:
        of_lane = {stage.name for stage in STAGES if stage.lane == lane}
        return job.step.stage in of_lane and not any(job in batch.jobs for batch in self.batches)

    @invariant()
    def every_admitted_job_has_ended_once_or_is_alive(self) -> None:
        alive = self.toy.scheduler.jobs
        for job in self.admitted:
            ends = self.toy.ends[self.toy.jobs.index(job)]
            assert len(ends) == (job not in alive)
        assert self.toy.observer.admissions == len(self.admitted)
        assert self.toy.observer.refusals.total() == self.refused
        assert self.toy.observer.endings.total() == len(self.admitted) - len(alive)

    @invariant()
    def what_it_reports_is_so(self) -> None:
        waiting = Counter(
            job.step.stage for job in self.toy.scheduler.jobs if not any(job in it.jobs for it in self.batches)
        )
        running = Counter(job_stage for it in self.batches for job_stage in [it.stage.name] * len(it.jobs))
        for stage in COST_S:
            load = self.toy.scheduler.load(stage)
            assert (load.waiting, load.running) == (waiting[stage], running[stage])

    def teardown(self) -> None:
        """Nothing starves: let alone, everything comes to its end."""
        if not hasattr(self, "toy"):
            return
        for batch in self.batches:
            self.toy.scheduler.finish(batch, [onward(job) for job in batch.jobs], self.toy.now_s)
        run_through(self.toy)
        assert not self.toy.scheduler.jobs
        assert all(job.is_over for job in self.admitted)
        assert not any(job.booked_s for job in self.admitted)


TestEvents = Events.TestCase
TestEvents.settings = hypothesis_settings(max_examples=75, stateful_step_count=60, deadline=None)
