"""LocalizationService: message to values, engine, values to message. No maths here."""
# ruff: noqa: N802  methods carry the names of their RPCs

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable
from dataclasses import dataclass, field
from functools import partial

from mapless import wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import localization_service_pb2_grpc as rpcs
from mapless_server.engine.engine import Engine
from mapless_server.engine.query import Query, Result
from mapless_server.method.localize import Localization
from mapless_server.observability.metrics import LOCALIZED, Metrics
from mapless_server.rpc.call import Call
from mapless_server.scheduling import StageRecord
from mapless_server.security.tenancy import key_of
from mapless_server.store import SceneAttributes, Store

from .capture.recorder import Recorder
from .groups import answer_rig, answer_sequence
from .messages.answers import Addressee, addressee_of, diagnostics_to_message, outcome_to_message
from .messages.debug import debug_to_message
from .messages.priors import needs_attributes
from .messages.queries import query_from_message
from .progressive import TellCoarse, coarse_then_final
from .watching import Watch, Watchers


@dataclass(frozen=True, eq=False)
class _Asked:
    """A request of Localize, understood.

    Attributes:
        request: as it came.
        query: what it asks.
        addressee: whom the answer is made for.
        visits: the stages of the queue that the query has been through; grows.
    """

    request: pb.LocalizeRequest
    query: Query
    addressee: Addressee
    visits: list[StageRecord] = field(default_factory=list)

    @property
    def queued_s(self) -> float:
        """How long it has waited, as far as that is over."""
        return sum(visit.start_s - visit.queued_s for visit in self.visits)


class LocalizationService(rpcs.LocalizationServiceServicer):
    """Says where a photograph was taken."""

    def __init__(
        self,
        engine: Callable[[], Engine],
        metrics: Metrics,
        store: Store,
        watchers: Watchers,
        recorder: Recorder | None = None,
    ) -> None:
        """`engine` gives it, or raises Unavailable as long as there is none; a recorder captures the calls."""
        self._engine = engine
        self._metrics = metrics
        self._store = store
        self._watchers = watchers
        self._recorder = recorder

    async def Localize(self, request: pb.LocalizeRequest, call: Call) -> pb.LocalizeResponse:
        """Implements LocalizationService.Localize."""
        return await self._answer(await self._understand(request, call), call)

    async def LocalizeProgressively(
        self, request: pb.LocalizeRequest, call: Call
    ) -> AsyncGenerator[pb.LocalizeProgressivelyResponse, None]:
        """Implements LocalizationService.LocalizeProgressively."""
        asked = await self._understand(request, call)

        async def answer(tell_coarse: TellCoarse) -> pb.LocalizeResponse:
            return await self._answer(asked, call, tell_coarse)

        return coarse_then_final(answer, partial(self._coarse, asked, call))

    async def _understand(self, request: pb.LocalizeRequest, call: Call) -> _Asked:
        """What a request asks; what is wrong with it is a FieldError or a RequestError."""
        engine = self._engine()
        addressee = addressee_of(request)
        attributes = await self._attributes(request, call.principal.tenant)
        query = query_from_message(request, call.principal.tenant, engine.options, attributes)
        call.note(scene=query.scene_key, references=len(query.reference_ids))
        return _Asked(request, query, addressee)

    async def _answer(self, asked: _Asked, call: Call, tell_coarse: TellCoarse | None = None) -> pb.LocalizeResponse:
        """The final answer; before it, what is known without refining is told to whom it may concern."""
        request, query, visits = asked.request, asked.query, asked.visits
        try:
            result, _ = await self._engine().localize(query, call.caller, visits=visits, tell_coarse=tell_coarse)
        finally:
            for visit in visits:
                call.waited(visit.stage, visit.queued_s, visit.start_s)
                if visit.jobs:
                    call.computed(visit.stage, visit.start_s, visit.end_s, batch=visit.batch, batch_size=visit.jobs)
        response = _to_message(result, asked, call)
        self._count(result, response, call)
        debug, support = None, result.attempt.answer.support
        if support is not None and (request.options.include_debug or self._watchers.is_watched(query.scene_key)):
            debug = await asyncio.to_thread(debug_to_message, support)
        if request.options.include_debug and debug is not None:
            response.debug.CopyFrom(debug)
        if self._recorder is not None:
            self._recorder.answered("Localize", request, response, call, [(query, result)], self._engine().tiers)
        self._watchers.publish(query.scene_key, request, response, debug)
        return response

    def _coarse(self, asked: _Asked, call: Call, result: Result) -> pb.LocalizeResponse:
        """The coarse answer; log and metrics are told when it was there."""
        response, seconds = _to_message(result, asked, call), time.monotonic() - call.arrived_s
        call.note(coarse_ms=round(1000 * seconds, 1))
        self._metrics.answered_coarsely(seconds)
        return response

    async def LocalizeRig(self, request: pb.LocalizeRigRequest, call: Call) -> pb.LocalizeRigResponse:
        """Implements LocalizationService.LocalizeRig."""
        return await answer_rig(request, call, self._engine(), self._metrics, self._recorder)

    async def LocalizeSequence(self, request: pb.LocalizeSequenceRequest, call: Call) -> pb.LocalizeSequenceResponse:
        """Implements LocalizationService.LocalizeSequence."""
        return await answer_sequence(request, call, self._engine(), self._metrics, self._recorder)

    async def WatchQueries(self, request: pb.WatchQueriesRequest, call: Call) -> Watch:
        """Implements LocalizationService.WatchQueries."""
        scene_key = key_of(call.principal.tenant, wire.scene_id_from_name(request.scene, "scene"))
        call.note(scene=scene_key)
        self._watchers.check(call.principal.tenant)
        await asyncio.to_thread(self._store.get_scene, scene_key)
        return self._watchers.watch(scene_key)

    async def _attributes(self, request: pb.LocalizeRequest, tenant: str) -> SceneAttributes:
        """What is known of the request's scene, if what it says of the camera cannot be understood without."""
        if not needs_attributes(request):
            return SceneAttributes()
        scene_key = key_of(tenant, wire.scene_id_from_name(request.scene, "scene"))
        return await asyncio.to_thread(self._store.get_attributes, scene_key)

    def _count(self, result: Result, response: pb.LocalizeResponse, call: Call) -> None:
        """Tells the log and the metrics how good the answer is."""
        answer = result.attempt.answer
        outcome = answer.outcome
        self._metrics.stages(result.stage_seconds)
        parts_ms = {stage: round(1000 * seconds, 1) for stage, seconds in result.stage_seconds.items()}
        call.note(parts_ms=parts_ms, used_references=len(result.attempt.references))
        if not isinstance(outcome, Localization):
            self._metrics.answered(outcome.reason.value)
            call.note(outcome=outcome.reason.value)
            return
        call.note(outcome="localized", pose_stage=outcome.pose_stage.value, inliers=outcome.inlier_count)
        measured = response.localization.HasField("accuracy")
        self._metrics.answered(
            LOCALIZED,
            inlier_count=outcome.inlier_count if measured else None,
            match_count=outcome.match_count if measured else None,
            reprojection_error_px=outcome.reprojection_error_px if measured else None,
            scale_deviation=answer.scale.deviation if answer.scale else None,
            accuracy_radius_m=response.localization.accuracy.position_68_m if measured else None,
        )


def _to_message(result: Result, asked: _Asked, call: Call) -> pb.LocalizeResponse:
    """Message of an answer, as of now, without the matches it rests on."""
    response = outcome_to_message(result, asked.query.options, asked.addressee)
    for echoed in ("capture_time", "session_from_camera"):
        if asked.request.HasField(echoed):
            getattr(response, echoed).CopyFrom(getattr(asked.request, echoed))
    response.diagnostics.CopyFrom(diagnostics_to_message(result, asked.query.options))
    response.diagnostics.request_id = call.request_id
    response.diagnostics.queue_duration.FromNanoseconds(round(1e9 * asked.queued_s))
    response.diagnostics.total_duration.FromNanoseconds(round(1e9 * (time.monotonic() - call.arrived_s)))
    return response
