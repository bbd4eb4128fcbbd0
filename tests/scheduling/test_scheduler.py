"""Laws of the scheduler, on a virtual clock with toy stages, in any order of events."""

import gc
import itertools
import weakref
from typing import Any

import numpy as np
import pytest
from support.toy_scheduler import COST_S, OPTIONS, PlantedQuota, Toy, onward, run_through

from mapless_server.scheduling import (
    Abandoned,
    Done,
    Ending,
    Expired,
    Fallback,
    Flow,
    Refusal,
    Refused,
    WorkQueueOptions,
)


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

    def test_a_tenant_whose_time_is_spent_is_refused_before_its_message(self) -> None:
        """Asking whether there is room costs nothing; a job of the server's own has no tenant."""
        quota = PlantedQuota(admitted=2)
        toy = Toy(quota=quota)
        job = toy.admit()
        toy.scheduler.check_room(job.flow, job.step, toy.now_s)
        np.testing.assert_allclose(quota.settled, [(0.6, 0.0)])
        with pytest.raises(Refused, match="computing time is used up"):
            toy.scheduler.check_room(job.flow, job.step, toy.now_s)
        toy.scheduler.check_room(Flow("", "the server's own"), job.step, toy.now_s)

    def test_jobs_that_fail_together_are_counted_and_paid_back(self) -> None:
        quota = PlantedQuota()
        toy = Toy(quota=quota)
        for _ in range(2):
            toy.admit()
        toy.scheduler.fail_all(RuntimeError("planted"), toy.now_s)
        assert toy.observer.endings == {Ending.FAILED: 2}
        np.testing.assert_allclose(quota.settled, [(0.6, 0.0)] * 2)


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
        """One of two threads computes a long step at a time, while shorter ones keep coming."""
        toy = Toy()
        toy.learn("prepare", "toy", 9.0, "long")
        toy.learn("prepare", "toy", 9.0, "long too")
        first, second = toy.admit(client="long"), toy.admit(client="long too")
        toy.admit(client="short", stage="describe")
        batches = [toy.take("host"), toy.take("host")]
        assert {batch.jobs[0].flow.caller for batch in batches} == {"short", "long"}
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
        fallback: Any = Fallback(lambda _: Done("coarse", Ending.DEGRADED), 4.5)
        toy.finish(toy.take("device"), onward(job, fallback))
        assert toy.scheduler.next_due_s == 4.5
        toy.take("host")
        toy.scheduler.expire(4.5)
        assert toy.ends[0] == [(Ending.DEGRADED, "coarse")]

    def test_a_prediction_that_is_wrong_does_not_stay_so(self) -> None:
        """Now and then a job that seems useless is computed: one that never runs teaches nothing."""
        toy = Toy()
        for _ in range(20):
            toy.learn("refine", "toy", 30.0)
        refined = 0
        for _ in range(300):
            job = toy.admit(stage="coarse", deadline_s=toy.now_s + 2.0)
            fallback: Any = Fallback(lambda _: Done("coarse", Ending.DEGRADED), job.deadline_s - 0.1)
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
