"""LocalizationService: a request becomes queries, the engine answers them, and the results become a response."""
# ruff: noqa: N802  methods carry the names of their RPCs

from __future__ import annotations

import asyncio
import time
from collections.abc import AsyncGenerator, Callable, Sequence
from contextlib import suppress
from functools import partial
from typing import TYPE_CHECKING, Any

from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import localization_service_pb2_grpc as rpcs
from mapless_server.engine.groups import MAX_FRAMES, MAX_RIG_IMAGES, MIN_FRAMES, GroupResult
from mapless_server.engine.query import TRACK, Query, Result
from mapless_server.errors import RequestError
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.rejection import Rejection
from mapless_server.method.structure.model import MetricScale
from mapless_server.observability.metrics import LOCALIZED, Metrics
from mapless_server.rpc import Call
from mapless_server.scheduling import StageRecord
from mapless_server.security import NOWHERE, Principal, SceneKey, tenant_of
from mapless_server.store import SceneAttributes, Store

from .capture.calls import Request, Response
from .capture.recorder import Recorder
from .finding import SceneFinder
from .messages.answers import AnswerFrames, answer_frames_of, diagnostics_to_message, outcome_to_message
from .messages.debug import debug_to_message
from .messages.groups import (
    poses_from_message,
    queries_among,
    queries_from_message,
    rig_to_message,
    sequence_to_message,
    session_from_rig_from_message,
    session_poses_from_message,
    with_tracked_motion,
)
from .messages.priors import needs_attributes
from .messages.queries import among, query_among, query_from_message
from .messages.scenes import AskedScenes, allowed_from_message, names_several, questions_from_message
from .photographs import Joint, localize_group
from .progressive import GiveBetter, better_then_final
from .reach import Reach
from .rejected import Asked, may_be_beyond, name_outdated_place, searched_beyond
from .watching import Watcher, Watchers

if TYPE_CHECKING:  # services do not load what computes
    from mapless_server.engine.queue_engine import QueueEngine

Offer = Callable[[pb.LocalizeOptions, Query, Result, Principal], pb.AdoptionOffer]
"""Receives an answered photograph, which may become a reference, and its caller; returns at once what becomes of it."""

Localized = pb.Localization | pb.RigLocalization | pb.SequenceLocalization

Count = Callable[[Sequence[tuple[Query, Result]], object, Localized], None]
"""Receives answered photographs, the outcome of their call and the message of its pose, to be counted; at once."""


class LocalizationService(rpcs.LocalizationServiceServicer):
    """Localizes photographs: single ones, rigs and sequences."""

    def __init__(
        self,
        engine: Callable[[], QueueEngine],
        metrics: Metrics,
        store: Store,
        watchers: Watchers,
        recorder: Recorder | None = None,
    ) -> None:
        """Makes the service; computes nothing yet.

        `engine` returns the engine, and raises Unavailable while the server starts. Watchers receive each answer to a
        single photograph; the recorder captures answered calls, None to capture none.
        """
        self._engine = engine
        self._metrics = metrics
        self._store = store
        self._reach = Reach(store)
        self._scenes = SceneFinder(store, self._reach)
        self._watchers = watchers
        self._recorder = recorder
        self.offer: Offer | None = None
        """Receives each answer whose call allows adoption; None before the server serves."""
        self.count: Count | None = None
        """Receives the photographs of each answer that is not confidential; None where they are not counted."""
        self.names_outdated = True
        """Whether rejections name the place that needs a new survey; the store is read for it."""

    async def Localize(self, request: pb.LocalizeRequest, call: Call) -> pb.LocalizeResponse:
        """Implements LocalizationService.Localize."""
        asked, frames = await self._asked(request, call)
        return await self._answer(request, asked, frames, call)

    async def LocalizeProgressively(
        self, request: pb.LocalizeRequest, call: Call
    ) -> AsyncGenerator[pb.LocalizeProgressivelyResponse, None]:
        """Implements LocalizationService.LocalizeProgressively."""
        asked, frames = await self._asked(request, call)
        return better_then_final(partial(self._answer, request, asked, frames, call))

    async def _asked(self, request: pb.LocalizeRequest, call: Call) -> tuple[Asked, AnswerFrames]:
        """Converts a request to a query; FieldError or RequestError names the wrong field."""
        options, frames = self._engine().options, answer_frames_of(request)
        if names_several(request):
            asked = await asyncio.to_thread(self._questions, request, call.principal)
            call.note(scenes=len(asked.questions))
            query, beyond = query_among(request, options, asked.questions, asked.prior_scene), asked.beyond
            return Asked(query, None if beyond is None else lambda: among(query, beyond())), frames
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        attributes = await self._attributes([request], scene_key)
        query = query_from_message(request, tenant_of(scene_key), options, attributes)
        call.note(scene=query.scene_key, references=len(query.reference_ids))
        return Asked(query), frames

    def _questions(self, request: pb.LocalizeRequest, principal: Principal) -> AskedScenes:
        """Finds the scenes of a request with several; FieldError or NotFound names the wrong field."""
        extents = self._engine().references.extents_m
        return questions_from_message(request, self._scenes.find(request, principal), principal.tenant, extents)

    async def _answer(
        self,
        request: pb.LocalizeRequest,
        asked: Asked,
        frames: AnswerFrames,
        call: Call,
        give: GiveBetter | None = None,
    ) -> pb.LocalizeResponse:
        """Computes the final answer; before, gives what there is so far."""
        engine, query, given_count = self._engine(), asked.query, 0
        # What the functions below use, not the jobs: these hold the photograph, and the functions.
        recorded: list[list[StageRecord]] = []
        views = None if asked.beyond is None else engine.views_of(query)

        def give_better(result: Result) -> None:
            nonlocal given_count
            if give is None:
                return
            if not given_count:
                seconds = time.monotonic() - call.arrived_s
                call.note(first_ms=round(1000 * seconds, 1))
                self._metrics.answered_early(seconds)
            given_count += 1
            give(response_of(request, query, result, frames, call, recorded))

        async def run(query: Query) -> Result:
            job = engine.query_job(query, call.caller, views=views, on_better=None if give is None else give_better)
            recorded.append(job.records)
            return await engine.run(job)

        try:
            result = await run(query)
            if asked.beyond is not None and may_be_beyond(result):
                query, result = await searched_beyond(query, result, asked.beyond, run)
        finally:
            give = views = None  # a thread that has not noticed the end may still have a better one
            for records in recorded:
                call.record(records)
        response = response_of(request, query, result, frames, call, recorded)
        await self._finish(request, response, query, result, call)
        return response

    async def _finish(
        self, request: pb.LocalizeRequest, response: pb.LocalizeResponse, query: Query, result: Result, call: Call
    ) -> None:
        """Completes a final answer, reports it, and gives it to those who keep or watch answers."""
        answer = result.answer
        self._count_attempts([result])
        parts_ms = {stage: round(1000 * seconds, 1) for stage, seconds in result.stage_seconds.items()}
        call.note(parts_ms=parts_ms, used_references=len(result.references))
        if query.scenes:
            call.note(scene=result.scene_key, searched_scenes=result.searched_scene_count)
        if isinstance(answer.outcome, Localization):
            call.note(pose_stage=answer.outcome.pose_stage.value)
        await self._name_outdated(answer.outcome, response.rejection, [result])
        self._report(answer.outcome, response.localization, [result], call, answer.scale)
        is_watched = result.scene_key in self._watchers.by_scene
        debug = await self._debug_of(answer, request.options.include_debug or is_watched)
        if request.options.include_debug and debug is not None:
            response.debug.CopyFrom(debug)
        if self.offer is not None and request.options.allow_adoption:
            response.diagnostics.adoption = self.offer(request.options, query, result, call.principal)
        prior_attributes = await self._prior_attributes(request, response.scene, call)
        self._capture(request, response, call, [(query, result)], prior_attributes)
        if not request.options.confidential:
            self._watchers.publish(result.scene_key, request, response, debug)
        self._count_photographs(request, [(query, result)], answer.outcome, response.localization)

    async def _name_outdated(self, outcome: object, rejection: pb.Rejection, results: Sequence[Result]) -> None:
        """Sets in the message of a rejection which place needs a new survey; does nothing for other outcomes."""
        if isinstance(outcome, Rejection) and self.names_outdated:
            await asyncio.to_thread(name_outdated_place, self._store, rejection, results)

    async def _debug_of(self, answer: Answer, is_wanted: bool) -> pb.Debug | None:
        """The evidence behind the pose, if the caller or a watcher of its scene wants it, and there is any."""
        if answer.support is None or not is_wanted:
            return None
        return await asyncio.to_thread(debug_to_message, answer.support, answer.scale)

    async def LocalizeRig(self, request: pb.LocalizeRigRequest, call: Call) -> pb.LocalizeRigResponse:
        """Implements LocalizationService.LocalizeRig."""
        from mapless_server.engine.joint import pose_rig  # services do not load what computes

        queries = await self._queries(request, "images", (1, MAX_RIG_IMAGES), call)
        rig_from_camera = poses_from_message(request.images, "images", "rig_from_camera")
        session_from_rig = session_from_rig_from_message(request)
        pose = partial(pose_rig, rig_from_camera=rig_from_camera)
        group, outcome = await self._localize_group(queries, call, "images", pose)
        response = rig_to_message(outcome, group, queries, request, session_from_rig)
        await self._name_outdated(outcome, response.rejection, group.results)
        self._finish_group(request, response, outcome, queries, group.results, call)
        return response

    async def LocalizeSequence(self, request: pb.LocalizeSequenceRequest, call: Call) -> pb.LocalizeSequenceResponse:
        """Implements LocalizationService.LocalizeSequence."""
        from mapless_server.engine.joint import pose_sequence  # services do not load what computes

        queries = await self._queries(request, "frames", (MIN_FRAMES, MAX_FRAMES), call)
        axes, session_from_camera = session_poses_from_message(request)
        scale_is_free = request.estimate_session_scale
        queries = with_tracked_motion(queries, request, session_from_camera)
        pose = partial(pose_sequence, session_from_camera=session_from_camera, estimate_scale=scale_is_free)
        group, outcome = await self._localize_group(queries, call, "frames", pose)
        response = sequence_to_message(outcome, group, queries, request, axes)
        await self._name_outdated(outcome, response.rejection, group.results)
        self._finish_group(request, response, outcome, queries, group.results, call)
        return response

    async def WatchQueries(self, request: pb.WatchQueriesRequest, call: Call) -> Watcher:
        """Implements LocalizationService.WatchQueries."""
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        call.note(scene=scene_key)
        self._watchers.check(call.principal.tenant)
        await asyncio.to_thread(self._store.get_scene, scene_key)
        is_limited = call.principal.limit is not None
        return self._watchers.watch(scene_key, partial(self._check_reach, request, call) if is_limited else None)

    async def _check_reach(self, request: pb.WatchQueriesRequest, call: Call) -> None:
        """Raises NotFound if the scene is out of the call's reach by now."""
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        if tenant_of(scene_key) == NOWHERE:
            await asyncio.to_thread(self._store.get_scene, scene_key)

    async def _queries(
        self,
        request: pb.LocalizeRigRequest | pb.LocalizeSequenceRequest,
        list_name: str,
        bounds: tuple[int, int],
        call: Call,
    ) -> tuple[Query, ...]:
        """Converts the photographs of a request to queries; FieldError or RequestError names the wrong field."""
        if names_several(request):
            return await asyncio.to_thread(self._queries_among, request, list_name, bounds, call)
        scene_key = await self._reach.scene_key(call, request.scene, "scene")
        tenant, attributes = tenant_of(scene_key), await self._attributes(getattr(request, list_name), scene_key)
        return queries_from_message(request, list_name, bounds, tenant, self._engine().options, attributes)

    def _queries_among(
        self,
        request: pb.LocalizeRigRequest | pb.LocalizeSequenceRequest,
        list_name: str,
        bounds: tuple[int, int],
        call: Call,
    ) -> tuple[Query, ...]:
        engine, tenant, found = self._engine(), call.principal.tenant, self._scenes.find(request, call.principal)
        questions = partial(allowed_from_message, found=found, tenant=tenant, extents=engine.references.extents_m)
        call.note(scenes=len(found.scenes))
        return queries_among(request, list_name, bounds, engine.options, questions)

    async def _attributes(self, photos: Sequence[Any], scene_key: SceneKey) -> SceneAttributes:
        """Attributes of the scene, if the priors of one of the photographs' messages need them."""
        if not any(map(needs_attributes, photos)):
            return SceneAttributes()
        return await asyncio.to_thread(self._store.get_attributes, scene_key)

    async def _localize_group(
        self,
        queries: Sequence[Query],
        call: Call,
        list_name: str,
        pose: Callable[[Sequence[Query], Sequence[Result]], Joint | Rejection],
    ) -> tuple[GroupResult, Joint | Rejection]:
        """`localize_group` within the engine's queue, with memory for all of the photographs."""
        engine = self._engine()

        async def posed(asked: Sequence[Query], results: Sequence[Result]) -> Joint | Rejection:
            self._count_attempts(results)  # also of a round that is not answered
            return await engine.join(partial(pose, asked, results), call.caller)

        with engine.hold(queries, call.caller):
            return await localize_group(engine, queries, call, list_name, posed)

    def _finish_group(
        self,
        request: pb.LocalizeRigRequest | pb.LocalizeSequenceRequest,
        response: pb.LocalizeRigResponse | pb.LocalizeSequenceResponse,
        outcome: object,
        queries: Sequence[Query],
        results: Sequence[Result],
        call: Call,
    ) -> None:
        for report in response.images:
            report.diagnostics.request_id = call.request_id
        is_posed, not_posed = not isinstance(outcome, Rejection), pb.ADOPTION_OFFER_NOT_LOCALIZED
        if self.offer is not None and request.options.allow_adoption:
            for report, query, result in zip(response.images, queries, results, strict=True):
                offered = self.offer(request.options, query, result, call.principal) if is_posed else not_posed
                report.diagnostics.adoption = offered
        call.note(localized_alone=sum(not report.HasField("alone") for report in response.images))
        self._report(outcome, response.localization, results, call)
        parts = list(zip(queries, results, strict=True))
        self._capture(request, response, call, parts)
        self._count_photographs(request, parts, outcome, response.localization)

    def _count_photographs(
        self, request: Request, parts: Sequence[tuple[Query, Result]], outcome: object, localization: Localized
    ) -> None:
        if self.count is not None and not request.options.confidential:
            self.count(parts, outcome, localization)

    def _report(
        self,
        outcome: object,
        localization: Any,
        results: Sequence[Result],
        call: Call,
        scale: MetricScale | None = None,
    ) -> None:
        """Reports an answer, a rejection or the message of any localization, to the queue, the log and the metrics."""
        self._engine().answered(call.caller, not isinstance(outcome, Rejection))
        for result in results:
            self._metrics.stages(result.stage_seconds)
            if result.searched_scene_count > 1:
                self._metrics.searched(result.searched_scene_count)
            if TRACK in result.stage_seconds:
                self._metrics.tracked(result.is_tracked)
        if isinstance(outcome, Rejection):
            self._metrics.answered(outcome.reason.value)
            call.note(outcome=outcome.reason.value)
            return
        call.note(outcome=LOCALIZED, inliers=localization.inlier_count)
        is_measured = localization.HasField("accuracy")
        self._metrics.answered(
            LOCALIZED,
            inlier_count=localization.inlier_count if is_measured else None,
            match_count=localization.match_count if is_measured else None,
            reprojection_error_px=localization.reprojection_error_px if is_measured else None,
            scale_deviation=scale.deviation if scale else None,
            accuracy_radius_m=localization.accuracy.position_68_m if is_measured else None,
        )

    def _count_attempts(self, results: Sequence[Result]) -> None:
        for attempt in (attempt for result in results for attempt in result.attempts):
            self._metrics.attempted(attempt.rung, attempt.outcome)

    async def _prior_attributes(self, request: pb.LocalizeRequest, scene: str, call: Call) -> SceneAttributes | None:
        """Attributes of the scene in whose world the priors of a captured request are, if it is not the answer's."""
        if self._recorder is None or request.prior_scene in ("", scene):
            return None
        scene_key = await self._reach.scene_key(call, request.prior_scene, "prior_scene")
        with suppress(RequestError):  # it was deleted meanwhile
            return await asyncio.to_thread(self._store.get_attributes, scene_key)
        return None

    def _capture(
        self,
        request: Request,
        response: Response,
        call: Call,
        parts: Sequence[tuple[Query, Result]],
        prior_attributes: SceneAttributes | None = None,
    ) -> None:
        if self._recorder is not None and not request.options.confidential:
            self._recorder.record(request, response, call, parts, self._engine().tiers, prior_attributes)


def response_of(
    request: pb.LocalizeRequest,
    query: Query,
    result: Result,
    frames: AnswerFrames,
    call: Call,
    recorded: Sequence[Sequence[StageRecord]],
) -> pb.LocalizeResponse:
    """The message of an answer, with the times until now; `recorded` are the records of the call's jobs."""
    response = outcome_to_message(result, query.options, frames, query.photo)
    for echoed in ("capture_time", "session_from_camera"):
        if request.HasField(echoed):
            getattr(response, echoed).CopyFrom(getattr(request, echoed))
    diagnostics, records = response.diagnostics, [it for its in recorded for it in its]
    diagnostics.CopyFrom(diagnostics_to_message(result, query))
    diagnostics.request_id = call.request_id
    diagnostics.queue_duration.FromNanoseconds(round(1e9 * sum(it.waited_s for it in records)))
    diagnostics.total_duration.FromNanoseconds(round(1e9 * (time.monotonic() - call.arrived_s)))
    diagnostics.processor_duration.FromNanoseconds(round(1e9 * sum(it.processor_s for it in records)))
    return response
