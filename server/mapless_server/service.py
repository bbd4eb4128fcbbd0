"""LocalizationService: message to values, engine, values to message. No maths here."""
# ruff: noqa: N802  methods carry the names of their RPCs

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from mapless import wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import localization_service_pb2_grpc as rpcs

from .engine import Engine
from .group_service import answer_rig, answer_sequence
from .messages.answers import addressee_of, diagnostics_to_message, outcome_to_message
from .messages.debug import debug_to_message
from .messages.priors import needs_attributes
from .messages.queries import query_from_message
from .method.localize import Localization
from .observability.metrics import LOCALIZED, Metrics
from .query import Result
from .rpc import Call
from .scheduling.jobs import Visit
from .store import SceneAttributes, Store
from .tenancy import key_of
from .watching import Watch, Watchers


class LocalizationService(rpcs.LocalizationServiceServicer):
    """Says where a photograph was taken."""

    def __init__(self, engine: Callable[[], Engine], metrics: Metrics, store: Store, watchers: Watchers) -> None:
        """`engine` gives it, or raises Unavailable as long as there is none."""
        self._engine = engine
        self._metrics = metrics
        self._store = store
        self._watchers = watchers

    async def Localize(self, request: pb.LocalizeRequest, call: Call) -> pb.LocalizeResponse:
        """Implements LocalizationService.Localize."""
        engine = self._engine()
        addressee = addressee_of(request)
        attributes = await self._attributes(request, call.principal.tenant)
        query = query_from_message(request, call.principal.tenant, engine.options, attributes)
        call.note(scene=query.scene_key, references=len(query.reference_ids))
        visits: list[Visit] = []
        try:
            result, _ = await engine.localize(query, call.caller, visits=visits)
        finally:
            for visit in visits:
                call.waited(visit.stage, visit.queued_s, visit.start_s)
                if visit.jobs:
                    call.computed(visit.stage, visit.start_s, visit.end_s, batch=visit.batch, batch_size=visit.jobs)
        response = outcome_to_message(result, query.options, addressee)
        self._count(result, response, call)
        for echoed in ("capture_time", "session_from_camera"):
            if request.HasField(echoed):
                getattr(response, echoed).CopyFrom(getattr(request, echoed))
        response.diagnostics.CopyFrom(diagnostics_to_message(result, query.options))
        response.diagnostics.request_id = call.request_id
        response.diagnostics.queue_duration.FromNanoseconds(round(1e9 * (call.trail.queue_s or 0.0)))
        response.diagnostics.total_duration.FromNanoseconds(round(1e9 * (time.monotonic() - call.arrived_s)))
        debug, support = None, result.attempt.answer.support
        if support is not None and (request.options.include_debug or self._watchers.is_watched(query.scene_key)):
            debug = await asyncio.to_thread(debug_to_message, support)
        self._watchers.publish(query.scene_key, request, response, debug)
        if request.options.include_debug and debug is not None:
            response.debug.CopyFrom(debug)
        return response

    async def LocalizeRig(self, request: pb.LocalizeRigRequest, call: Call) -> pb.LocalizeRigResponse:
        """Implements LocalizationService.LocalizeRig."""
        return await answer_rig(request, call, self._engine(), self._metrics)

    async def LocalizeSequence(self, request: pb.LocalizeSequenceRequest, call: Call) -> pb.LocalizeSequenceResponse:
        """Implements LocalizationService.LocalizeSequence."""
        return await answer_sequence(request, call, self._engine(), self._metrics)

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
