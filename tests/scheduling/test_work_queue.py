"""The executor: real threads, a real event loop, toy stages, and all that can go wrong in them.

Every caller learns once how its job ended; a job that fails does so alone; no job, thread or task stays behind. Order,
admission and bookings are the scheduler's and tested there.
"""

from __future__ import annotations

import asyncio
import random
import threading
import time
import weakref
from collections import Counter
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.toy_queue import (
    FAR_S,
    LIMIT_S,
    MAX_BATCH,
    PlantedError,
    Toy,
    echo,
    outcomes,
    then,
    until,
)

from mapless_server.scheduling import (
    Abandoned,
    AnyJob,
    AnyResult,
    Done,
    Ending,
    Expired,
    Flow,
    Job,
    Next,
    Refused,
    Step,
    WorkQueueOptions,
    count_helper,
)


class TestResults:
    async def test_a_job_passes_its_stages_and_records_their_times(self) -> None:
        marks: dict[str, tuple[float, float]] = {}

        def compute(jobs: Sequence[AnyJob]) -> list[AnyResult]:
            stage, start_s = jobs[0].step.stage, time.monotonic()
            time.sleep(0.01)
            marks[stage] = (start_s, time.monotonic())
            return [then(job) if stage == "first" else Done(job.step.payload) for job in jobs]

        async with Toy(compute) as toy:
            others = await toy.waiting(["x", "y"])
            before_s = time.monotonic()
            job: AnyJob = Job(Flow("t", "c"), Step("first", "toy", "b", "z"), before_s + FAR_S, 1)
            running = asyncio.ensure_future(toy.queue.run(job))
            await until(lambda: toy.queue.load("then").waiting == 3)
            toy.gate.set()
            value = await running
            await outcomes(others)
        first, second = job.records
        assert (value, first.stage, second.stage, first.jobs, second.jobs) == ("z", "first", "then", 1, 3)
        for record, (start_s, end_s) in ((first, marks["first"]), (second, marks["then"])):
            assert record.queued_s <= record.start_s <= start_s < end_s <= record.end_s
        assert before_s <= first.queued_s
        assert second.queued_s == first.end_s  # nothing lies between two stages
        assert toy.observer.batches[-1] == ("then", 3)

    async def test_a_record_has_the_processor_time_of_all_threads(self) -> None:
        """An equal share for each job of a batch: waiting costs nothing, a helping thread counts."""

        def compute(jobs: Sequence[AnyJob]) -> list[AnyResult]:
            if jobs[0].step.stage == "first":
                time.sleep(0.05)
                return [then(job) for job in jobs]
            until_s = time.thread_time() + 0.06
            while time.thread_time() < until_s:
                pass
            count_helper(0.09)
            return [Done(None) for _ in jobs]

        async with Toy(compute) as toy:
            others = await toy.waiting(["x", "y"])
            job: AnyJob = Job(Flow("t", "c"), Step("first", "toy", "b", "z"), time.monotonic() + FAR_S, 1)
            running = asyncio.ensure_future(toy.queue.run(job))
            await until(lambda: toy.queue.load("then").waiting == 3)
            toy.gate.set()
            await running
            await outcomes(others)
        waited, computed = job.records
        assert waited.processor_s < 0.03
        assert 0.05 <= computed.processor_s < 0.065

    async def test_a_batchs_output_is_taken_up_by_as_many_threads_at_once(self) -> None:
        """One notification, work for two."""
        both = threading.Barrier(2, timeout=LIMIT_S)

        def compute(jobs: Sequence[AnyJob]) -> list[AnyResult]:
            if jobs[0].step.stage == "then":
                time.sleep(0.05)  # until both threads wait
                return [Next((Step("first", "toy", "b", job.step.payload),)) for job in jobs]
            both.wait()
            return [Done(job.step.payload) for job in jobs]

        async with Toy(compute) as toy:
            assert await toy.together(range(2)) == [0, 1]

    async def test_a_step_held_back_for_shorter_ones_starts_when_none_come(self) -> None:
        async with Toy() as toy:
            for client, cost_s in (("short", 0.0), ("plug", 1.0), ("long", 1.0)):
                for stage in ("first", "then"):
                    costs, flow = toy.queue._scheduler.costs, Flow("t", client)
                    costs.observe(stage, "toy", flow, cost_s, time.monotonic())
            await toy.plug("first")
            assert await outcomes([toy.submit("short", "first", client="short")]) == ["short"]
            assert await outcomes([toy.submit("long", "first", client="long")]) == ["long"]


class TestFailure:
    @settings(max_examples=25, deadline=None)
    @given(st.lists(st.booleans(), min_size=1, max_size=3 * MAX_BATCH))
    async def test_the_failing_jobs_of_a_batch_fail_alone(self, fails: list[bool]) -> None:
        def compute(jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
            for job in jobs:
                if job.step.payload != "later" and fails[job.step.payload]:
                    raise PlantedError(job.step.payload)
            return echo(jobs)

        async with Toy(compute) as toy:
            for i, outcome in enumerate(await toy.together(range(len(fails)))):
                assert outcome.args == (i,) if fails[i] else outcome == i
            assert await toy.submit("later") == "later"
        assert toy.observer.endings[Ending.FAILED] == sum(fails)
        assert not toy.fatals

    @pytest.mark.parametrize("error", [StopIteration(), StopAsyncIteration(), asyncio.TimeoutError(), KeyError("x")])
    async def test_any_exception_is_the_jobs_alone(self, error: Exception) -> None:
        """Some of them mean something to futures and coroutines."""

        def compute(jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
            if jobs[0].step.payload == "bad":
                raise error
            return echo(jobs)

        async with Toy(compute) as toy:
            (outcome,) = await outcomes([toy.submit("bad")])
            assert isinstance(outcome, type(error) | RuntimeError)
            assert await toy.submit("good") == "good"
        assert not toy.fatals

    @pytest.mark.parametrize("surplus", [-1, 1])
    async def test_a_stage_with_the_wrong_number_of_results_fails_all(self, surplus: int) -> None:
        def compute(jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
            if "right" in [job.step.payload for job in jobs]:
                return echo(jobs)
            return [Done("whose?")] * (len(jobs) + surplus)

        async with Toy(compute) as toy:
            for outcome in await toy.together(range(4)):
                assert isinstance(outcome, RuntimeError)
                assert "results" in str(outcome)
            assert await toy.submit("right") == "right"

    @pytest.mark.parametrize("fits", [1, 2, 3, 5])
    async def test_out_of_memory_halves_the_batch_for_good(self, fits: int) -> None:
        def compute(jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
            if len(jobs) > fits and jobs[0].step.bucket == "large":
                raise MemoryError
            return echo(jobs)

        async with Toy(compute) as toy:
            for _ in range(2):
                before = toy.observer.out_of_memory
                assert await toy.together(range(7), bucket="large") == [*range(7)]
            assert before == toy.observer.out_of_memory > 0
            assert await toy.together(range(7), bucket="small") == [*range(7)]
        assert toy.seen[-1] == [*range(7)], "other buckets are not limited"
        assert set(toy.observer.endings) == {Ending.OK}

    async def test_memory_of_a_failed_attempt_is_free_for_its_halves(self) -> None:
        """An exception that is being handled holds the frames that it came through, and the tensors in them."""
        held: list[weakref.ref[Any]] = []

        def compute(jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
            assert not any(it() for it in held)
            tensor = {len(jobs)} - {1}
            if tensor:
                held.append(weakref.ref(tensor))
                raise MemoryError
            return echo(jobs)

        async with Toy(compute) as toy:
            assert await toy.together(range(4)) == [*range(4)]
        assert len(held) == 3

    async def test_a_batch_size_that_was_too_much_once_stays_so(self) -> None:
        """Though a later half of the same batch would have allowed more."""

        def compute(jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
            if len(jobs) > (1 if 0 in [job.step.payload for job in jobs] else 2):
                raise MemoryError
            return echo(jobs)

        async with Toy(compute) as toy:
            await toy.together(range(8))
            toy.seen.clear()
            await toy.together(range(1, 9))
        assert [len(it) for it in toy.seen] == [1] * 8


async def test_the_loop_is_woken_without_the_lock(monkeypatch: pytest.MonkeyPatch) -> None:
    """It wakes at once, and its next step may need the lock."""
    loop, held = asyncio.get_running_loop(), []
    wake = loop.call_soon_threadsafe

    def observed(callback: Any, *what: Any) -> asyncio.Handle:
        if threading.current_thread() is not threading.main_thread():
            held.append(toy.queue._lock.locked())
        return wake(callback, *what)

    monkeypatch.setattr(loop, "call_soon_threadsafe", observed)
    async with Toy(options=WorkQueueOptions(max_queued_s=1e6, heartbeat_s=100.0)) as toy:
        for i in range(5):
            assert await toy.submit(i) == i
    assert len(held) >= 5
    assert not any(held)


class TestCallersWhoLeave:
    @pytest.mark.parametrize("way", [Ending.CANCELLED, Ending.EXPIRED])
    async def test_a_thread_notices_at_its_next_check_that_a_job_ended(self, way: Ending) -> None:
        """The caller learns it at once; the thread is not interrupted."""
        began, asks, noticed = threading.Event(), threading.Event(), threading.Event()

        def compute(jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
            if jobs[0].step.payload == "next":
                return echo(jobs)
            jobs[0].check()
            began.set()
            assert asks.wait(LIMIT_S)
            with pytest.raises(Abandoned) as abandoned:
                jobs[0].check()
            noticed.set()
            raise abandoned.value

        async with Toy(compute) as toy:
            call = toy.submit(0, lasts_s=0.3 if way is Ending.EXPIRED else FAR_S)
            assert await asyncio.to_thread(began.wait, LIMIT_S)
            if way is Ending.CANCELLED:
                call.cancel()
            (outcome,) = await outcomes([call])
            assert isinstance(outcome, Expired if way is Ending.EXPIRED else asyncio.CancelledError)
            assert toy.queue.job_count == 0
            assert not noticed.is_set()
            follows = toy.submit("next")
            asks.set()
            assert await asyncio.wait_for(follows, LIMIT_S) == "next"
            assert noticed.is_set()
        assert toy.observer.endings == {way: 1, Ending.OK: 1}

    async def test_a_waiting_call_ends_at_its_deadline_without_a_thread(self) -> None:
        async with Toy() as toy:
            await toy.submit("quick")  # so that enough time is predicted
            (outcome,) = await outcomes(await toy.waiting(["late"], lasts_s=0.2))
            assert isinstance(outcome, Expired)
            assert not toy.gate.is_set()
        assert toy.seen == [["quick"]]

    @pytest.mark.parametrize("seed", range(3))
    async def test_in_any_order_everything_comes_to_its_end(self, seed: int) -> None:
        """Callers come, leave at any moment, run out of time, fail and go through one stage or two."""
        random_ = random.Random(seed)

        def compute(jobs: Sequence[AnyJob]) -> list[AnyResult]:
            if any(job.step.payload % 7 == 0 for job in jobs):
                raise PlantedError
            return [then(job) if job.step.stage == "first" else Done(job.step.payload) for job in jobs]

        async def caller(number: int) -> Any:
            for _ in range(random_.randrange(20)):
                await asyncio.sleep(0)
            lasts_s = random_.choice([0.0, 0.001, 0.005, FAR_S, FAR_S])
            stage, client = random_.choice(["first", "then"]), random_.choice("abc")
            call = toy.submit(number, stage, client=client, lasts_s=lasts_s)
            if random_.random() < 0.3:
                for _ in range(1 + random_.randrange(30)):  # it has begun
                    await asyncio.sleep(0)
                call.cancel()
            return (await asyncio.gather(call, return_exceptions=True))[0]

        async with Toy(compute) as toy:
            found = await outcomes([asyncio.ensure_future(caller(i)) for i in range(400)])
            assert toy.queue.job_count == 0
            await until(lambda: not any(toy.queue.load(stage).running for stage in ("first", "then")))
            assert not any(toy.queue.load(stage).waiting for stage in ("first", "then"))
        observer, kinds = toy.observer, Counter(map(type, found))
        assert observer.admissions + observer.refusals.total() == len(found)
        assert observer.endings.total() == observer.admissions
        assert set(kinds) <= {int, PlantedError, Expired, Refused, asyncio.CancelledError}
        assert kinds[int] > 20
        assert all(it == number for number, it in enumerate(found) if isinstance(it, int))
        assert not toy.fatals
