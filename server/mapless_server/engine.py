"""What the service asks for, through the work queue: localizing a photograph, describing references."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Awaitable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any

from .decode import ImageLimits
from .errors import DeadlineExceeded, Overloaded, RequestError, Unavailable
from .failures import failure_of
from .library import ReferenceLibrary
from .method.views import View
from .query import Caller, Photo, Query, Result
from .query_stages import COARSE, PREPARE, REFINE, Method, QueryStages, ReferenceSource, Work
from .query_views import QueryViews
from .scheduling.jobs import Done, Expired, Job, Next, Refused, Stage, Step, Verdict, Visit
from .scheduling.observer import Observer, Refusal
from .scheduling.schedule import Quota
from .scheduling.work_queue import Failure, Fatal, Lane, WorkQueue, WorkQueueOptions
from .store import Store
from .tiers import EscalationOptions, Tier
from .turns import Turn

HOST, DEVICE = "host", "device"
"""The lanes: threads for what the CPU does, and the one that has a network's device."""

DESCRIBE = "describe"


@dataclass(frozen=True)
class EngineOptions:
    """Limits of the engine.

    Attributes:
        workers: threads that compute on the CPU.
        max_batch: queries that a network reconstructs at a time.
        max_candidates: references that are compared with a photograph when the request names none.
        image_limits: what is decoded.
        escalation: when stronger features are tried.
        queue: of the work queue.
    """

    workers: int = 2
    max_batch: int = 4
    max_candidates: int = 200
    image_limits: ImageLimits = field(default_factory=ImageLimits)
    escalation: EscalationOptions = field(default_factory=EscalationOptions)
    queue: WorkQueueOptions = field(default_factory=WorkQueueOptions)

    def __post_init__(self) -> None:
        if self.workers < 1 or self.max_batch < 1 or self.max_candidates < 1:
            raise ValueError(f"senseless options: {self}")


class Engine:
    """Owns the tiers and the work queue. Its coroutines run on one event loop."""

    def __init__(
        self,
        store: Store,
        tiers: Sequence[Tier],
        options: EngineOptions,
        observer: Observer | None = None,
        quota: Quota | None = None,
        method: Method | None = None,
    ) -> None:
        """The cheapest tier first; usually there is but one.

        Raises:
            ValueError: no tier, or two with the same extractor or matcher.
        """
        names = {tier.extractor.name for tier in tiers}
        matchers = {id(tier.pipeline.matcher) for tier in tiers}
        if not tiers or not len(names) == len(matchers) == len(tiers):
            raise ValueError("tiers must be one or more, each with an extractor and a matcher of its own")
        self.tiers = tuple(tiers)
        self.options = options
        self._library = ReferenceLibrary(store)
        self._stages = QueryStages(self.tiers, options.max_candidates, options.escalation, method)
        # A backend that lives on correspondences computes on the CPU, one query at a time.
        on_cpu = all(tier.pipeline.reconstructor.uses_correspondences for tier in tiers)
        coarse = Stage(COARSE, HOST, REFINE) if on_cpu else Stage(COARSE, DEVICE, REFINE, options.max_batch)
        self.queue = WorkQueue(
            {
                Stage(DESCRIBE, HOST): self._describe,
                Stage(PREPARE, HOST, COARSE): self._stages.prepare,
                coarse: self._stages.coarse,
                Stage(REFINE, HOST): self._stages.refine,
            },
            [Lane(HOST, options.workers), *([] if on_cpu else [Lane(DEVICE, 1)])],
            options.queue,
            observer or Observer(),
            failure_of,
            quota,
        )

    async def localize(
        self,
        query: Query,
        caller: Caller,
        source: ReferenceSource | None = None,
        visits: list[Visit] | None = None,
    ) -> tuple[Result, Sequence[Visit]]:
        """Localizes a photograph.

        Args:
            query: the photograph and what to compare it with.
            caller: whose query it is.
            source: of the references; None for the store.
            visits: gets the stages that the query goes through, for who wants to know how far it came if it fails.

        Returns:
            The answer, and the stages that the query went through.

        Raises:
            RequestError: a bad image, unknown scene or reference, too many candidates, a full queue, a passed deadline.
        """
        views = QueryViews(query.photo, self.options.image_limits)
        work = Work(query, source or self._library, views, caller.deadline_s)
        step = self._stages.first_step(work)
        with _as_request_errors():
            size_bytes = len(query.photo.image)
            return await self.queue.submit(caller.flow, step, caller.deadline_s, size_bytes, visits)

    def check_room(self) -> None:
        """Raises RequestError if no query of anybody would be admitted now: then none has to be looked at."""
        with _as_request_errors():
            self.queue.check_room(Step(PREPARE, "", "", None))

    async def describe(self, photos: Sequence[Photo], caller: Caller) -> list[dict[str, View]]:
        """What the extractors of all tiers find in photographs, in order, by the extractor's name; without the pixels.

        They are described by as many jobs as there are threads, each one photograph after another, so that others have
        their turn in between.

        Raises:
            RequestError: a bad image, a full queue, a passed deadline.
        """
        task = _Descriptions(deque(enumerate(photos)), [{}] * len(photos))
        jobs = min(self.options.workers, len(photos))
        size_bytes = sum(len(photo.image) for photo in photos) // jobs
        step = Step(DESCRIBE, DESCRIBE, DESCRIBE, task)
        submissions = [
            asyncio.ensure_future(self.queue.submit(caller.flow, step, caller.deadline_s, size_bytes))
            for _ in range(jobs)
        ]
        with _as_request_errors():
            try:
                outcomes = await asyncio.gather(*(_unless_refused(it) for it in submissions))
            finally:
                for submission in submissions:
                    submission.cancel()
                await asyncio.gather(*submissions, return_exceptions=True)
            refusals = [it for it in outcomes if it is not None]
            if len(refusals) == jobs:  # else those that were admitted have done it all
                raise refusals[0]
        return task.described

    def _describe(self, jobs: Sequence[Job]) -> list[Verdict]:
        """The next photograph of each; in the queue's threads."""
        return [self._describe_next(job) for job in jobs]

    def _describe_next(self, job: Job) -> Verdict:
        task: _Descriptions = job.step.payload
        try:
            index, photo = task.remaining.popleft()
        except IndexError:
            return Done(None)
        views, turn = QueryViews(photo, self.options.image_limits), Turn(job.check)
        # A batch is held in memory until it is stored, so without its pixels.
        task.described[index] = {
            it.extractor.name: replace(views.view(it.extractor, turn), photograph=None) for it in self.tiers
        }
        return Next(job.step)

    async def close(self) -> None:
        """Ends what is being computed at its next step, and drops what waits."""
        await self.queue.close()
        await asyncio.to_thread(self._close)

    def _close(self) -> None:
        self._library.close()
        for tier in self.tiers:
            tier.pipeline.matcher.close()
        shared = {id(tier.pipeline.reconstructor): tier.pipeline.reconstructor for tier in self.tiers}
        for reconstructor in shared.values():
            reconstructor.close()


@dataclass(frozen=True, eq=False)
class _Descriptions:
    """Photographs to describe with their places in the list, shared by several jobs, and what was found."""

    remaining: deque[tuple[int, Photo]]
    described: list[dict[str, View]]


async def _unless_refused(submission: Awaitable[Any]) -> Refused | None:
    try:
        await submission
    except Refused as refused:
        return refused
    return None


@contextmanager
def _as_request_errors() -> Iterator[None]:
    """What the queue raises, as the caller is told."""
    try:
        yield
    except Refused as refused:
        raise _refusal(refused) from None
    except Expired as expired:
        raise DeadlineExceeded(str(expired)) from None
    except Fatal as fatal:
        raise Unavailable(
            "the server has failed and is about to end", reason="SERVER_FAILED", retry_after_s=1.0
        ) from fatal
    except Exception as error:
        if failure_of(error) is Failure.OF_MEMORY:
            message = "there is too little memory for this call"
            raise Unavailable(message, reason="OUT_OF_MEMORY", retry_after_s=1.0) from error
        raise


def _refusal(refused: Refused) -> RequestError:
    message, reason = str(refused), refused.reason.name
    if refused.reason is Refusal.DRAINING:
        return Unavailable(message, reason=reason, retry_after_s=refused.retry_after_s)
    if refused.reason is Refusal.DEADLINE_INFEASIBLE and refused.retry_after_s is None:
        return DeadlineExceeded(message, reason=reason)
    return Overloaded(message, reason=reason, retry_after_s=refused.retry_after_s)
