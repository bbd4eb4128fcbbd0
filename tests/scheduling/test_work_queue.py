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
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.queues import CountingObserver

from mapless_server.scheduling import (
    Abandoned,
    Done,
    Ending,
    Expired,
    Failure,
    Fallback,
    Fatal,
    Flow,
    Job,
    Next,
    Refusal,
    Refused,
    Stage,
    StageResult,
    Step,
    WorkQueue,
    WorkQueueOptions,
)
from mapless_server.scheduling.work_queue import ComputeBatch

ROOMY = WorkQueueOptions(max_queued_s=1e6, heartbeat_s=0.05)
LIMIT_S = 20.0
FAR_S = 600.0
MAX_BATCH = 8


class PlantedError(Exception):
    """Of a job."""


class LostDevice(Exception):
    """After which nothing is trusted."""


def failure_of(error: Exception) -> Failure:
    if isinstance(error, LostDevice):
        return Failure.DEVICE_LOST
    return Failure.OUT_OF_MEMORY if isinstance(error, MemoryError) else Failure.JOB_FAILED


def echo(jobs: Sequence[Job]) -> Sequence[StageResult]:
    return [Done(job.step.payload) for job in jobs]


def then(job: Job, payload: Any = None, fallback: Fallback | None = None) -> Next:
    """To the second stage."""
    return Next(Step("then", "toy", "b", job.step.payload if payload is None else payload), fallback)


class Toy:
    """A queue of the stages "first", of two threads, and "then", in batches of one thread; closed at the end.

    Attributes:
        compute: computes both stages.
        gate: opens the threads that are blocked by jobs with the payload "plug".
        seen: payloads in the order in which they were computed, batch by batch.
        fatals: that the owner was notified of.
    """

    def __init__(self, compute: ComputeBatch = echo, options: WorkQueueOptions = ROOMY) -> None:
        self.compute = compute
        self.options = options
        self.observer = CountingObserver()
        self.gate = threading.Event()
        self.seen: list[list[Any]] = []
        self.fatals: list[Fatal] = []
        self._plugged = threading.Semaphore(0)
        self._plugs: list[asyncio.Task[Any]] = []

    async def __aenter__(self) -> Toy:
        first, then = Stage("first", "toy-host", "then"), Stage("then", "toy-device", max_batch=MAX_BATCH)
        stages, lanes = {first: self._serve, then: self._serve}, {"toy-host": 2, "toy-device": 1}
        self.queue = WorkQueue(stages, lanes, self.options, self.observer, failure_of)
        self.queue.on_fatal = self.fatals.append
        self._others = asyncio.all_tasks()
        return self

    async def __aexit__(self, *_: object) -> None:
        """Neither threads nor tasks may be left."""
        self.gate.set()
        await asyncio.wait_for(self.queue.close(), LIMIT_S)
        await outcomes(self._plugs)
        assert asyncio.all_tasks() <= self._others
        assert not [it.name for it in threading.enumerate() if it.name.startswith("toy-")]
        assert self.queue.job_count == 0

    def _serve(self, jobs: Sequence[Job]) -> Sequence[StageResult]:
        payloads = [job.step.payload for job in jobs]
        if payloads == ["plug"]:
            self._plugged.release()
            assert self.gate.wait(LIMIT_S)
            return [Done("plug")]
        self.seen.append(payloads)
        return self.compute(jobs)

    def submit(
        self, payload: Any, stage: str = "then", *, client: str = "c", bucket: str = "b", lasts_s: float = FAR_S
    ) -> asyncio.Task[Any]:
        """A caller that waits for a job; the task's result is the job's."""
        deadline_s = time.monotonic() + lasts_s

        async def call() -> Any:
            return await self.queue.run(Job(Flow("t", client), Step(stage, "toy", bucket, payload), deadline_s, 1))

        return asyncio.ensure_future(call())

    async def plug(self, stage: str = "then", threads: int = 1) -> list[asyncio.Task[Any]]:
        """Keeps threads busy until the gate is opened, so that jobs wait."""
        plugs = [self.submit("plug", stage, client="plug", bucket="plug") for _ in range(threads)]
        self._plugs += plugs
        for _ in plugs:
            assert await asyncio.to_thread(self._plugged.acquire, timeout=LIMIT_S)
        return plugs

    async def waiting(self, payloads: Iterable[Any], **more: Any) -> list[asyncio.Task[Any]]:
        """Callers whose jobs all wait for the second stage, behind a plug."""
        self.gate.clear()
        await self.plug()
        calls = [self.submit(payload, **more) for payload in payloads]
        await self.until_jobs(len(calls) + 1)
        return calls

    async def together(self, payloads: Iterable[Any], **more: Any) -> list[Any]:
        """Outcomes of jobs that are computed in one batch, as far as it is large enough."""
        calls = await self.waiting(payloads, **more)
        self.gate.set()
        return await outcomes(calls)

    async def until_jobs(self, count: int) -> None:
        await until(lambda: self.queue.job_count == count)


async def until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        await asyncio.sleep(0.002)


async def outcomes(calls: Sequence[asyncio.Task[Any]]) -> list[Any]:
    """Results and exceptions, in order."""
    return await asyncio.wait_for(asyncio.gather(*calls, return_exceptions=True), LIMIT_S)


@pytest.fixture(autouse=True)
def _nothing_unhandled(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """An exception that reaches only the loop is a failure."""
    yield
    logged = [*caplog.get_records("call"), *caplog.get_records("teardown")]
    assert not [it for it in logged if it.name == "asyncio" and it.levelname == "ERROR"]


class TestResults:
    async def test_a_job_passes_its_stages_and_records_their_times(self) -> None:
        marks: dict[str, tuple[float, float]] = {}

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            stage, start_s = jobs[0].step.stage, time.monotonic()
            time.sleep(0.01)
            marks[stage] = (start_s, time.monotonic())
            return [then(job) if stage == "first" else Done(job.step.payload) for job in jobs]

        async with Toy(compute) as toy:
            others = await toy.waiting(["x", "y"])
            before_s = time.monotonic()
            job = Job(Flow("t", "c"), Step("first", "toy", "b", "z"), before_s + FAR_S, 1)
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

    async def test_a_batchs_output_is_taken_up_by_as_many_threads_at_once(self) -> None:
        """One notification, work for two."""
        both = threading.Barrier(2, timeout=LIMIT_S)

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            if jobs[0].step.stage == "then":
                time.sleep(0.05)  # until both threads wait
                return [Next(Step("first", "toy", "b", job.step.payload)) for job in jobs]
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
        def compute(jobs: Sequence[Job]) -> Sequence[StageResult]:
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

        def compute(jobs: Sequence[Job]) -> Sequence[StageResult]:
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
        def compute(jobs: Sequence[Job]) -> Sequence[StageResult]:
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
        def compute(jobs: Sequence[Job]) -> Sequence[StageResult]:
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

        def compute(jobs: Sequence[Job]) -> Sequence[StageResult]:
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

        def compute(jobs: Sequence[Job]) -> Sequence[StageResult]:
            if len(jobs) > (1 if 0 in [job.step.payload for job in jobs] else 2):
                raise MemoryError
            return echo(jobs)

        async with Toy(compute) as toy:
            await toy.together(range(8))
            toy.seen.clear()
            await toy.together(range(1, 9))
        assert [len(it) for it in toy.seen] == [1] * 8


class TestEndOfAll:
    async def _ends(self, toy: Toy, calls: Sequence[asyncio.Task[Any]]) -> None:
        """Every caller and, once, the owner learns it, and nothing is computed any more."""
        for outcome in await outcomes(calls):
            assert isinstance(outcome, Fatal)
        assert [type(it) for it in toy.fatals] == [Fatal]
        assert not toy.queue.is_alive_within(FAR_S)
        computed = len(toy.seen)
        for stage in ("first", "then"):
            (refused,) = await outcomes([toy.submit("late", stage)])
            assert isinstance(refused, Refused)
            assert refused.reason is Refusal.DRAINING
        assert len(toy.seen) == computed
        assert toy.queue.job_count == 0

    @pytest.mark.parametrize("is_raised", [True, False])
    async def test_a_lost_device_ends_the_queue(self, is_raised: bool, caplog: pytest.LogCaptureFixture) -> None:
        error = LostDevice("poisoned context")

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            payloads = [job.step.payload for job in jobs]
            if is_raised and "lost" in payloads:
                raise error
            return [error if it == "lost" else Done("garbage") for it in payloads]

        async with Toy(compute) as toy:
            await toy.plug()
            busy = await toy.plug("first", threads=2)
            calls = [toy.submit(payload) for payload in (0, "lost", 2)]
            calls += [toy.submit("waits", "first"), toy.submit("another", bucket="other")]
            await toy.until_jobs(8)
            toy.gate.set()
            await outcomes(busy)
            await self._ends(toy, calls[:3])
            # The jobs of the other lane were computed before or failed.
            for outcome in await outcomes(calls[3:]):
                assert isinstance(outcome, Fatal) or outcome == "garbage"
        critical = [it.getMessage() for it in caplog.records if it.levelname == "CRITICAL"]
        assert critical == ["the device is lost: poisoned context"] == [str(it) for it in toy.fatals]

    async def test_two_threads_that_lose_it_at_once_are_one_end(self) -> None:
        both = threading.Barrier(2, timeout=LIMIT_S)

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            both.wait()
            raise LostDevice

        async with Toy(compute) as toy:
            await self._ends(toy, [toy.submit(i, "first") for i in range(2)])

    @pytest.mark.parametrize("event", ["waited", "computed", "ended"])
    async def test_a_bug_in_the_loop_itself_ends_the_queue(self, event: str) -> None:
        """Such as an observer that raises, which it must not."""
        broken = threading.Event()

        def raise_if_broken(*_: Any) -> None:
            if broken.is_set():
                raise PlantedError(event)

        async with Toy() as toy:
            asyncio.get_running_loop().set_exception_handler(lambda *_: None)  # which may be called, too
            setattr(toy.observer, event, raise_if_broken)
            calls = await toy.waiting(range(3))
            broken.set()
            toy.gate.set()
            await until(lambda: bool(toy.fatals))
            await self._ends(toy, calls)
            broken.clear()

    @pytest.mark.parametrize("error", [SystemExit(3), KeyboardInterrupt()])
    async def test_a_stage_that_wants_to_end_the_program_ends_the_queue(self, error: BaseException) -> None:
        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            raise error

        async with Toy(compute) as toy:
            await self._ends(toy, [toy.submit(0)])

    async def test_a_stage_that_hangs_ends_the_queue(self) -> None:
        async with Toy(options=replace(ROOMY, stall_limit_s=0.2)) as toy:
            plugs = await toy.plug()
            await self._ends(toy, [*plugs, toy.submit("waits")])
        assert "the stage then has computed for" in str(toy.fatals[0])
        assert "hangs" in str(toy.fatals[0])

    async def test_a_long_stage_that_checks_between_steps_does_not_hang(self) -> None:
        def compute(jobs: Sequence[Job]) -> Sequence[StageResult]:
            until_s = time.monotonic() + (2.0 if jobs[0].step.payload == "long" else 0.1)
            while time.monotonic() < until_s:
                jobs[-1].check()
                time.sleep(0.02)
            if jobs[0].step.payload == "hangs":
                assert toy.gate.wait(LIMIT_S)
            return echo(jobs)

        async with Toy(compute, replace(ROOMY, stall_limit_s=1.0)) as toy:
            assert await outcomes([toy.submit("long")]) == ["long"]
            assert not toy.fatals
            await self._ends(toy, [toy.submit("hangs")])

    async def test_closing_ends_waiting_jobs_and_awaits_the_computing(self) -> None:
        async with Toy() as toy:
            calls = await toy.waiting(range(3))
            closing = asyncio.ensure_future(toy.queue.close())
            for outcome in await outcomes(calls):
                assert isinstance(outcome, Fatal)
            assert not closing.done()
            toy.gate.set()
            await asyncio.wait_for(closing, LIMIT_S)
        assert not toy.seen
        assert not toy.fatals

    async def test_closing_does_not_wait_for_ever(self, caplog: pytest.LogCaptureFixture) -> None:
        async with Toy() as toy:
            await toy.plug()
            await asyncio.wait_for(toy.queue.close(limit_s=0.1), LIMIT_S)
            assert not toy.gate.is_set()
        (said,) = [it.getMessage() for it in caplog.records if it.levelname == "ERROR"]
        assert "toy-device" in said
        assert "left behind" in said


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

        def compute(jobs: Sequence[Job]) -> Sequence[StageResult]:
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

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
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
