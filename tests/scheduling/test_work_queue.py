"""The queue's hands: real threads and a real loop, toy stages, and everything that can go wrong in them.

Whatever happens, every caller is told how its job ended, once; what is guilty fails alone; and nothing stays behind,
neither jobs nor threads nor tasks. Order, admission and accounts are the schedule's and tested there.
"""

from __future__ import annotations

import asyncio
import random
import threading
import time
import weakref
from collections import Counter
from collections.abc import AsyncIterator, Callable, Coroutine, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

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
    Observer,
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
LANES = {"toy-host": 2, "toy-device": 1}


class Guilty(Exception):
    """Planted."""


class Lost(Exception):
    """Planted: the device is not to be trusted any more."""


def failure_of(error: Exception) -> Failure:
    if isinstance(error, Lost):
        return Failure.DEVICE_LOST
    return Failure.OUT_OF_MEMORY if isinstance(error, MemoryError) else Failure.JOB_FAILED


class Account(Observer):
    """Keeps what it hears."""

    def __init__(self) -> None:
        self.admissions = 0
        self.refusals: Counter[Refusal] = Counter()
        self.endings: Counter[Ending] = Counter()
        self.waiting: Counter[str] = Counter()
        self.inflight: Counter[str] = Counter()
        self.batches: list[tuple[str, int]] = []
        self.out_of_memory = 0

    def admitted(self, cost_s: float) -> None:
        self.admissions += 1

    def refused(self, reason: Refusal) -> None:
        self.refusals[reason] += 1

    def queued(self, stage: str, jobs: int, cost_s: float) -> None:
        self.waiting[stage] = jobs

    def running(self, stage: str, jobs: int) -> None:
        self.inflight[stage] = jobs

    def computed(self, stage: str, bucket: str, jobs: int, seconds: float) -> None:
        self.batches.append((stage, jobs))

    def ended(self, stage: str, ending: Ending) -> None:
        self.endings[ending] += 1

    def ran_out_of_memory(self) -> None:
        self.out_of_memory += 1


@dataclass
class Shop:
    """A queue of two toy stages, "first" by two threads and "then" in batches by one; `compute` is what both do.

    Attributes:
        compute: of a batch.
        observer: of the queue.
        gate: the jobs whose payload is "plug" hold their thread until it is opened.
        plugged: released by each of them.
        seen: payloads in the order in which they were computed, batch by batch.
        fatals: told to the owner.
    """

    compute: ComputeBatch = lambda jobs: [Done(job.step.payload) for job in jobs]
    observer: Observer = field(default_factory=Account)
    options: WorkQueueOptions = ROOMY
    gate: threading.Event = field(default_factory=threading.Event)
    plugged: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    seen: list[list[Any]] = field(default_factory=list)
    fatals: list[Fatal] = field(default_factory=list)
    _plugs: list[asyncio.Task[Any]] = field(default_factory=list)

    @property
    def account(self) -> Account:
        assert isinstance(self.observer, Account)
        return self.observer

    @asynccontextmanager
    async def open(self) -> AsyncIterator[WorkQueue]:
        """The queue, which is closed at the end; then neither threads nor tasks of it may be left."""
        first, then = Stage("first", "toy-host", "then"), Stage("then", "toy-device", max_batch=MAX_BATCH)
        queue = WorkQueue({first: self._serve, then: self._serve}, LANES, self.options, self.observer, failure_of)
        queue.on_fatal = self.fatals.append
        others = asyncio.all_tasks()
        try:
            yield queue
        finally:
            self.gate.set()
            await asyncio.wait_for(queue.close(), LIMIT_S)
            await outcomes(self._plugs)
            assert asyncio.all_tasks() <= others
            assert not [it.name for it in threading.enumerate() if it.name.startswith("toy-")]
            assert queue.job_count == 0

    def _serve(self, jobs: Sequence[Job]) -> Sequence[StageResult]:
        payloads = [job.step.payload for job in jobs]
        if payloads == ["plug"]:
            self.plugged.release()
            assert self.gate.wait(LIMIT_S)
            return [Done("plug")]
        self.seen.append(payloads)
        return self.compute(jobs)

    async def plug(self, queue: WorkQueue, stage: str = "then", threads: int = 1) -> list[asyncio.Task[Any]]:
        """Keeps threads busy until the gate is opened, so that what comes now waits."""
        plugs = [submit(queue, "plug", stage, client="plug", bucket="plug") for _ in range(threads)]
        self._plugs += plugs
        for _ in plugs:
            assert await asyncio.to_thread(self.plugged.acquire, timeout=LIMIT_S)
        return plugs


def submit(
    queue: WorkQueue,
    payload: Any,
    stage: str = "then",
    *,
    client: str = "c",
    bucket: str = "b",
    lasts_s: float = FAR_S,
) -> asyncio.Task[Any]:
    """A caller that waits for a job; the task's result is the job's."""
    deadline_s = time.monotonic() + lasts_s

    async def call() -> Any:
        return await queue.run(Job(Flow("t", client), Step(stage, "toy", bucket, payload), deadline_s, 1))

    return asyncio.ensure_future(call())


async def until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + LIMIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        await asyncio.sleep(0.002)


async def outcomes(calls: Sequence[asyncio.Task[Any]]) -> list[Any]:
    """Results and exceptions, in order."""
    return await asyncio.wait_for(asyncio.gather(*calls, return_exceptions=True), LIMIT_S)


def run(test: Coroutine[Any, Any, None]) -> None:
    """Runs it on a loop of its own; whatever the loop is told of and nobody heard is a failure."""
    unheard: list[dict[str, Any]] = []

    async def heard() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _, context: unheard.append(context))
        await test

    asyncio.run(heard())
    assert not unheard


async def waiting(shop: Shop, queue: WorkQueue, payloads: Sequence[Any], **more: Any) -> list[asyncio.Task[Any]]:
    """Callers whose jobs all wait for the stage "then", behind a plug."""
    await shop.plug(queue)
    calls = [submit(queue, payload, **more) for payload in payloads]
    await until(lambda: queue.job_count == len(payloads) + 1)
    return calls


class TestResults:
    def test_a_job_goes_through_its_stages_and_its_records_say_when(self) -> None:
        marks: dict[str, tuple[float, float]] = {}

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            stage = jobs[0].step.stage
            start_s = time.monotonic()
            time.sleep(0.01)
            marks[stage] = (start_s, time.monotonic())
            if stage == "then":
                return [Done(job.step.payload) for job in jobs]
            return [Next(Step("then", "toy", "b", job.step.payload)) for job in jobs]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                others = await waiting(shop, queue, ["x", "y"])
                before_s = time.monotonic()
                job = Job(Flow("t", "c"), Step("first", "toy", "b", "z"), before_s + FAR_S, 1)
                running = asyncio.ensure_future(queue.run(job))
                await until(lambda: shop.account.waiting["then"] == 3)
                shop.gate.set()
                value = await running
                await outcomes(others)
            first, then = job.records
            assert (value, first.stage, then.stage, first.jobs, then.jobs) == ("z", "first", "then", 1, 3)
            for visit, (start_s, end_s) in ((first, marks["first"]), (then, marks["then"])):
                assert visit.queued_s <= visit.start_s <= start_s < end_s <= visit.end_s
            assert before_s <= first.queued_s
            assert then.queued_s == first.end_s  # nothing lies between two stages
            assert shop.account.batches[-1] == ("then", 3)

        run(test())

    def test_a_batchs_output_is_taken_up_by_as_many_threads_at_once(self) -> None:
        """One piece of news, work for two."""
        both = threading.Barrier(2, timeout=LIMIT_S)

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            if jobs[0].step.stage == "then":
                time.sleep(0.05)  # until both have heard that there is nothing to do
                return [Next(Step("first", "toy", "b", job.step.payload)) for job in jobs]
            both.wait()
            return [Done(job.step.payload) for job in jobs]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                calls = await waiting(shop, queue, range(2))
                shop.gate.set()
                assert await outcomes(calls) == [0, 1]

        run(test())

    def test_a_light_caller_does_not_wait_for_a_heavy_ones_jobs(self) -> None:
        async def test() -> None:
            shop = Shop()
            async with shop.open() as queue:
                plugs = await shop.plug(queue, "first", threads=2)
                heavy = [submit(queue, f"heavy {i}", "first", client="heavy") for i in range(100)]
                await until(lambda: queue.job_count == 102)
                light = submit(queue, "light", "first", client="light")
                await until(lambda: queue.job_count == 103)
                shop.gate.set()
                await outcomes([*plugs, *heavy, light])
            assert len(shop.seen) == 101
            assert shop.seen.index(["light"]) < 8

        run(test())

    def test_nor_where_only_what_follows_costs_anything(self) -> None:
        """A turn is measured by all that it brings about, not by its first stage alone."""

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            if jobs[0].step.stage == "first":
                return [Next(Step("then", "toy", "b", job.step.payload)) for job in jobs]
            time.sleep(0.1)
            return [Done(job.step.payload) for job in jobs]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                for _ in range(3):  # it is learned what they cost
                    await submit(queue, "first of all", "first")
                shop.seen.clear()
                plugs = await shop.plug(queue, "first", threads=2)
                heavy = [submit(queue, f"heavy {i}", "first", client="heavy") for i in range(40)]
                await until(lambda: queue.job_count == 42)
                light = submit(queue, "light", "first", client="light")
                await until(lambda: queue.job_count == 43)
                shop.gate.set()
                await outcomes([*plugs, *heavy, light])
            assert [it for it in shop.seen if len(it) == 1].index(["light"]) < 10

        run(test())


class TestFailure:
    @settings(max_examples=25, deadline=None)
    @given(st.lists(st.booleans(), min_size=1, max_size=3 * MAX_BATCH))
    def test_the_guilty_jobs_of_a_batch_fail_alone(self, guilty: list[bool]) -> None:
        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            for job in jobs:
                if guilty[job.step.payload]:
                    raise Guilty(job.step.payload)
            return [Done(job.step.payload) for job in jobs]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                calls = await waiting(shop, queue, range(len(guilty)))
                shop.gate.set()
                for i, outcome in enumerate(await outcomes(calls)):
                    assert outcome.args == (i,) if guilty[i] else outcome == i
                shop.compute = lambda jobs: [Done("innocent") for _ in jobs]
                assert await submit(queue, "later") == "innocent"
            assert shop.account.endings[Ending.FAILED] == sum(guilty)
            assert not shop.fatals

        run(test())

    def test_a_job_given_an_exception_fails_alone_and_once(self) -> None:
        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            return [Guilty() if job.step.payload == 1 else Done(job.step.payload) for job in jobs]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                calls = await waiting(shop, queue, range(3))
                shop.gate.set()
                zero, one, two = await outcomes(calls)
            assert (zero, type(one), two) == (0, Guilty, 2)
            assert shop.seen == [[0, 1, 2]]

        run(test())

    @pytest.mark.parametrize("error", [StopIteration(), StopAsyncIteration(), asyncio.TimeoutError(), KeyError("x")])
    def test_any_exception_is_the_jobs_alone(self, error: Exception) -> None:
        """Some of them mean something to futures and coroutines."""

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            if jobs[0].step.payload == "bad":
                raise error
            return [Done("good")]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                (outcome,) = await outcomes([submit(queue, "bad")])
                assert isinstance(outcome, type(error) | RuntimeError)
                assert await submit(queue, "good") == "good"
            assert not shop.fatals

        run(test())

    @pytest.mark.parametrize("surplus", [-1, 1])
    def test_a_stage_with_the_wrong_number_of_results_fails_all(self, surplus: int) -> None:
        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            if "right" in [job.step.payload for job in jobs]:
                return [Done("right")]
            return [Done("of whom?")] * (len(jobs) + surplus)

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                calls = await waiting(shop, queue, range(4))
                shop.gate.set()
                for outcome in await outcomes(calls):
                    assert isinstance(outcome, RuntimeError)
                    assert "results" in str(outcome)
                assert await submit(queue, "right") == "right"

        run(test())

    @pytest.mark.parametrize("fits", [1, 2, 3, 5])
    def test_out_of_memory_halves_the_batch_for_good(self, fits: int) -> None:
        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            if len(jobs) > fits and jobs[0].step.bucket == "large":
                raise MemoryError
            return [Done(job.step.payload) for job in jobs]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                for _ in range(2):
                    before, shop.gate = shop.account.out_of_memory, threading.Event()
                    calls = await waiting(shop, queue, range(7), bucket="large")
                    shop.gate.set()
                    assert await outcomes(calls) == [*range(7)]
                assert before == shop.account.out_of_memory > 0
                # Photographs of another shape have nothing to do with it.
                shop.gate = threading.Event()
                calls = await waiting(shop, queue, range(7), bucket="small")
                shop.gate.set()
                assert await outcomes(calls) == [*range(7)]
            assert shop.seen[-1] == [*range(7)]
            assert set(shop.account.endings) == {Ending.OK}

        run(test())

    def test_memory_of_a_failed_attempt_is_free_for_its_halves(self) -> None:
        """An exception that is still handled holds the frames that it came through, and the tensors in them."""
        held: list[weakref.ref[Any]] = []

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            assert not any(it() for it in held)
            tensor = {len(jobs)} - {1}
            if tensor:
                held.append(weakref.ref(tensor))
                raise MemoryError
            return [Done(job.step.payload) for job in jobs]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                calls = await waiting(shop, queue, range(4))
                shop.gate.set()
                assert await outcomes(calls) == [*range(4)]
            assert len(held) == 3

        run(test())

    def test_a_batch_size_that_was_too_much_once_stays_so(self) -> None:
        """Though a later half of the same batch would have allowed more."""
        tried: list[int] = []

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            tried.append(len(jobs))
            if len(jobs) > (1 if 0 in [job.step.payload for job in jobs] else 2):
                raise MemoryError
            return [Done(job.step.payload) for job in jobs]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                calls = await waiting(shop, queue, range(8))
                shop.gate.set()
                await outcomes(calls)
                tried.clear()
                shop.gate = threading.Event()
                calls = await waiting(shop, queue, range(1, 9))
                shop.gate.set()
                await outcomes(calls)
            assert tried == [1] * 8

        run(test())

    def test_one_job_that_is_too_large_alone_is_told_so(self) -> None:
        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            raise MemoryError

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                (outcome,) = await outcomes([submit(queue, 0)])
            assert isinstance(outcome, MemoryError)
            assert shop.account.endings == {Ending.OUT_OF_MEMORY: 1}

        run(test())


class TestEndOfAll:
    async def _ends(self, shop: Shop, queue: WorkQueue, calls: Sequence[asyncio.Task[Any]]) -> None:
        """Everybody is told, the owner once, and nothing is computed any more."""
        for outcome in await outcomes(calls):
            assert isinstance(outcome, Fatal)
        assert [type(it) for it in shop.fatals] == [Fatal]
        assert not queue.is_alive_within(FAR_S)
        computed = len(shop.seen)
        for stage in ("first", "then"):
            (refused,) = await outcomes([submit(queue, "late", stage)])
            assert isinstance(refused, Refused)
            assert refused.reason is Refusal.DRAINING
        assert len(shop.seen) == computed
        assert queue.job_count == 0

    @pytest.mark.parametrize("way", ["raised", "returned"])
    def test_a_lost_device_ends_the_queue(self, way: str, caplog: pytest.LogCaptureFixture) -> None:
        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            if "lost" not in [job.step.payload for job in jobs]:
                return [Done("garbage") for _ in jobs]
            if way == "raised":
                raise Lost("poisoned context")
            return [Lost("poisoned context") if job.step.payload == "lost" else Done("garbage") for job in jobs]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                await shop.plug(queue)
                busy = await shop.plug(queue, "first", threads=2)
                calls = [submit(queue, payload) for payload in (0, "lost", 2)]
                calls += [submit(queue, "waits", "first"), submit(queue, "another", bucket="other")]
                await until(lambda: queue.job_count == 8)
                shop.gate.set()
                await outcomes(busy)
                await self._ends(shop, queue, calls[:3])
                # The jobs of the other lane ran before or were told; none got lost.
                for outcome in await outcomes(calls[3:]):
                    assert isinstance(outcome, Fatal) or outcome == "garbage"
            assert "poisoned context" in str(shop.fatals[0])

        run(test())
        assert [it.getMessage() for it in caplog.records if it.levelname == "CRITICAL"] == [
            "the device is lost: poisoned context"
        ]

    def test_two_threads_that_lose_it_at_once_are_one_end(self) -> None:
        both = threading.Barrier(2, timeout=LIMIT_S)

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            both.wait()
            raise Lost

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                calls = [submit(queue, i, "first") for i in range(2)]
                await self._ends(shop, queue, calls)
            assert len(shop.fatals) == 1

        run(test())

    @pytest.mark.parametrize("hook", ["queued", "running", "waited", "computed", "ended"])
    def test_a_bug_in_the_loop_itself_ends_the_queue(self, hook: str) -> None:
        """As an observer that raises, which it must not."""
        shop = Shop()
        broken = threading.Event()

        def raise_if_broken(*_: Any) -> None:
            if broken.is_set():
                raise Guilty(hook)

        setattr(shop.observer, hook, raise_if_broken)

        async def test() -> None:
            async with shop.open() as queue:
                asyncio.get_running_loop().set_exception_handler(lambda *_: None)  # told as loudly as can be
                calls = await waiting(shop, queue, range(3))
                broken.set()
                shop.gate.set()
                await until(lambda: bool(shop.fatals))
                await self._ends(shop, queue, calls)
                broken.clear()

        run(test())

    @pytest.mark.parametrize("error", [SystemExit(3), KeyboardInterrupt()])
    def test_a_stage_that_wants_to_end_the_program_ends_the_queue(self, error: BaseException) -> None:
        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            raise error

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                await self._ends(shop, queue, [submit(queue, 0)])

        run(test())

    def test_a_stage_that_hangs_ends_the_queue(self) -> None:
        async def test() -> None:
            shop = Shop(options=replace(ROOMY, stall_limit_s=0.2))
            async with shop.open() as queue:
                plugs = await shop.plug(queue)
                await self._ends(shop, queue, [*plugs, submit(queue, "waits")])
                assert "the stage then has computed for" in str(shop.fatals[0])
                assert "hangs" in str(shop.fatals[0])

        run(test())

    def test_a_long_stage_that_checks_between_steps_does_not_hang(self) -> None:
        steps_s, limit_s = 2.0, 1.0
        shop = Shop(options=replace(ROOMY, stall_limit_s=limit_s))

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            until_s = time.monotonic() + (steps_s if jobs[0].step.payload == "long" else 0.1)
            while time.monotonic() < until_s:
                jobs[-1].check()
                time.sleep(0.02)
            if jobs[0].step.payload == "hangs":
                assert shop.gate.wait(LIMIT_S)
            return [Done(job.step.payload) for job in jobs]

        shop.compute = compute

        async def test() -> None:
            async with shop.open() as queue:
                assert await outcomes([submit(queue, "long")]) == ["long"]
                assert not shop.fatals
                await self._ends(shop, queue, [submit(queue, "hangs")])

        run(test())

    def test_closing_notifies_the_waiting_and_awaits_the_computing(self) -> None:
        async def test() -> None:
            shop = Shop()
            async with shop.open() as queue:
                calls = await waiting(shop, queue, range(3))
                closing = asyncio.ensure_future(queue.close())
                for outcome in await outcomes(calls):
                    assert isinstance(outcome, Fatal)
                assert not closing.done()
                shop.gate.set()
                await asyncio.wait_for(closing, LIMIT_S)
                assert not shop.seen
                assert not shop.fatals

        run(test())

    def test_closing_does_not_wait_for_ever(self, caplog: pytest.LogCaptureFixture) -> None:
        async def test() -> None:
            shop = Shop()
            async with shop.open() as queue:
                await shop.plug(queue)
                await asyncio.wait_for(queue.close(limit_s=0.1), LIMIT_S)
                assert not shop.gate.is_set()

        run(test())
        (said,) = [it.getMessage() for it in caplog.records if it.levelname == "ERROR"]
        assert "toy-device" in said
        assert "left behind" in said

    def test_a_queue_that_never_began_can_be_closed(self) -> None:
        async def test() -> None:
            async with Shop().open() as queue:
                await queue.close()
                (refused,) = await outcomes([submit(queue, 0)])
                assert isinstance(refused, Refused)
                assert not queue.is_alive_within(FAR_S)

        run(test())

    def test_draining_finishes_what_waits(self) -> None:
        async def test() -> None:
            shop = Shop()
            async with shop.open() as queue:
                calls = await waiting(shop, queue, range(3))
                queue.drain()
                (refused,) = await outcomes([submit(queue, "late")])
                assert isinstance(refused, Refused)
                shop.gate.set()
                assert await outcomes(calls) == [0, 1, 2]

        run(test())


class TestCallersWhoLeave:
    def test_one_who_waits_frees_its_place_and_is_not_computed(self) -> None:
        async def test() -> None:
            shop = Shop()
            async with shop.open() as queue:
                calls = await waiting(shop, queue, range(3))
                calls[1].cancel()
                await until(lambda: queue.job_count == 3)
                assert shop.account.waiting["then"] == 2
                shop.gate.set()
                zero, one, two = await outcomes(calls)
                assert (zero, type(one), two) == (0, asyncio.CancelledError, 2)
            assert shop.seen == [[0, 2]]
            assert shop.account.endings == {Ending.CANCELLED: 1, Ending.OK: 3}

        run(test())

    @pytest.mark.parametrize("way", [Ending.CANCELLED, Ending.EXPIRED])
    def test_a_thread_finds_out_that_nobody_waits_any_more(self, way: Ending) -> None:
        """The caller is told at once; the thread is not interrupted, but it asks."""
        began, asks, noticed = threading.Event(), threading.Event(), threading.Event()

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            if jobs[0].step.payload == "next":
                return [Done("next")]
            jobs[0].check()
            began.set()
            assert asks.wait(LIMIT_S)
            try:
                jobs[0].check()
            except Abandoned:
                noticed.set()
                raise
            return [Done("nobody reads this")]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                call = submit(queue, 0, lasts_s=0.3 if way is Ending.EXPIRED else FAR_S)
                assert await asyncio.to_thread(began.wait, LIMIT_S)
                if way is Ending.CANCELLED:
                    call.cancel()
                (outcome,) = await outcomes([call])
                assert isinstance(outcome, Expired if way is Ending.EXPIRED else asyncio.CancelledError)
                assert queue.job_count == 0
                assert not noticed.is_set()
                follows = submit(queue, "next")
                asks.set()
                assert await asyncio.wait_for(follows, LIMIT_S) == "next"
                assert noticed.is_set()
            assert shop.account.endings == {way: 1, Ending.OK: 1}

        run(test())

    def test_a_waiting_call_ends_at_its_deadline_without_a_thread(self) -> None:
        async def test() -> None:
            shop = Shop()
            async with shop.open() as queue:
                await submit(queue, "quick")  # so the queue believes that there is time
                calls = await waiting(shop, queue, ["late"], lasts_s=0.2)
                (outcome,) = await outcomes(calls)
                assert isinstance(outcome, Expired)
                assert not shop.gate.is_set()
            assert shop.seen == [["quick"]]

        run(test())

    def test_what_is_at_hand_is_given_when_time_runs_out(self) -> None:
        shop = Shop()

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            if jobs[0].step.stage == "then":
                return [Done("quick")]
            fallback = Fallback(lambda: Done("coarse", Ending.DEGRADED), time.monotonic() + 0.4)
            return [Next(Step("then", "toy", "b", "plug"), fallback) for _ in jobs]

        shop.compute = compute

        async def test() -> None:
            async with shop.open() as queue:
                await submit(queue, "quick")  # so the queue believes that there is time
                assert await asyncio.wait_for(submit(queue, 0, "first"), LIMIT_S) == "coarse"
                assert not shop.gate.is_set()
            assert shop.account.endings == {Ending.OK: 1, Ending.DEGRADED: 1}

        run(test())

    @pytest.mark.parametrize("seed", range(3))
    def test_in_any_order_everything_comes_to_its_end(self, seed: int) -> None:
        """Callers come, leave at any moment, run out of time, fail and go through one stage or two."""
        fates = random.Random(seed)

        def compute(jobs: Sequence[Job]) -> list[StageResult]:
            verdicts: list[StageResult] = []
            for job in jobs:
                if job.step.payload % 7 == 0:
                    raise Guilty
                onward = job.step.stage == "first"
                verdicts.append(Next(Step("then", "toy", "b", job.step.payload)) if onward else Done(job.step.payload))
            return verdicts

        async def caller(queue: WorkQueue, number: int) -> Any:
            for _ in range(fates.randrange(20)):
                await asyncio.sleep(0)
            lasts_s = fates.choice([0.0, 0.001, 0.005, FAR_S, FAR_S])
            call = submit(queue, number, fates.choice(["first", "then"]), client=fates.choice("abc"), lasts_s=lasts_s)
            if fates.random() < 0.3:
                for _ in range(1 + fates.randrange(30)):  # it has begun
                    await asyncio.sleep(0)
                call.cancel()
            return (await asyncio.gather(call, return_exceptions=True))[0]

        async def test() -> None:
            shop = Shop(compute)
            async with shop.open() as queue:
                callers = [asyncio.ensure_future(caller(queue, i)) for i in range(400)]
                told = await outcomes(callers)
                assert queue.job_count == 0
                await until(lambda: not any(shop.account.inflight.values()))
                assert not any(shop.account.waiting.values())
            account, kinds = shop.account, Counter(map(type, told))
            assert account.admissions + account.refusals.total() == len(told)
            assert account.endings.total() == account.admissions
            assert set(kinds) <= {int, Guilty, Expired, Refused, asyncio.CancelledError}
            assert kinds[int] > 20
            assert all(it == number for number, it in enumerate(told) if isinstance(it, int))
            assert not shop.fatals

        run(test())
