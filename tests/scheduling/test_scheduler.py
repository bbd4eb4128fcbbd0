"""Laws of the scheduler, on a virtual clock with toy stages, in any order of events."""

import gc
import itertools
import math
import weakref
from collections import Counter
from contextlib import suppress
from typing import Any

import numpy as np
import pytest
from hypothesis import settings as hypothesis_settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, precondition, rule
from support.queues import CountingObserver

from mapless_server.scheduling import (
    Abandoned,
    Done,
    Ending,
    Expired,
    Fallback,
    Flow,
    Job,
    Next,
    Refusal,
    Refused,
    Stage,
    StageResult,
    Step,
    WorkQueueOptions,
)
from mapless_server.scheduling.jobs import Batch
from mapless_server.scheduling.scheduler import Scheduler

STAGES = [
    Stage("describe", "host"),
    Stage("prepare", "host", "coarse"),
    Stage("coarse", "device", "refine", max_batch=3),
    Stage("refine", "host"),
]
LANES = {"host": 2, "device": 1}
COST_S = {"describe": 0.5, "prepare": 0.1, "coarse": 0.3, "refine": 0.2}
OPTIONS = WorkQueueOptions(max_queued_s=2.0, max_bytes=1000, quantum_s=0.2)
FAR_S = 1e6


class PlantedQuota:
    """Admits so many jobs, and keeps what is charged and settled."""

    def __init__(self, admitted: float = math.inf) -> None:
        self.admitted = admitted
        self.charged: list[float] = []
        self.settled: list[tuple[float, float]] = []

    def charge(self, tenant: str, cost_s: float, now_s: float) -> float:
        self.charged.append(cost_s)
        return 0.0 if len(self.charged) <= self.admitted else 7.0

    def settle(self, tenant: str, predicted_s: float, actual_s: float, now_s: float) -> None:
        self.settled.append((predicted_s, actual_s))


class Toy:
    """A scheduler that has learned what its stages cost, and its jobs."""

    def __init__(self, options: WorkQueueOptions = OPTIONS, quota: Any = None) -> None:
        self.observer = CountingObserver()
        self.scheduler = Scheduler(STAGES, LANES, options, self.observer, quota=quota)
        self.ends: dict[int, list[tuple[Ending, Any]]] = {}
        self.jobs: list[Job] = []
        self.now_s = 0.0
        for stage, cost_s in COST_S.items():
            self.learn(stage, "toy", cost_s)

    def learn(self, stage: str, kind: str, cost_s: float, client: str = "earlier") -> None:
        self.scheduler.costs.observe(stage, kind, Flow("t", client), cost_s, self.now_s)

    def job(
        self,
        client: str = "c",
        deadline_s: float = FAR_S,
        size_bytes: int = 1,
        stage: str = "prepare",
        bucket: str = "b",
    ) -> Job:
        number = len(self.jobs)
        ends = self.ends[number] = []
        step = Step(stage, "toy", bucket, number)
        job = Job(Flow("t", client), step, deadline_s, size_bytes, lambda ending, value: ends.append((ending, value)))
        self.jobs.append(job)
        return job

    def admit(self, **what: Any) -> Job:
        job = self.job(**what)
        self.scheduler.admit(job, self.now_s)
        return job

    def ending_of(self, job: Job) -> Ending | None:
        ends = self.ends[self.jobs.index(job)]
        assert len(ends) <= 1
        return ends[0][0] if ends else None

    def take(self, lane: str) -> Batch:
        batch = self.scheduler.take(lane, self.now_s)
        assert batch is not None
        return batch

    def finish(self, batch: Batch, *verdicts: StageResult, seconds: float | None = None) -> None:
        cost_s = COST_S[batch.stage.name] * len(batch.jobs)  # so that predictions stay what they are
        self.now_s = max(self.now_s, batch.start_s + (cost_s if seconds is None else seconds))
        self.scheduler.finish(batch, verdicts, self.now_s)

    def fill(self, client: str = "many") -> None:
        """Admits jobs of a caller until one is refused."""
        with suppress(Refused):
            while True:
                self.admit(client=client)

    def refusal(self, **what: Any) -> Refused:
        with pytest.raises(Refused) as caught:
            self.admit(**what)
        return caught.value


def onward(job: Job, fallback: Fallback | None = None) -> StageResult:
    """To the stage that usually follows."""
    stage = next(it for it in STAGES if it.name == job.step.stage)
    if stage.then is None:
        return Done("result")
    return Next(Step(stage.then, "toy", job.step.bucket, job.step.payload), fallback)


def run_through(toy: Toy) -> None:
    """Computes until nothing waits."""
    for _ in range(1000):
        batches = [batch for lane in LANES if (batch := toy.scheduler.take(lane, toy.now_s)) is not None]
        if not batches:
            return
        for batch in batches:
            toy.finish(batch, *map(onward, batch.jobs))
    raise AssertionError("it never ends")


class TestAdmission:
    def test_a_queue_is_bounded_by_time_with_room_for_a_new_caller(self) -> None:
        toy = Toy()
        for _ in range(5):
            toy.admit(client="greedy")
        refused = toy.refusal(client="greedy")
        assert refused.reason is Refusal.QUEUE_FULL
        assert refused.retry_after_s is not None
        assert refused.retry_after_s > 0
        # The device is what there is least of: 0.3 s each, and three quarters of 2 s.
        toy.scheduler.check_room(Flow("t", "another"), toy.jobs[0].step, toy.now_s)
        with pytest.raises(Refused, match="as much is admitted already"):
            toy.scheduler.check_room(toy.jobs[0].flow, toy.jobs[0].step, toy.now_s)
        toy.admit(client="another")

    def test_a_job_is_booked_for_no_more_than_it_was_admitted_for(self) -> None:
        toy = Toy()
        job = toy.admit()
        toy.finish(toy.take("host"), onward(job))
        for _ in range(100):
            toy.learn("refine", "toy", 9.0)
        toy.finish(toy.take("device"), onward(job))
        assert job.booked_s["host"] == pytest.approx(COST_S["refine"])

    def test_memory_is_bounded(self) -> None:
        toy = Toy()
        toy.admit(size_bytes=700)
        assert toy.refusal(size_bytes=100).reason is Refusal.TOO_MUCH_MEMORY
        toy.admit(size_bytes=100, client="another")
        too_large = toy.refusal(size_bytes=1001)
        assert (too_large.reason, too_large.retry_after_s) == (Refusal.TOO_LARGE, None)

    def test_what_cannot_be_done_in_time_is_refused_at_once(self) -> None:
        toy = Toy()
        for _ in range(3):
            toy.admit()
        late = toy.refusal(deadline_s=1.0)
        assert late.reason is Refusal.DEADLINE_INFEASIBLE
        assert late.retry_after_s is not None
        assert "after the deadline, by about 0.8 s" in str(late)
        hopeless = toy.refusal(deadline_s=0.5)  # 0.6 s of computing alone
        assert (hopeless.reason, hopeless.retry_after_s) == (Refusal.DEADLINE_INFEASIBLE, None)
        toy.admit(deadline_s=2.5)

    def test_an_idle_server_admits_jobs_of_infeasible_prediction(self) -> None:
        """Else a prediction that is wrong once would be wrong for ever."""
        Toy().admit(deadline_s=0.01)

    def test_a_light_caller_is_not_refused_for_a_heavy_ones_queue(self) -> None:
        toy = Toy()
        for _ in range(5):
            toy.admit(client="heavy")
        assert toy.refusal(client="heavy", deadline_s=1.7).reason is Refusal.QUEUE_FULL
        toy.admit(client="light", deadline_s=1.7)

    def test_an_expensive_caller_prices_no_other_out(self) -> None:
        toy = Toy()
        for _ in range(20):
            toy.learn("prepare", "toy", 9.0, "expensive")
        toy.learn("prepare", "toy", 0.1, "light")
        for client in ("expensive", "also expensive", "third"):
            toy.admit(client=client)
        step = toy.jobs[0].step
        toy.scheduler.check_room(Flow("t", "light"), step, toy.now_s)
        toy.admit(client="light", deadline_s=8.0)
        refused = toy.refusal(client="expensive")
        assert refused.reason is Refusal.QUEUE_FULL
        assert str(refused).endswith("; this caller's jobs in it: 1")

    def test_a_prediction_of_one_caller_is_forgotten(self) -> None:
        """While it is refused, nothing corrects it."""
        toy = Toy()
        toy.learn("prepare", "toy", 20.0, "c")
        toy.admit(client="another")
        assert toy.refusal(deadline_s=3.0).reason is Refusal.DEADLINE_INFEASIBLE
        toy.now_s = 31.0
        toy.admit(deadline_s=34.0)

    def test_stages_that_jobs_do_not_reach_cost_them_nothing(self) -> None:
        toy = Toy()
        for _ in range(30):
            toy.admit(client="tracked")
            toy.finish(toy.take("host"), Done("result"))
        job = toy.admit(client="tracked")
        assert job.booked_s["host"] == pytest.approx(COST_S["prepare"], rel=0.1)
        assert job.booked_s["device"] == pytest.approx(0.0, abs=0.02)
        certain = toy.admit(stage="refine", client="tracked")
        assert certain.booked_s["host"] == pytest.approx(COST_S["refine"], rel=0.1)

    def test_no_job_is_admitted_while_draining(self) -> None:
        toy = Toy()
        before = toy.admit()
        toy.scheduler.drain()
        assert toy.refusal().reason is Refusal.DRAINING
        run_through(toy)
        assert toy.ending_of(before) is Ending.OK

    def test_a_tenant_pays_for_what_it_used(self) -> None:
        quota = PlantedQuota(admitted=2)
        toy = Toy(quota=quota)
        toy.admit()
        cancelled = toy.admit()
        refused = toy.refusal()
        assert (refused.reason, refused.retry_after_s) == (Refusal.TENANT_QUOTA, 7.0)
        toy.scheduler.cancel(cancelled, toy.now_s)
        run_through(toy)
        own = toy.job()
        own.flow = Flow("", "the server's own")
        toy.scheduler.admit(own, toy.now_s)
        run_through(toy)
        np.testing.assert_allclose(quota.settled, [(0.6, 0.0), (0.6, 0.6)])


class TestOrder:
    def test_begun_jobs_finish_first_without_starving_others(self) -> None:
        toy = Toy(WorkQueueOptions(max_queued_s=1000))
        for _ in range(12):
            toy.admit(stage="refine")
            toy.admit(stage="prepare")
        order = []
        for _ in range(12):
            batch = toy.take("host")
            order.append(batch.stage.name)
            toy.finish(batch, Done(None))
        assert order == ["refine", "refine", "refine", "prepare"] * 3

    def test_a_short_step_does_not_wait_for_long_ones(self) -> None:
        """Of two threads one computes a long step at a time, while shorter ones keep coming."""
        toy = Toy()
        toy.learn("prepare", "toy", 9.0, "long")
        toy.learn("prepare", "toy", 9.0, "long too")
        first, second = toy.admit(client="long"), toy.admit(client="long too")
        toy.admit(client="short", stage="describe")
        batches = [toy.take("host"), toy.take("host")]
        assert {batch.jobs[0].flow.client for batch in batches} == {"short", "long"}
        toy.finish(next(it for it in batches if it.stage.name == "describe"), Done(None))
        assert toy.scheduler.take("host", toy.now_s) is None
        toy.now_s = 10.0  # none has come for as long as it takes
        assert toy.take("host").jobs == (second,)
        assert not first.is_over

    def test_steps_of_a_quantum_leave_no_thread_idle(self) -> None:
        toy = Toy()
        toy.scheduler.costs.forget()
        toy.learn("describe", "toy", 0.001, "short")
        for client in ("long", "long too"):
            toy.learn("prepare", "toy", OPTIONS.quantum_s, client)
            toy.admit(client=client)
        toy.admit(client="short", stage="describe")
        assert [toy.take("host").stage.name for _ in range(2)] == ["prepare", "prepare"]

    def test_a_batch_is_of_one_bucket_and_as_large_as_what_waits(self) -> None:
        toy = Toy(WorkQueueOptions(max_queued_s=1000))
        for i in range(8):
            toy.admit(stage="coarse", bucket="ab"[i % 2], client=str(i))
        sizes = []
        while (batch := toy.scheduler.take("device", toy.now_s)) is not None:
            assert len({job.step.bucket for job in batch.jobs}) == 1
            sizes.append(len(batch.jobs))
            toy.finish(batch, *(Done(None) for _ in batch.jobs))
        assert sizes == [3, 3, 1, 1]
        assert toy.scheduler.load("coarse") == (0, 0.0, 0)

    def test_a_larger_batch_is_tried_again_ever_more_rarely(self) -> None:
        toy = Toy(WorkQueueOptions(max_queued_s=1e9))
        toy.scheduler.limit_batch("coarse", "b", 2)
        sizes: list[int] = []
        for _ in range(300):
            for _ in range(4):
                toy.admit(stage="coarse", deadline_s=1e9)
            while (batch := toy.scheduler.take("device", toy.now_s)) is not None:
                sizes.append(len(batch.jobs))
                if len(batch.jobs) > 1:  # it does not fit, and its halves do
                    toy.scheduler.limit_batch("coarse", "b", len(batch.jobs))
                toy.finish(batch, *[Done("result")] * len(batch.jobs))
        large = [i for i, size in enumerate(sizes) if size > 1]
        between = [later - earlier - 1 for earlier, later in itertools.pairwise([-1, *large])]
        assert between == [64, 128, 256, 512]
        assert set(sizes) == {1, 2}


class TestTime:
    def test_a_job_expires_at_its_deadline_where_it_waits(self) -> None:
        toy = Toy()
        job = toy.admit(deadline_s=5.0)
        assert toy.scheduler.next_due_s == 5.0
        toy.scheduler.expire(4.99)
        assert toy.ending_of(job) is None
        toy.scheduler.expire(5.0)
        assert job.is_over
        assert isinstance(toy.ends[0][0][1], Expired)
        assert toy.scheduler.take("host", 5.0) is None
        assert not toy.scheduler.jobs

    def test_while_it_is_computed_its_result_is_dropped(self) -> None:
        toy = Toy()
        job = toy.admit(deadline_s=5.0)
        batch = toy.take("host")
        job.check()
        toy.scheduler.expire(6.0)
        assert toy.ending_of(job) is Ending.EXPIRED
        assert job.is_over
        toy.finish(batch, onward(job), seconds=7.0)
        assert toy.scheduler.take("device", toy.now_s) is None
        assert not toy.scheduler.jobs

    def test_what_has_ended_is_released_whenever_it_was_due(self) -> None:
        """A job holds photographs; a deadline may be minutes away, and another's nearer."""
        toy = Toy()
        toy.admit(deadline_s=1e4)
        ended = []
        for _ in range(10):
            job = toy.admit(stage="describe", deadline_s=1e5)
            ended.append(weakref.ref(job))
            toy.scheduler.cancel(job, toy.now_s)
        del job
        toy.jobs.clear()
        gc.collect()
        assert not any(reference() is not None for reference in ended)

    @pytest.mark.parametrize(("seconds", "learns"), [(2.0, True), (0.001, False)])
    def test_an_expired_job_raises_the_predicted_cost(self, seconds: float, learns: bool) -> None:
        """Else a server that is too slow for its callers would go on admitting them."""
        toy = Toy()
        toy.admit(stage="describe")
        toy.finish(toy.take("host"), Abandoned(), seconds=seconds)
        predicted_s = toy.scheduler.costs.predict("describe", "toy", Flow("t", "c"), toy.now_s)
        assert predicted_s > COST_S["describe"] if learns else predicted_s == COST_S["describe"]

    def test_a_cancelled_job_frees_its_place(self) -> None:
        toy = Toy()
        jobs = [toy.admit() for _ in range(5)]
        assert toy.refusal().reason is Refusal.QUEUE_FULL
        toy.scheduler.cancel(jobs[2], toy.now_s)
        toy.scheduler.cancel(jobs[2], toy.now_s)  # nothing more happens
        toy.admit()
        assert toy.ending_of(jobs[2]) is Ending.CANCELLED

    def test_what_is_known_is_given_when_the_rest_comes_too_late(self) -> None:
        toy = Toy()
        job = toy.admit(stage="coarse", deadline_s=5.0)
        fallback = Fallback(lambda: Done("coarse", Ending.DEGRADED), 4.5)
        toy.finish(toy.take("device"), onward(job, fallback))
        assert toy.scheduler.next_due_s == 4.5
        toy.take("host")
        toy.scheduler.expire(4.5)
        assert toy.ends[0] == [(Ending.DEGRADED, "coarse")]

    def test_a_prediction_that_is_wrong_does_not_stay_so(self) -> None:
        """What is not computed teaches nothing: so, now and then, what seems useless is computed all the same."""
        toy = Toy()
        for _ in range(20):
            toy.learn("refine", "toy", 30.0)
        refined = 0
        for _ in range(300):
            job = toy.admit(stage="coarse", deadline_s=toy.now_s + 2.0)
            fallback = Fallback(lambda: Done("coarse", Ending.DEGRADED), job.deadline_s - 0.1)
            toy.finish(toy.take("device"), onward(job, fallback))
            if not job.is_over:
                toy.finish(toy.take("host"), onward(job))
            refined += toy.ending_of(job) is Ending.OK
            toy.now_s += 1.0
        assert refined > 50
        assert toy.ending_of(job) is Ending.OK

    def test_a_job_cancelled_while_computed_is_charged(self) -> None:
        quota = PlantedQuota()
        toy = Toy(quota=quota)
        toy.admit(deadline_s=5.0)
        toy.take("host")
        toy.scheduler.expire(5.0)
        ((predicted_s, actual_s),) = quota.settled
        assert actual_s == predicted_s > 0

    def again(self, toy: Toy, kind: str, others: int, due_s: float = 150.0) -> Job:
        """A job that needs more than it was admitted with, as when stronger features are to be tried."""
        toy.learn("prepare", "slow", 50.0)
        job = toy.admit(stage="refine", client="mine", deadline_s=200.0)
        for i in range(others):
            toy.admit(client=f"other {i}")
        again = Step("prepare", kind, "b", "again")
        toy.finish(toy.take("host"), Next(again, Fallback(lambda: Done("first"), due_s)))
        return job

    @pytest.mark.parametrize(
        ("kind", "others", "is_last"), [("toy", 0, False), ("toy", 6, True), ("slow", 0, False), ("slow", 1, True)]
    )
    def test_more_than_admitted_waits_for_an_idle_thread(self, kind: str, others: int, is_last: bool) -> None:
        """Where others have the room; the only job is computed whatever it costs, as it is admitted."""
        toy = Toy()
        job = self.again(toy, kind, others)
        assert (toy.ending_of(job), bool(job.booked_s)) == (None, not is_last)
        order = []
        while toy.scheduler.has_work("host"):
            batch = toy.take("host")
            order += [*batch.jobs]
            toy.finish(batch, *(Done(None) for _ in batch.jobs))
        assert order[-1 if is_last else 0] is job
        assert (job.begins_until_s, toy.ending_of(job)) == (None, Ending.OK)

    def test_a_step_beyond_the_bounds_takes_no_room(self) -> None:
        """What waits for an idle thread lets as much be admitted as without it, and does not ask for more servers."""
        toy, without = Toy(), Toy()
        self.again(toy, "toy", 6)
        without.admit(stage="refine", client="mine")
        for i in range(6):
            without.admit(client=f"other {i}")
        without.finish(without.take("host"), Done(None))
        load, its_load = toy.scheduler.load("prepare"), without.scheduler.load("prepare")
        assert load == its_load._replace(waiting=its_load.waiting + 1)
        for it in (toy, without):
            it.fill()
        assert toy.observer.admissions == without.observer.admissions

    def test_what_waits_for_an_idle_thread_is_no_job_of_its_caller(self) -> None:
        """Whose next job is admitted like a first one, which needs no more than its turn among the others' jobs."""
        toy = Toy()
        job = self.again(toy, "slow", 5)
        toy.admit(client="other 0")
        mine = toy.admit(client="mine")
        assert "this caller's jobs in it: 1" in str(toy.refusal(client="mine"))
        toy.scheduler.cancel(mine, toy.now_s)
        toy.scheduler.cancel(job, toy.now_s)
        run_through(toy)
        assert not toy.scheduler.jobs
        assert toy.scheduler.backlog_s == 0
        toy.admit()
        assert toy.refusal(deadline_s=toy.now_s + 0.1).reason is Refusal.DEADLINE_INFEASIBLE  # not idle any more

    def test_a_step_waits_until_it_would_end_too_late(self) -> None:
        toy = Toy()
        job = self.again(toy, "slow", 4)
        assert toy.scheduler.next_due_s is not None
        toy.scheduler.expire(99.0)
        assert toy.ending_of(job) is None
        toy.scheduler.expire(99.9)  # 150 s less the predicted 50.5 s
        assert toy.ends[0] == [(Ending.OK, "first")]
        assert self.again(Toy(), "slow", 4, due_s=51.0).is_over  # too late from the beginning

    def test_nothing_waits_for_an_idle_thread_while_jobs_are_refused(self) -> None:
        """The answer that there is would come late for nothing: more calls come than are computed."""
        toy = Toy()
        toy.fill()
        job = toy.admit(stage="refine", client="mine", deadline_s=200.0)
        toy.learn("prepare", "slow", 50.0)
        batch = toy.take("host")
        assert batch.jobs == (job,)
        toy.finish(batch, Next(Step("prepare", "slow", "b", "again"), Fallback(lambda: Done("first"), 150.0)))
        assert toy.ending_of(job) is Ending.OK

    @pytest.mark.parametrize(
        ("is_crowded", "own_jobs", "due_s", "goes_on"),
        [(False, 1, 150.0, True), (True, 1, 150.0, False), (False, 2, 150.0, False), (False, 1, 1.9, False)],
    )
    def test_a_greedy_caller_takes_no_others_turn(
        self, is_crowded: bool, own_jobs: int, due_s: float, goes_on: bool
    ) -> None:
        """Where its own jobs are refused, steps of others' only jobs take turns with them, if there is time for that.

        Not where others have no room, too.
        """
        toy = Toy()
        toy.learn("coarse", "more", 0.5)
        job, *_ = [toy.admit(stage="refine", client="mine", deadline_s=200.0) for _ in range(own_jobs)]
        batch = toy.take("host")
        toy.fill()
        for client in map(str, range(100) if is_crowded else ()):
            toy.fill(client)
        step = Step("prepare", "more", "b", "again")
        toy.finish(batch, Next(step, Fallback(lambda: Done("first"), due_s)))
        assert toy.ending_of(job) is (None if goes_on else Ending.OK)
        assert not goes_on or job in toy.take("host").jobs + toy.take("host").jobs

    @pytest.mark.parametrize(
        ("due_s", "others", "kind"),
        [(3.0, 0, "slow"), (1.0, 0, "toy"), (FAR_S, 5, "toy"), (0.7, 0, None), (0.7, 6, None)],
    )
    def test_the_alternative_is_computed_where_the_step_is_not(
        self, due_s: float, others: int, kind: str | None
    ) -> None:
        """Too late or too much for the room; the fallback is given only if the alternative is too late as well."""
        toy = Toy()
        toy.learn("prepare", "slow", 2.0)
        toy.learn("refine", "another", 50.0)  # says nothing about `later_kind`
        step, alternative = Step("prepare", "slow", "b", 0, "toy"), Step("prepare", "toy", "b", 0)
        job = toy.admit(stage="refine", client="mine")
        for i in range(others):
            toy.admit(client=f"other {i}")
        toy.finish(toy.take("host"), Next(step, Fallback(lambda: Done("first"), due_s), alternative))
        assert toy.ending_of(job) is (None if kind else Ending.OK)
        assert kind in (None, job.step.kind)

    def test_the_only_job_leaves_room_for_the_next_caller(self) -> None:
        """Though it costs more than the server computes for all callers, and another thread is free."""
        toy = Toy()
        toy.learn("prepare", "slow", 50.0)
        job = toy.admit(stage="refine", client="mine", deadline_s=200.0)
        again = Step("prepare", "slow", "b", "again")
        toy.finish(toy.take("host"), Next(again, Fallback(lambda: Done("first"), 150.0)))
        toy.take("host")
        other = toy.admit(client="other", deadline_s=5.0)
        assert toy.take("host").jobs == (other,)
        assert toy.ending_of(job) is None


class Events(RuleBasedStateMachine):
    """Any order of arrivals, batches, failures, cancellations and passing time."""

    @initialize()
    def begin(self) -> None:
        self.toy = Toy()
        self.batches: list[Batch] = []
        self.admitted: list[Job] = []
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
                assert booked_s <= OPTIONS.max_queued_s * threads + 0.9  # one that an idle server tried may be over
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
        verdicts: list[StageResult] = []
        for job in batch.jobs:
            fate = data.draw(st.sampled_from(["onward", "onward", "done", "fails", "fallback"]))
            due_s = self.toy.now_s + data.draw(st.floats(0.0, 3.0))
            fallback = Fallback(lambda: Done("coarse", Ending.DEGRADED), due_s) if fate == "fallback" else None
            planted: dict[str, StageResult] = {"done": Done(None), "fails": ValueError("planted")}
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

    def _waits(self, job: Job, lane: str) -> bool:
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
