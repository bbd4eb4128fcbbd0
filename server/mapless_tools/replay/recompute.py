"""Computes the answer of a captured call again, by the services and the method, on the recorded inputs.

Computations run one after another without the queue and without deadlines. If time limited the captured answer, this
one is limited in the same way: features that were not completed are not tried, and a pose that was not refined is not
refined.
"""

import asyncio
import math
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, cast

from mapless.geometry import RigidTransform
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.interface import Engine, EngineOptions
from mapless_server.engine.joint import pose_rig, pose_sequence
from mapless_server.engine.query import COARSE, PREPARE, REFINE, UNFINISHED, Caller, Query, Result, Tier
from mapless_server.engine.references import QueryRun, QueryViews
from mapless_server.engine.stages import Method, QueryStages
from mapless_server.method.answer import Answer
from mapless_server.method.groups.rig import RigEstimate
from mapless_server.method.groups.sequence import SequenceEstimate
from mapless_server.method.localize import refine
from mapless_server.method.pipeline import Coarse, coarse_answer
from mapless_server.method.rejection import Rejection
from mapless_server.observability.metrics import Metrics
from mapless_server.rpc import Call
from mapless_server.scheduling import Done, Flow, Job
from mapless_server.security import Principal, SceneKey
from mapless_server.services.capture.calls import CapturedCall, CaptureError, Response, diagnostics_of
from mapless_server.services.localization import LocalizationService
from mapless_server.services.watching import Watchers
from mapless_server.store import SceneAttributes, Store

from .recorded import RETRIEVAL, Blobs, RecordedSource

MESSAGES: dict[str, tuple[Any, Any]] = {
    "Localize": (pb.LocalizeRequest, pb.LocalizeResponse),
    "LocalizeRig": (pb.LocalizeRigRequest, pb.LocalizeRigResponse),
    "LocalizeSequence": (pb.LocalizeSequenceRequest, pb.LocalizeSequenceResponse),
}
"""Of each method that is captured."""


def response_of(call: CapturedCall) -> Response:
    """The captured answer; CaptureError if it is of a method that this program does not know."""
    if call.method not in MESSAGES:
        raise CaptureError(f"this program knows no method {call.method}")
    return cast(Response, MESSAGES[call.method][1].FromString(call.response))


def recompute(call: CapturedCall, blobs: Blobs, tiers: Sequence[Tier], options: EngineOptions) -> Response:
    """Computes the answer to a captured call again, by present tiers, limits and defaults.

    CaptureError if a part of the capture is missing, or its method is not known; RequestError or FieldError if the call
    is refused now.
    """
    then = response_of(call)
    request = MESSAGES[call.method][0].FromString(call.request)
    engine = cast(Engine, _Recomputing(call, request, then, blobs, tiers, options))
    service = LocalizationService(lambda: engine, Metrics(), cast(Store, _Attributes(call)), Watchers(False))
    now = Call(call.request_id, time.monotonic(), math.inf, Principal(tenant=call.tenant))
    return cast(Response, asyncio.run(getattr(service, call.method)(request, now)))


class _Attributes:
    """The part of the store that services call."""

    def __init__(self, call: CapturedCall) -> None:
        self._attributes = call.attributes

    def get_attributes(self, scene_key: SceneKey) -> SceneAttributes:
        return self._attributes


class _Recomputing:
    """The part of the engine that services call; a photograph is identified by its field in the request."""

    parallel_queries = 1

    def __init__(
        self,
        call: CapturedCall,
        request: Any,
        then: Response,
        blobs: Blobs,
        tiers: Sequence[Tier],
        options: EngineOptions,
    ) -> None:
        self.options = options
        self._call = call
        self._blobs = blobs
        self._tiers = tiers
        self._parts = {part.field: part for part in call.parts}
        described = zip(self._parts, diagnostics_of(then), strict=True)
        stages = {field: [it.stage for it in about.stages] for field, about in described}
        self._unfinished = {field: _unfinished(names) for field, names in stages.items()}
        self._described = {field for field, names in stages.items() if RETRIEVAL in names}
        self._method = _unrefined() if _is_cut_short(request, then) else Method()

    def query_job(self, query: Query, caller: Caller, source: object = None, on_coarse: object = None) -> Job:
        field = query.photo.field
        extractor, part = self._tiers[0].extractor, self._parts[field]
        recorded = RecordedSource(self._call, part, self._blobs, extractor, field in self._described)
        views = QueryViews(query.photo, self.options.image_limits)
        return Job(Flow("", ""), QueryRun(query, recorded, views, math.inf).first_step, math.inf, 0)

    async def run(self, job: Job) -> Result:
        run: QueryRun = job.step.payload
        given_up = self._unfinished[run.query.photo.field]
        tried = [tier for tier in self._tiers if tier.extractor.name not in given_up]
        stages = QueryStages(tried or self._tiers, self.options.escalation, self._method)
        return await asyncio.to_thread(_compute, stages, job)

    @contextmanager
    def hold(self, queries: Sequence[Query], caller: Caller) -> Iterator[None]:
        yield

    async def pose_rig(
        self,
        queries: Sequence[Query],
        results: Sequence[Result],
        rig_from_camera: Sequence[RigidTransform],
        caller: Caller,
    ) -> RigEstimate | Rejection:
        return await asyncio.to_thread(pose_rig, queries, results, rig_from_camera)

    async def pose_sequence(
        self,
        queries: Sequence[Query],
        results: Sequence[Result],
        session_from_camera: Sequence[RigidTransform],
        estimate_scale: bool,
        caller: Caller,
    ) -> SequenceEstimate | Rejection:
        return await asyncio.to_thread(pose_sequence, queries, results, session_from_camera, estimate_scale)


def _compute(stages: QueryStages, job: Job) -> Result:
    """Runs a job through the stages, without a queue."""
    of_name = {PREPARE: stages.prepare, COARSE: stages.coarse, REFINE: stages.refine}
    while True:
        (result,) = of_name[job.step.stage]([job])
        if isinstance(result, Done):
            return cast(Result, result.value)
        if isinstance(result, Exception):
            raise result
        job.step = result.step


def _unfinished(stages: Sequence[str]) -> frozenset[str]:
    """Extractors that there was no time for."""
    return frozenset(it.removesuffix(UNFINISHED) for it in stages if it.endswith(UNFINISHED))


def _is_cut_short(request: Any, then: Response) -> bool:
    """Whether the coarse pose was the answer because there was no time to refine it."""
    if not isinstance(then, pb.LocalizeResponse) or not request.options.allow_coarse:
        return False
    is_coarse = then.localization.pose_stage == pb.POSE_STAGE_COARSE
    return is_coarse and request.options.variant != pb.VARIANT_COARSE


def _unrefined() -> Method:
    def answer(coarse: Coarse) -> Answer:
        return coarse_answer(coarse) or refine(coarse)

    return Method(refine=answer)
