"""The engine, as services call it: localizes photographs, describes and audits references, in the queue's threads."""

import asyncio
from collections.abc import Awaitable, Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from typing import TypeVar

from mapless_server.engine.photo_views import QueryViews
from mapless_server.engine.query import Description, Photo
from mapless_server.errors import DeadlineExceeded, Overloaded, RequestError, Unavailable
from mapless_server.method.options import StageContext
from mapless_server.scenes import Choice, Coverage, Narrowing, ReferenceAudit, Selection, Viewpoint
from mapless_server.scenes.background import BackgroundMatching
from mapless_server.scheduling import (
    ComputeItem,
    Expired,
    Failure,
    Fatal,
    Flow,
    ItemJob,
    ItemList,
    Job,
    Observer,
    Quota,
    Refusal,
    Refused,
    Stage,
    Step,
    WorkQueue,
    compute_items,
)
from mapless_server.security import SceneKey

from .failures import failure_of
from .options import EngineOptions
from .query import COARSE, PREPARE, REFINE, Caller, Query, Result, Tier
from .references import References
from .search import Search, SearchJob
from .source import ReferenceSource
from .stages import Method, QueryStages

ItemT = TypeVar("ItemT")
Joined = TypeVar("Joined")
ResultT = TypeVar("ResultT")

HOST, DEVICE = "host", "device"
"""The lanes: threads for what the CPU does, and the one that has a network's device."""

DESCRIBE, RETRIEVE, AUDIT, COVERAGE = "describe", "retrieve", "audit", "coverage"
"""Computed beside localizing, item by item."""

JOIN = "join"
"""Poses several photographs together that were localized each by itself."""

_QUERY, _UPLOAD = Step(PREPARE, "", "", None), Step(DESCRIBE, DESCRIBE, DESCRIBE, None)


class QueueEngine:
    """The engine that computes through one work queue. Its coroutines run on one event loop.

    The methods that compute raise RequestError for a bad image, an unknown scene or reference, a full queue, or a
    passed deadline.

    Attributes:
        tiers: the tiers, the cheapest first.
        options: limits of the engine.
        references: references of all scenes.
        queue: the work queue.
        background: matches references when the queue is empty, once it is started; None if references are not matched
            in the background.
    """

    def __init__(
        self,
        tiers: Sequence[Tier],
        references: References,
        options: EngineOptions,
        observer: Observer | None = None,
        quota: Quota | None = None,
        method: Method | None = None,
    ) -> None:
        """Makes an engine over tiers, the cheapest first; its queue begins to compute with the first job.

        The references have features of every tier. The observer is notified of what the queue does; the quota is the
        computing time of each tenant; `method` replaces the method's parts in tests. ValueError for no tier, or two
        with the same extractor or matcher.
        """
        check_tiers(tiers)
        self.tiers = tuple(tiers)
        self.options = options
        self.references = references
        self.background: BackgroundMatching | None = None
        stages = QueryStages(self.tiers, options.doubt, method, is_alone=self._is_alone)
        is_batched = any(tier.pipeline.reconstructor.is_batched for tier in tiers)
        coarse = Stage(COARSE, DEVICE, REFINE, options.max_batch) if is_batched else Stage(COARSE, HOST, REFINE)
        self.queue = WorkQueue(
            {
                **{Stage(name, HOST): compute_items for name in (DESCRIBE, RETRIEVE, AUDIT, COVERAGE, JOIN)},
                Stage(PREPARE, HOST, COARSE): stages.prepare,
                coarse: stages.coarse,
                Stage(REFINE, HOST): stages.refine,
            },
            {HOST: options.workers, DEVICE: 1} if is_batched else {HOST: options.workers},
            options.queue,
            observer or Observer(),
            failure_of,
            quota,
            {HOST: options.workers},
        )

    def answered(self, caller: Caller, is_localized: bool) -> None:
        """Counts an answer: a caller whose last photographs all failed waits for the others."""
        self.queue.answered(caller.flow, is_localized)

    def _is_alone(self) -> bool:
        """Whether the queue has one job only, beside those that give way."""
        return self.queue.prompt_count == 1

    def views_of(self, query: Query) -> QueryViews:
        """The views of a query's photograph, for several jobs: it is decoded and described once for all of them."""
        return QueryViews(query.photo, self.options.image_limits)

    def query_job(
        self,
        query: Query,
        caller: Caller,
        source: ReferenceSource | None = None,
        *,
        views: QueryViews | None = None,
        on_better: Callable[[Result], None] | None = None,
        gives_way: bool = False,
    ) -> SearchJob:
        """Makes the job of localizing a photograph, for `run`; its `records` list the stages that it has been through.

        `source` replaces the references, for the warm-up. `views` are those of an ended job of the photograph.
        `on_better` is called on the event loop, before the answer, with each accepted answer that is better than the
        ones before while another attempt follows; and, if the query allows it, with the coarse pose, which nothing has
        checked. The answer does not depend on it. A job that `gives_way` is computed by threads of low priority.
        """
        search = Search.begin(query, source or self.references, views or self.views_of(query), caller.deadline_s)
        search = search.but(is_cut_at=lambda *_: self.queue.gets_cheap_steps(caller.flow))
        if on_better is not None:
            loop = asyncio.get_running_loop()
            search = search.but(on_better=lambda result: loop.call_soon_threadsafe(on_better, result))
        size_bytes = 0 if query.is_part else query.photo.size_bytes  # which `hold` counts
        return Job(caller.flow, search.first_step, caller.deadline_s, size_bytes, gives_way=gives_way)

    async def run(self, job: SearchJob) -> Result:
        """Computes a query's job and returns its result."""
        with _as_request_errors():
            return await self.queue.run(job)

    @contextmanager
    def hold(self, queries: Sequence[Query], caller: Caller) -> Iterator[None]:
        """Reserves the memory of a group's photographs for its whole call, however many of them are queued."""
        with ExitStack() as stack:
            with _as_request_errors():
                size_bytes = sum(query.photo.size_bytes for query in queries)
                stack.enter_context(self.queue.hold(caller.flow, size_bytes))
            yield

    def check_room(self, flow: Flow, is_query: bool = True) -> None:
        """Raises RequestError if no query of a caller would be admitted now, or no upload; its message is not read."""
        try:
            self.queue.check_room(flow, _QUERY if is_query else _UPLOAD)
        except Refused as refused:
            raise _refusal(refused) from None

    async def describe(self, photos: Sequence[Photo], caller: Caller, *, gives_way: bool = False) -> list[Description]:
        """Computes features and descriptors of photographs, in order; `gives_way` as of `query_job`."""
        size_bytes = sum(photo.size_bytes for photo in photos)
        return await self._each(DESCRIBE, photos, self.references.describe, caller, size_bytes, gives_way=gives_way)

    async def retrieve(
        self, scene_key: SceneKey, photo: Photo, count: int, narrowing: Narrowing, caller: Caller
    ) -> Choice:
        """Chooses the references of a scene that resemble a photograph most."""

        def choose(photo: Photo, check: Callable[[], None]) -> Choice:
            views = QueryViews(photo, self.options.image_limits)
            return self.references.choose(scene_key, views, Selection(count, narrowing), StageContext(check))

        (choice,) = await self._each(RETRIEVE, [photo], choose, caller, photo.size_bytes)
        return choice

    async def audit(
        self, scene_key: SceneKey, reference_ids: Sequence[str], caller: Caller, are_listed: bool = False
    ) -> tuple[int, list[ReferenceAudit]]:
        """Audits references of a scene by their neighbours; returns the scene's generation and the audits, in order.

        References that do not exist any more are left out if `are_listed`, that is, if the caller did not name them.
        """
        auditor = self.references.auditor(scene_key, () if are_listed else reference_ids)
        audits = await self._each(AUDIT, reference_ids, auditor.audit, caller, 0, most_jobs=1)
        return auditor.generation, [audit for audit in audits if audit is not None]

    async def check_coverage(self, scene_key: SceneKey, view: Viewpoint, caller: Caller) -> tuple[int, Coverage]:
        """Predicts whether a photograph would be localized at a viewpoint; also returns the scene's generation."""
        auditor = self.references.auditor(scene_key)
        (coverage,) = await self._each(COVERAGE, [view], auditor.check_coverage, caller, 0)
        return auditor.generation, coverage

    @property
    def parallel_queries(self) -> int:
        """How many queries of one call are worth computing concurrently."""
        return max(self.options.workers, self.options.max_batch)

    async def join(self, compute: Callable[[], Joined], caller: Caller) -> Joined:
        """Computes from several photographs' answers, in its turn in the queue, which does not refuse it.

        RequestError for a passed deadline.
        """

        def once(_: None, check: Callable[[], None]) -> Joined:
            check()
            return compute()

        (joined,) = await self._each(JOIN, [None], once, caller, 0, continues=True)
        return joined

    async def _each(
        self,
        stage: str,
        items: Sequence[ItemT],
        compute: ComputeItem[ItemT, ResultT],
        caller: Caller,
        size_bytes: int,
        most_jobs: int | None = None,
        continues: bool = False,
        gives_way: bool = False,
    ) -> list[ResultT]:
        """Computes items in several jobs, at most as many as there are threads, so that other jobs run in between."""
        work = ItemList(items, compute)
        jobs = min(most_jobs or self.options.workers, len(items))
        step = Step(stage, stage, stage, work)

        def job() -> ItemJob[ItemT, ResultT]:
            size = size_bytes // jobs
            return Job(caller.flow, step, caller.deadline_s, size, continues=continues, gives_way=gives_way)

        submissions = [asyncio.ensure_future(self.queue.run(job())) for _ in range(jobs)]
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
        return work.results

    def forget_references(self, keys: Collection[str]) -> None:
        """Frees the memory of deleted references."""
        for tier in self.tiers:
            tier.pipeline.matcher.forget(keys)
        self.references.agreements.forget_references(keys)

    def forget_scene(self, scene_key: SceneKey) -> None:
        """Frees the memory of a deleted scene."""
        self.references.forget_scene(scene_key)

    def drain(self) -> None:
        """Refuses all new jobs; admitted ones are still computed."""
        self.queue.drain()

    async def close(self) -> None:
        """Ends running computations at their next step, and drops waiting jobs."""
        await self.queue.close()
        await asyncio.to_thread(self._close)

    def _close(self) -> None:
        self.references.close()
        for tier in self.tiers:
            tier.pipeline.matcher.close()
        shared = {id(tier.pipeline.reconstructor): tier.pipeline.reconstructor for tier in self.tiers}
        for reconstructor in shared.values():
            reconstructor.close()


def check_tiers(tiers: Sequence[Tier]) -> None:
    """Raises ValueError if there is no tier, or two have the same extractor or matcher."""
    names = {tier.extractor.name for tier in tiers}
    matchers = {id(tier.pipeline.matcher) for tier in tiers}
    if not tiers or not len(names) == len(matchers) == len(tiers):
        raise ValueError("tiers must be one or more, each with an extractor and a matcher of its own")


async def _unless_refused(submission: Awaitable[None]) -> Refused | None:
    try:
        await submission
    except Refused as refused:
        return refused
    return None


@contextmanager
def _as_request_errors() -> Iterator[None]:
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
        if failure_of(error) is Failure.OUT_OF_MEMORY:
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
