"""The photographs of a rig or a sequence, each localized like any other; `joint` poses them together."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from mapless_server.errors import Overloaded, RequestError
from mapless_server.scheduling import StageRecord

from .interface import Engine
from .query import Caller, Query, Result

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


class PhotoGroup:
    """The photographs of a call that are localized each by itself.

    Attributes:
        records: of each photograph, the stages that it has been through; also where one fails.
    """

    def __init__(self, engine: Engine, queries: Sequence[Query], caller: Caller, list_name: str) -> None:
        """A group that has not begun.

        Args:
            engine: which computes.
            queries: the photographs.
            caller: of them all.
            list_name: the field of the request that holds them, for messages about one of them.
        """
        self.records: tuple[list[StageRecord], ...] = tuple([] for _ in queries)
        self._engine = engine
        self._queries = queries
        self._caller = caller
        self._list_name = list_name
        self._waiting = deque(range(len(queries)))
        self._running = 0
        self._done: dict[int, tuple[Result, float]] = {}

    async def localize(self) -> GroupResult:
        """Localizes the photographs, as many at a time as the engine computes.

        All of them at once would be more than a caller may have waiting. A photograph that there is no room for waits
        until another one of the group is done; only the first one is refused.

        Raises:
            RequestError: as of `Engine.run`, its field within the list.
        """
        count = min(len(self._queries), self._engine.parallel_queries)
        workers = [asyncio.ensure_future(self._work()) for _ in range(count)]
        try:
            await asyncio.gather(*workers)
        finally:
            for worker in workers:
                worker.cancel()
            await asyncio.gather(*workers, return_exceptions=True)
        results, seconds = zip(*(self._done[i] for i in range(len(self._queries))), strict=True)
        first = (next(iter(records), None) for records in self.records)
        queued_s = tuple(0.0 if it is None else it.start_s - it.queued_s for it in first)
        return GroupResult(results, queued_s, seconds)

    async def _work(self) -> None:
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
        # Made for each attempt, and not kept: it holds the decoded photograph.
        job = self._engine.query_job(self._queries[index], self._caller)
        try:
            result = await self._engine.run(job)
        except RequestError as error:
            if error.field is not None and error.field.startswith("references"):
                error.field = f"{self._list_name}[{index}].{error.field}"
            raise
        finally:
            self.records[index].extend(job.records)
        self._done[index] = result, time.monotonic() - start_s

    async def _wait(self, refused: Overloaded) -> None:
        """Until there may be room; raises the refusal if nothing was computed or there is no time."""
        pause_s = refused.retry_after_s
        if not self._done or pause_s is None or time.monotonic() + pause_s > self._caller.deadline_s:
            raise refused
        await asyncio.sleep(pause_s)
