"""Computes the answer of a captured call again, by the services and the method, on its inputs and stored references.

Computations run one after another without the queue and without deadlines. If time limited the captured answer, this
one is limited in the same way: features that were not completed are not tried, and a pose that was not refined is not
refined.
"""

import asyncio
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from types import SimpleNamespace
from typing import Any, TypeVar, cast

from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.photo_views import QueryViews
from mapless_server.engine.query import COARSE, POSE_PRIOR, PREPARE, REFINE, Caller, Query, Result, Tier
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.engine.search import Search, SearchJob, SearchStep
from mapless_server.engine.stages import Method, QueryStages
from mapless_server.errors import DataLoss, NotFound
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import PosedView
from mapless_server.method.judge.hypothesis import Attempt, Found, found_by
from mapless_server.method.options import DoubtOptions, StageContext
from mapless_server.method.pipeline import Coarse, coarse_answer
from mapless_server.method.solve import solve
from mapless_server.observability.metrics import Metrics
from mapless_server.rpc import Call
from mapless_server.scenes import Choice, Selection
from mapless_server.scenes.library import Loaded, ReferenceLibrary
from mapless_server.scenes.observer import BackgroundObserver
from mapless_server.scenes.stored import DepthFinder
from mapless_server.scheduling import Done, Flow, Job, Next
from mapless_server.security import Principal, SceneKey, key_of
from mapless_server.services.capture.calls import CapturedCall, CapturedPart, CaptureError, Response, diagnostics_of
from mapless_server.services.localization import LocalizationService
from mapless_server.services.watching import Watchers
from mapless_server.store import (
    DescribedReference,
    LruCache,
    ReferenceRecord,
    SceneState,
    Store,
    codec,
)

from .several import ScenesOfCall, in_found_scene, in_scene_of, no_extents

Joined = TypeVar("Joined")

_CALLER_FAILS = pb.LADDER_CUT_REASON_CALLER_FAILS

RETRIEVAL = "retrieval"
"""The stage in which references are chosen."""
_CACHE_BYTES = 512 * 2**20


class StoredReferences:
    """References of captured calls in a store, which is only read: features that it lacks are kept in memory.

    `damaged` has what is said of references of the call that was checked last.
    """

    def __init__(self, store: Store, uses_depths: bool) -> None:
        self.damaged: list[str] = []
        self._store = store
        self._library = ReferenceLibrary(store)
        self._depths = DepthFinder(store.database, BackgroundObserver()) if uses_depths else None
        self._described: LruCache[DescribedReference] = LruCache(_CACHE_BYTES)

    def check(self, call: CapturedCall) -> None:
        """Raises CaptureError, which names them, if references of a call were deleted or replaced since."""
        self.damaged = []
        keys = dict.fromkeys(it for part in call.parts for it in part.references.items())
        names = list(dict.fromkeys(name for name, _ in keys))
        try:
            present = self._store.find_keys(key_of(call.tenant, call.scene_id), names) if names else {}
        except NotFound as error:
            raise CaptureError(f"scene {call.scene_id!r} was deleted since, or is in another store") from error
        changed = [
            f"{name!r} was {'replaced' if name in present else 'deleted'}"
            for name, key in keys
            if present.get(name) != key
        ]
        if changed:
            raise CaptureError(f"references of scene {call.scene_id!r} have changed since: {', '.join(changed)}")

    def load(
        self, scene_key: SceneKey, reference_ids: Sequence[str], extractor: FeatureExtractor
    ) -> tuple[PosedView, ...]:
        """Loads references with features of this extractor; DataLoss if one is damaged."""
        snapshot = self._store.load_references(scene_key, reference_ids, extractor.name)
        found = {it.record.reference_id: it for it in snapshot.references}
        found |= {it.reference_id: self._describe(it, extractor) for it in snapshot.undescribed}
        views = tuple(self._library.posed_view(found[it]) for it in reference_ids)
        return views if self._depths is None else self._depths.with_depths(views, extractor.name)

    def _describe(self, record: ReferenceRecord, extractor: FeatureExtractor) -> DescribedReference:
        described = self._described.get((record.key, extractor.name))
        if described is None:
            # As a store returns them, rounded: then the answer is the same, bit for bit, as from stored ones.
            data = codec.encode_view(self._library.extract(record, extractor))
            described = DescribedReference(record, codec.decode_view("", data, codec.sha256_for("", data)))
            self._described.put((record.key, extractor.name), described, len(data))
        return described


@dataclass(frozen=True, eq=False)
class RecordedSource:
    """References of one photograph of a captured call and their choice; see `ReferenceSource`.

    `is_described` says whether the photograph was described for the choice, which takes a reference to compare it with.
    `any_roll` names the features that choose references of their own; None if there are none.
    """

    call: CapturedCall
    part: CapturedPart
    references: StoredReferences
    extractor: FeatureExtractor
    is_described: bool
    any_roll: str | None = None

    def load(
        self,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
    ) -> Loaded:
        """Implements ReferenceSource with the captured references; others could not be read then either."""
        for index, reference_id in enumerate(reference_ids):
            if reference_id not in self.part.references:
                raise DataLoss(f"reference {reference_id!r} was not captured", field=f"references[{index}]")
        scene = SceneState(self.part.generation, 0, lambda: self.call.attributes)
        return scene, self.references.load(scene_key, reference_ids, extractor)

    def pending(self, scene_key: SceneKey) -> tuple[()]:
        """Implements ReferenceSource: what was missing then is in the cuts."""
        return ()

    def contradiction(self, scene_key: SceneKey) -> str:
        """Implements ReferenceSource: it is captured with the attributes."""
        return ""

    def choose(
        self,
        scene_key: SceneKey,
        views: QueryViews,
        selection: Selection,
        context: StageContext,
        extractor: FeatureExtractor | None = None,
    ) -> Choice:
        """The captured choice, by features for any roll where these choose; near a prior only if it was so chosen.

        CaptureError if there is none.
        """
        choices = self.part.choices
        if selection.near is not None:
            near = (it for it in choices if it.descriptor == POSE_PRIOR)
            return next(near, Choice((), POSE_PRIOR, self.part.generation))
        choices = tuple(it for it in choices if it.descriptor != POSE_PRIOR) or choices
        if not choices:
            raise CaptureError("no choice of references was captured")
        wants_own = extractor is not None and extractor.name == self.any_roll
        if self.is_described:
            views.view(extractor if extractor is not None and wants_own else self.extractor, context)
            with context.stage(RETRIEVAL):  # it takes no time, but the answer lists it
                pass
        is_own = {it.descriptor: self.any_roll is not None and it.descriptor.endswith(self.any_roll) for it in choices}
        return next((it for it in choices if is_own[it.descriptor] == wants_own), choices[0])

    def sample(self, scene_key: SceneKey, among: Sequence[str], count: int, context: StageContext) -> list[str]:
        """Implements ReferenceSource with the captured references, of which most are held as most of the scene's."""
        return list(self.part.references)[:count]

    def report_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Implements ReferenceSource: the reference is left out, as in a captured call if it was damaged then."""
        self.references.damaged.append(str(error))


MESSAGES: dict[str, tuple[Any, Any]] = {
    "Localize": (pb.LocalizeRequest, pb.LocalizeResponse),
    "LocalizeRig": (pb.LocalizeRigRequest, pb.LocalizeRigResponse),
    "LocalizeSequence": (pb.LocalizeSequenceRequest, pb.LocalizeSequenceResponse),
}
"""Request and response of each method that is captured."""


def response_of(call: CapturedCall) -> Response:
    """The captured answer; CaptureError if it is of a method that this program does not know."""
    if call.method not in MESSAGES:
        raise CaptureError(f"this program knows no method {call.method}")
    return cast(Response, MESSAGES[call.method][1].FromString(call.response))


def recompute(
    call: CapturedCall, references: StoredReferences, tiers: Sequence[Tier], options: EngineOptions
) -> Response:
    """Computes the answer to a captured call again, by present tiers, limits and defaults.

    CaptureError if references have changed since, or the method is not known; RequestError or FieldError if the call
    is refused now.
    """
    then = response_of(call)
    references.check(call)
    request = in_found_scene(MESSAGES[call.method][0].FromString(call.request), then, call)
    engine = cast(QueueEngine, _Recomputing(call, request, then, references, tiers, options))
    store = cast(Store, ScenesOfCall(call))
    service = LocalizationService(lambda: engine, Metrics(), store, Watchers(False))
    service.names_outdated = False  # which places needed a new survey is not captured
    now = Call(call.request_id, time.monotonic(), math.inf, Principal(tenant=call.tenant))
    return cast(Response, asyncio.run(getattr(service, call.method)(request, now)))


class _Recomputing:
    """The part of the engine that services call; a photograph is identified by its field in the request."""

    parallel_queries = 1
    references = SimpleNamespace(extents_m=no_extents)

    def __init__(
        self,
        call: CapturedCall,
        request: Any,
        then: Response,
        references: StoredReferences,
        tiers: Sequence[Tier],
        options: EngineOptions,
    ) -> None:
        self.options = options
        self._call = call
        self._stored = references
        self._tiers = tiers
        self._parts = {part.field: part for part in call.parts}
        described = zip(self._parts, diagnostics_of(then), strict=True)
        self._then = dict(described)
        self._described = {field for field, it in self._then.items() if RETRIEVAL in [of.stage for of in it.stages]}
        unrefined = Method(solve=_unrefined)
        self._method = unrefined if _is_cut_short(request, then) else Method()

    def query_job(
        self, query: Query, caller: Caller, source: object = None, views: object = None, on_better: object = None
    ) -> SearchJob:
        query, field = in_scene_of(query, self._call), query.photo.field
        extractor, part = self._tiers[0].extractor, self._parts[field]
        any_roll = next((it.features for it in self._tiers if it.any_roll), None)
        recorded = RecordedSource(self._call, part, self._stored, extractor, field in self._described, any_roll)
        views = QueryViews(query.photo, self.options.image_limits)
        cuts = [(it.rung, it.features) for it in self._then[field].ladder_cuts if it.reason == _CALLER_FAILS]
        search = Search.begin(query, recorded, views, math.inf)
        search = replace(search, is_cut_at=lambda rung, features: (rung, features) in cuts)
        return Job(Flow("", ""), search.first_step, math.inf, 0)

    async def run(self, job: SearchJob) -> Result:
        search = job.step.payload
        then = self._then[search.query.photo.field]
        stages = QueryStages(self._tiers, self.options.doubt, self._method)
        return await asyncio.to_thread(_compute, stages, job, partial(followed, then, self._tiers))

    def answered(self, caller: Caller, is_localized: bool) -> None:
        pass

    @contextmanager
    def hold(self, queries: Sequence[Query], caller: Caller) -> Iterator[None]:
        yield

    async def join(self, compute: Callable[[], Joined], caller: Caller) -> Joined:
        return await asyncio.to_thread(compute)


def _unrefined(coarse: Coarse, attempt: Attempt, doubt: DoubtOptions) -> Found:
    """The coarse pose, where the answer was given without time to refine it."""
    answer = coarse_answer(coarse)
    return solve(coarse, attempt, doubt) if answer is None else found_by(attempt, answer, doubt)


def _compute(
    stages: QueryStages, job: SearchJob, follow: Callable[[Next[Search, Result]], tuple[SearchStep, bool]]
) -> Result:
    of_name = {PREPARE: stages.prepare, COARSE: stages.coarse, REFINE: stages.refine}
    while True:
        (result,) = of_name[job.step.stage]([job])
        if isinstance(result, Done):
            return result.value
        if isinstance(result, Exception):
            raise result
        job.step, had_result = follow(result)
        if not had_result and result.fallback is not None:
            return result.fallback.make(job.step.payload).value


def followed(then: pb.Diagnostics, tiers: Sequence[Tier], following: Next[Search, Result]) -> tuple[SearchStep, bool]:
    """The step that came next in a captured answer, and whether its attempt had a result.

    Attempts that are not made any more are passed over. The first step where the captured answer had no further
    attempt, as those of servers that did not list them. References that the network did not match then are not matched.
    """
    for captured in then.attempts[len(following.steps[0].payload.attempts) :]:
        steps = [it for it in following.steps if _named(it, tiers) == (captured.rung, captured.features)]
        if steps:
            without = {it.unmatched_reference_count for it in then.ladder_cuts if _is_of(it, captured)}
            last = next((it for it in steps[1:] if it.payload.cuts[-1].unmatched in without), steps[0])
            return last, captured.outcome not in ("unfinished", "failed", "out_of_memory")
    return following.steps[0], True


def _named(step: SearchStep, tiers: Sequence[Tier]) -> tuple[str, str]:
    return step.payload.rung, tiers[step.payload.attempt.features].features


def _is_of(cut: pb.LadderCut, attempt: pb.Attempt) -> bool:
    return (cut.rung, cut.features) == (attempt.rung, attempt.features) and cut.unmatched_reference_count > 0


def _is_cut_short(request: Any, then: Response) -> bool:
    """Whether the coarse pose was the answer because there was no time to refine it."""
    if not isinstance(then, pb.LocalizeResponse) or not request.options.allow_coarse:
        return False
    is_coarse = then.localization.pose_stage == pb.POSE_STAGE_COARSE
    return is_coarse and request.options.variant != pb.VARIANT_COARSE
