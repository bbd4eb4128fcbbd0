"""A work queue with toy stages that wait, fail and lose the device as planted."""

from __future__ import annotations

import asyncio
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

from mapless_server.scheduling import (
    AnyFallback,
    AnyJob,
    AnyNext,
    AnyResult,
    Done,
    Failure,
    Fatal,
    Flow,
    Job,
    Next,
    Stage,
    Step,
    WorkQueue,
    WorkQueueOptions,
)
from mapless_server.scheduling.work_queue import ComputeBatch
from support.queues import CountingObserver

ROOMY = WorkQueueOptions(max_queued_s=1e6, heartbeat_s=0.05)


LIMIT_S = 20.0


FAR_S = 600.0


MAX_BATCH = 8


class PlantedError(Exception):
    """An error that a job raises."""


class LostDevice(Exception):
    """After which nothing is trusted."""


def failure_of(error: Exception) -> Failure:
    if isinstance(error, LostDevice):
        return Failure.DEVICE_LOST
    return Failure.OUT_OF_MEMORY if isinstance(error, MemoryError) else Failure.JOB_FAILED


def echo(jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
    return [Done(job.step.payload) for job in jobs]


def then(job: AnyJob, payload: Any = None, fallback: AnyFallback | None = None) -> AnyNext:
    """To the second stage."""
    return Next((Step("then", "toy", "b", job.step.payload if payload is None else payload),), fallback)


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

    def _serve(self, jobs: Sequence[AnyJob]) -> Sequence[AnyResult]:
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
