"""What the services ask for, through the work queue: localizing a photograph, and whatever else takes computing."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Collection, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, TypeVar

from mapless_server.errors import DeadlineExceeded, Overloaded, RequestError, Unavailable
from mapless_server.images.decode import ImageLimits
from mapless_server.method.turns import Turn
from mapless_server.scenes.audit.coverage import Coverage
from mapless_server.scenes.audit.neighbourhood import PairMatches
from mapless_server.scenes.audit.verdict import ReferenceAudit
from mapless_server.scenes.auditing import SceneExaminer, Tools, Viewpoint
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.scenes.retrieval.chosen import Choice
from mapless_server.scenes.retrieval.descriptor import GlobalDescriptor
from mapless_server.scenes.retrieval.narrowing import Narrowing
from mapless_server.scenes.retrieval.vlad import VladDescriptor
from mapless_server.scheduling import (
    ComputeItem,
    Expired,
    Failure,
    Fatal,
    ItemList,
    Observer,
    Quota,
    Refusal,
    Refused,
    Stage,
    StageRecord,
    Step,
    WorkQueue,
    WorkQueueOptions,
    compute_items,
)
from mapless_server.security.tenancy import SceneKey
from mapless_server.store import Store

from .choosing import ReferenceChooser
from .describing import Describer, Description
from .failures import failure_of
from .query import Caller, Photo, Query, Result
from .stages import COARSE, PREPARE, REFINE, Method, QueryStages, ReferenceSource, Work
from .tiers import EscalationOptions, Tier
from .views import QueryViews

ItemT = TypeVar("ItemT")
Joined = TypeVar("Joined")
ResultT = TypeVar("ResultT")

HOST, DEVICE = "host", "device"
"""The lanes: threads for what the CPU does, and the one that has a network's device."""

DESCRIBE, RETRIEVE, AUDIT, COVERAGE = "describe", "retrieve", "audit", "coverage"
"""What is computed beside localizing, item by item."""

JOIN = "join"
"""What is computed of several photographs that were localized, together."""

REMEMBERED_PAIRS = 2000
"""Whose matches audits remember, about 10 KB a pair."""


@dataclass(frozen=True)
class EngineOptions:
    """Limits of the engine.

    Attributes:
        workers: threads that compute on the CPU.
        max_batch: queries that a network reconstructs at a time.
        image_limits: what is decoded.
        index_cache_bytes: memory for what is held of scenes to choose references by.
        escalation: when stronger features are tried.
        coverage: share of right answers to accept where a request does not say.
        queue: of the work queue.
    """

    workers: int = 2
    max_batch: int = 4
    image_limits: ImageLimits = field(default_factory=ImageLimits)
    index_cache_bytes: int = 1024 * 2**20
    escalation: EscalationOptions = field(default_factory=EscalationOptions)
    coverage: float = 0.99
    queue: WorkQueueOptions = field(default_factory=WorkQueueOptions)

    def __post_init__(self) -> None:
        if self.workers < 1 or self.max_batch < 1 or not 0 < self.coverage < 1:
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
        descriptor: GlobalDescriptor | None = None,
    ) -> None:
        """The cheapest tier first; usually there is but one.

        Args:
            store: of the references.
            tiers: features and what works on them, the cheapest first.
            options: limits.
            observer: hears what the queue does.
            quota: what each tenant may use.
            method: stands in for the method's parts in tests.
            descriptor: what references are chosen by; None makes one of the first tier's features.

        Raises:
            ValueError: no tier, or two with the same extractor or matcher.
        """
        names = {tier.extractor.name for tier in tiers}
        matchers = {id(tier.pipeline.matcher) for tier in tiers}
        if not tiers or not len(names) == len(matchers) == len(tiers):
            raise ValueError("tiers must be one or more, each with an extractor and a matcher of its own")
        self.tiers = tuple(tiers)
        self.options = options
        extractors = [tier.extractor for tier in self.tiers]
        descriptor = descriptor or VladDescriptor.of(extractors[0])
        self._library = ReferenceLibrary(store)
        indexes = SceneIndexes(store, self._library, descriptor, extractors[0], options.index_cache_bytes)
        self._describer = Describer(extractors, descriptor, options.image_limits)
        self._chooser = ReferenceChooser(indexes, descriptor, extractors[0])
        ratio = self.tiers[0].pipeline.matcher.options.reference_ratio
        pairs = PairMatches(ratio, REMEMBERED_PAIRS)
        self._tools = Tools(self._library, indexes, descriptor, extractors[0], pairs)
        self._stages = QueryStages(self.tiers, self._chooser, options.escalation, method)
        # A backend that lives on correspondences computes on the CPU, one query at a time.
        on_cpu = all(tier.pipeline.reconstructor.uses_correspondences for tier in tiers)
        coarse = Stage(COARSE, HOST, REFINE) if on_cpu else Stage(COARSE, DEVICE, REFINE, options.max_batch)
        self.queue = WorkQueue(
            {
                **{Stage(name, HOST): compute_items for name in (DESCRIBE, RETRIEVE, AUDIT, COVERAGE, JOIN)},
                Stage(PREPARE, HOST, COARSE): self._stages.prepare,
                coarse: self._stages.coarse,
                Stage(REFINE, HOST): self._stages.refine,
            },
            {HOST: options.workers} if on_cpu else {HOST: options.workers, DEVICE: 1},
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
        visits: list[StageRecord] | None = None,
        tell_coarse: Callable[[Result], None] | None = None,
    ) -> tuple[Result, Sequence[StageRecord]]:
        """Localizes a photograph.

        Args:
            query: the photograph and what to compare it with.
            caller: whose query it is.
            source: of the references; None for the store.
            visits: gets the stages that the query goes through, for who wants to know how far it came if it fails.
            tell_coarse: told, on the event loop and before the answer, the pose that is known before it is refined,
                where there is one: a localization of the first tier, checked by nothing. More than once if references
                go while they are used. What is answered does not depend on whether somebody is told.

        Returns:
            The answer, and the stages that the query went through.

        Raises:
            RequestError: a bad image, unknown scene or reference, a full queue, a passed deadline.
        """
        views = QueryViews(query.photo, self.options.image_limits)
        work = Work(query, source or self._library, views, caller.deadline_s)
        if tell_coarse is not None:
            work = replace(work, tell_coarse=_on_this_loop(tell_coarse))
        step = self._stages.first_step(work)
        with _as_request_errors():
            size_bytes = 0 if query.is_part else len(query.photo.image)  # which `hold` counts
            return await self.queue.submit(caller.flow, step, caller.deadline_s, size_bytes, visits)

    @contextmanager
    def hold(self, queries: Sequence[Query], caller: Caller) -> Iterator[None]:
        """Counts the photographs of a group as held for as long as its call lasts, whichever of them are queued.

        Raises:
            RequestError: there is no room for them.
        """
        with ExitStack() as stack:
            with _as_request_errors():
                size_bytes = sum(len(query.photo.image) for query in queries)
                stack.enter_context(self.queue.hold(caller.flow, size_bytes))
            yield

    def check_room(self) -> None:
        """Raises RequestError if no query of anybody would be admitted now: then none has to be looked at."""
        with _as_request_errors():
            self.queue.check_room(Step(PREPARE, "", "", None))

    async def describe(self, photos: Sequence[Photo], caller: Caller) -> list[Description]:
        """What is found in photographs, in order.

        Raises:
            RequestError: a bad image, a full queue, a passed deadline.
        """
        size_bytes = sum(len(photo.image) for photo in photos)
        return await self._each(DESCRIBE, photos, self._describer.describe, caller, size_bytes)

    async def retrieve(
        self, scene_key: SceneKey, photo: Photo, count: int, narrowing: Narrowing, caller: Caller
    ) -> Choice:
        """The references of a scene that resemble a photograph most.

        Raises:
            RequestError: a bad image, an unknown scene, a full queue, a passed deadline.
        """

        def choose(photo: Photo, check: Callable[[], None]) -> Choice:
            views = QueryViews(photo, self.options.image_limits)
            return self._chooser.choose(scene_key, views, count, narrowing, (), Turn(check))

        (choice,) = await self._each(RETRIEVE, [photo], choose, caller, len(photo.image))
        return choice

    async def audit(
        self, scene_key: SceneKey, reference_ids: Sequence[str], caller: Caller, are_listed: bool = False
    ) -> tuple[int, list[ReferenceAudit]]:
        """The scene's generation, and what the neighbours of some of its references say about them, in order.

        Those that are not there are left out if they were listed, not named by the caller.

        Raises:
            RequestError: an unknown scene or named reference, a full queue, a passed deadline.
        """
        examiner = SceneExaminer(self._tools, scene_key, () if are_listed else reference_ids)
        audits = await self._each(AUDIT, reference_ids, examiner.audit, caller, 0, jobs=1)
        return examiner.generation, [audit for audit in audits if audit is not None]

    async def check_coverage(self, scene_key: SceneKey, view: Viewpoint, caller: Caller) -> tuple[int, Coverage]:
        """The scene's generation, and whether a photograph would be localized there.

        Raises:
            RequestError: an unknown scene, a full queue, a passed deadline.
        """
        examiner = SceneExaminer(self._tools, scene_key)
        (coverage,) = await self._each(COVERAGE, [view], examiner.check_coverage, caller, 0)
        return examiner.generation, coverage

    @property
    def parallel_queries(self) -> int:
        """How many queries are worth being underway at a time."""
        return max(self.options.workers, self.options.max_batch)

    async def join(self, compute: Callable[[], Joined], caller: Caller) -> Joined:
        """What is computed of several photographs' answers, in its turn, however full the queue is.

        Raises:
            RequestError: a passed deadline.
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
        jobs: int | None = None,
        continues: bool = False,
    ) -> list[ResultT]:
        """Computes items by several jobs, or else as many as there are threads; others have their turn in between."""
        work = ItemList(items, compute)
        jobs = min(jobs or self.options.workers, len(items))
        step = Step(stage, stage, stage, work)
        submissions = [
            asyncio.ensure_future(
                self.queue.submit(caller.flow, step, caller.deadline_s, size_bytes // jobs, continues=continues)
            )
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
        return work.results

    def forget_references(self, keys: Collection[str]) -> None:
        """Takes no more memory for what was found out of references, which have been deleted."""
        for tier in self.tiers:
            tier.pipeline.matcher.forget(keys)

    def forget_scene(self, scene_key: SceneKey) -> None:
        """Takes no more memory for a scene, which has been deleted."""
        self._chooser.indexes.forget(scene_key)

    @property
    def index_bytes(self) -> int:
        """What the scenes that references are chosen from take in memory."""
        return self._chooser.indexes.size_bytes

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


def _on_this_loop(tell: Callable[[Result], None]) -> Callable[[Result], None]:
    """What may be called from any thread, and has it told on the running event loop."""
    loop = asyncio.get_running_loop()

    def told(result: Result) -> None:
        loop.call_soon_threadsafe(tell, result)

    return told


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
