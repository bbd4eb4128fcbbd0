"""The end of a work queue: whatever ends it, every caller learns so once, and no thread stays behind."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
from support.toy_queue import (
    FAR_S,
    LIMIT_S,
    ROOMY,
    LostDevice,
    PlantedError,
    Toy,
    echo,
    outcomes,
    until,
)

from mapless_server.scheduling import (
    AnyJob,
    AnyResult,
    Done,
    Fatal,
    Refusal,
    Refused,
)


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

        def compute(jobs: Sequence[AnyJob]) -> list[AnyResult]:
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

        def compute(jobs: Sequence[AnyJob]) -> list[AnyResult]:
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
        def compute(jobs: Sequence[AnyJob]) -> list[AnyResult]:
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
        def compute(jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
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
