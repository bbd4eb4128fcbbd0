"""The photographs of a rig or a sequence, each localized like any other; `joint` poses them together."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

from mapless_server.errors import Overloaded, RequestError
from mapless_server.scheduling import Job

from .interface import Engine
from .query import Caller, Result

MAX_RIG_IMAGES = 8
MIN_FRAMES, MAX_FRAMES = 2, 16
"""Of a sequence."""


@dataclass(frozen=True, eq=False)
class GroupResult:
    """The photographs of a group, each by itself.

    Attributes:
        results: in the order of the queries.
        queued_s: how long each waited before anything was computed for it.
        seconds: from when each began until it was done.
    """

    results: tuple[Result, ...]
    queued_s: tuple[float, ...]
    seconds: tuple[float, ...]


async def localize_each(engine: Engine, jobs: Sequence[Job], caller: Caller, list_name: str) -> GroupResult:
    """Localizes photographs, as many at a time as the engine computes.

    All of them at once would be more than a caller may have waiting. A photograph that there is no room for waits until
    another one of the same call is done; only the first one is refused.

    Args:
        engine: which computes.
        jobs: the photographs', of `Engine.query_job`.
        caller: of them all.
        list_name: the field of the request that holds them, for messages about one of them.

    Raises:
        RequestError: as of `Engine.run`, its field within the list.
    """
    group = _Group(engine, jobs, caller, list_name)
    workers = [asyncio.ensure_future(group.work()) for _ in range(min(len(jobs), engine.parallel_queries))]
    try:
        await asyncio.gather(*workers)
    finally:
        for worker in workers:
            worker.cancel()
        await asyncio.gather(*workers, return_exceptions=True)
    return group.result()


@dataclass(eq=False)
class _Group:
    """Photographs that are being localized; several workers take one after the other."""

    engine: Engine
    jobs: Sequence[Job]
    caller: Caller
    list_name: str
    done: dict[int, tuple[Result, float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._waiting = deque(range(len(self.jobs)))
        self._running = 0

    async def work(self) -> None:
        """Localizes what waits, until nothing does or there is no room for as many at a time."""
        while self._waiting:
            index = self._waiting.popleft()
            self._running += 1
            try:
                await self._localize(index)
            except Overloaded as refused:
                self._waiting.appendleft(index)
                if self._running > 1:
                    return  # the others go on, and come to it
                await self._wait(refused)
            finally:
                self._running -= 1

    async def _localize(self, index: int) -> None:
        start_s = time.monotonic()
        try:
            result = await self.engine.run(self.jobs[index])
        except RequestError as error:
            if error.field is not None and error.field.startswith("references"):
                error.field = f"{self.list_name}[{index}].{error.field}"
            raise
        self.done[index] = result, time.monotonic() - start_s

    async def _wait(self, refused: Overloaded) -> None:
        """Until there may be room; raises the refusal if nothing was computed or there is no time."""
        pause_s = refused.retry_after_s
        if not self.done or pause_s is None or time.monotonic() + pause_s > self.caller.deadline_s:
            raise refused
        await asyncio.sleep(pause_s)

    def result(self) -> GroupResult:
        """Of all."""
        results, seconds = zip(*(self.done[i] for i in range(len(self.jobs))), strict=True)
        first = (next(iter(job.records), None) for job in self.jobs)
        queued_s = tuple(0.0 if it is None else it.start_s - it.queued_s for it in first)
        return GroupResult(results, queued_s, seconds)
