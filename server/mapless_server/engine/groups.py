"""The photographs of a rig or a sequence, each localized like any other; `joint` poses them together."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import TYPE_CHECKING

from mapless_server.errors import Overloaded, RequestError
from mapless_server.scheduling import StageRecord

from .query import Caller, Query, Result

if TYPE_CHECKING:  # services need not load what computes
    from mapless_server.method.rejection import Rejection

    from .queue_engine import QueueEngine

MAX_RIG_IMAGES = 8
MIN_FRAMES, MAX_FRAMES = 2, 16
"""Numbers of frames of a sequence."""


def after_rejection(queries: Sequence[Query], outcome: Rejection) -> list[Query] | None:
    """The photographs of a group on the rung that follows their joint rejection; None if no rung changes references.

    Each photograph has climbed the other rungs by itself.
    """
    from mapless_server.method.judge.hypothesis import Attempt, Where, doubt_of  # services need not load what computes
    from mapless_server.method.ladder import Situation, further

    situation = Situation(may_be_elsewhere=any(it.chooses and it.narrowing.has_likely for it in queries))
    following = further(Attempt(), [Attempt()], doubt_of(outcome), situation)
    if not any(attempt.where is Where.ANYWHERE for _, attempt in following):
        return None
    return [replace(it, narrowing=it.narrowing.limits) for it in queries]


@dataclass(frozen=True, eq=False)
class GroupResult:
    """The results of a group's photographs, each localized alone, in the order of the queries.

    `queued_s` is the time that each waited before its computation began, `seconds` that of the computation, and
    `processor_s` the processor time that it took.
    """

    results: tuple[Result, ...]
    queued_s: tuple[float, ...]
    seconds: tuple[float, ...]
    processor_s: tuple[float, ...]

    @staticmethod
    def of(groups: Sequence[GroupResult]) -> GroupResult:
        """The results of several groups, one after the other."""
        return GroupResult(
            tuple(chain.from_iterable(it.results for it in groups)),
            tuple(chain.from_iterable(it.queued_s for it in groups)),
            tuple(chain.from_iterable(it.seconds for it in groups)),
            tuple(chain.from_iterable(it.processor_s for it in groups)),
        )

    def and_then(self, indices: Sequence[int], later: GroupResult) -> GroupResult:
        """The results after some photographs, by their indices, were localized again: theirs are the later ones."""
        row = dict(zip(indices, range(len(indices)), strict=True))
        results = tuple(later.results[row[i]] if i in row else it for i, it in enumerate(self.results))

        def total(before: tuple[float, ...], after: tuple[float, ...]) -> tuple[float, ...]:
            return tuple(it + (after[row[i]] if i in row else 0.0) for i, it in enumerate(before))

        queued_s, seconds = total(self.queued_s, later.queued_s), total(self.seconds, later.seconds)
        return GroupResult(results, queued_s, seconds, total(self.processor_s, later.processor_s))

    def read_as_in(self, earlier: GroupResult) -> GroupResult:
        """The results with the cameras of an earlier round, with which the photographs were read as given ones."""
        pairs = zip(self.results, earlier.results, strict=True)
        results = [replace(it, camera=it.camera or before.camera) for it, before in pairs]
        return replace(self, results=tuple(results))


class PhotoGroup:
    """The photographs of a call that are localized one by one.

    `records` are the stages that each photograph has been through, also if one of them fails.
    """

    def __init__(self, engine: QueueEngine, queries: Sequence[Query], caller: Caller, list_name: str) -> None:
        """Makes a group whose computation has not begun.

        Messages about a photograph name the request's field, `list_name`.
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
        """Localizes the photographs, as many concurrently as the engine can compute.

        All of them together would exceed the number that a caller may have waiting. A photograph for which the queue
        has no room waits until another one of the group is done; only the first one can be refused. RequestError as in
        `QueueEngine.run`, with the field's path in the list.
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
        processor_s = tuple(sum(it.processor_s for it in records) for records in self.records)
        return GroupResult(results, queued_s, seconds, processor_s)

    async def _work(self) -> None:
        """Localizes waiting photographs until none waits or the queue has room for fewer concurrent ones."""
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
        """Waits until there may be room; raises the refusal if nothing was computed or no time is left."""
        pause_s = refused.retry_after_s
        if not self._done or pause_s is None or time.monotonic() + pause_s > self._caller.deadline_s:
            raise refused
        await asyncio.sleep(pause_s)
