"""LocalizationService: message to values, engine, values to message. No maths here."""
# ruff: noqa: N802  methods carry the names of their RPCs

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable
from functools import partial

from mapless import wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import localization_service_pb2_grpc as rpcs
from mapless_server.engine.interface import Engine
from mapless_server.engine.query import Query, Result
from mapless_server.method.answer import Localization
from mapless_server.observability.metrics import LOCALIZED, Metrics
from mapless_server.rpc.call import Call
from mapless_server.security.tenancy import key_of
from mapless_server.store import SceneAttributes, Store

from .capture.recorder import Recorder
from .groups import answer_rig, answer_sequence
from .messages.answers import AnswerFrames, answer_frames_of, diagnostics_to_message, outcome_to_message
from .messages.debug import debug_to_message
from .messages.priors import needs_attributes
from .messages.queries import query_from_message
from .progressive import coarse_then_final
from .watching import Watch, Watchers


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
        query, frames = await self._query(request, call)
        return await self._answer(request, query, frames, call)

    async def LocalizeProgressively(
        self, request: pb.LocalizeRequest, call: Call
    ) -> AsyncGenerator[pb.LocalizeProgressivelyResponse, None]:
        """Implements LocalizationService.LocalizeProgressively."""
        query, frames = await self._query(request, call)
        return coarse_then_final(partial(self._answer, request, query, frames, call))

    async def _query(self, request: pb.LocalizeRequest, call: Call) -> tuple[Query, AnswerFrames]:
        """The query of a request; FieldError or RequestError names what is wrong with it."""
        options = self._engine().options
        frames = answer_frames_of(request)
        attributes = await self._attributes(request, call.principal.tenant)
        query = query_from_message(request, call.principal.tenant, options, attributes)
        call.note(scene=query.scene_key, references=len(query.reference_ids))
        return query, frames

    async def _answer(
        self,
        request: pb.LocalizeRequest,
        query: Query,
        frames: AnswerFrames,
        call: Call,
        coarse: asyncio.Future[pb.LocalizeResponse] | None = None,
    ) -> pb.LocalizeResponse:
        """The final answer; before it, `coarse` gets the first answer that is known without refining."""
        engine = self._engine()

        def to_message(result: Result) -> pb.LocalizeResponse:
            response = outcome_to_message(result, query.options, frames)
            for echoed in ("capture_time", "session_from_camera"):
                if request.HasField(echoed):
                    getattr(response, echoed).CopyFrom(getattr(request, echoed))
            response.diagnostics.CopyFrom(diagnostics_to_message(result, query.options))
            response.diagnostics.request_id = call.request_id
            response.diagnostics.queue_duration.FromNanoseconds(round(1e9 * job.waited_s))
            response.diagnostics.total_duration.FromNanoseconds(round(1e9 * (time.monotonic() - call.arrived_s)))
            return response

        def give_coarse(result: Result) -> None:
            if coarse is not None and not coarse.done():
                seconds = time.monotonic() - call.arrived_s
                call.note(coarse_ms=round(1000 * seconds, 1))
                self._metrics.answered_coarsely(seconds)
                coarse.set_result(to_message(result))

        job = engine.query_job(query, call.caller, on_coarse=None if coarse is None else give_coarse)
        try:
            result = await engine.run(job)
        finally:
            call.record(job.records)
        response = to_message(result)
        self._count(result, response, call)
        debug, support = None, result.answer.support
        if support is not None and (request.options.include_debug or self._watchers.is_watched(query.scene_key)):
            debug = await asyncio.to_thread(debug_to_message, support)
        if request.options.include_debug and debug is not None:
            response.debug.CopyFrom(debug)
        if self._recorder is not None:
            self._recorder.answered("Localize", request, response, call, [(query, result)], engine.tiers)
        self._watchers.publish(query.scene_key, request, response, debug)
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
        """Reports how good the answer is to the log and the metrics."""
        answer = result.answer
        outcome = answer.outcome
        self._metrics.stages(result.stage_seconds)
        parts_ms = {stage: round(1000 * seconds, 1) for stage, seconds in result.stage_seconds.items()}
        call.note(parts_ms=parts_ms, used_references=len(result.references))
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
