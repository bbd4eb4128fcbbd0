"""LocalizationService: message to values, engine, values to message. No maths here."""
# ruff: noqa: N802  methods carry the names of their RPCs

from __future__ import annotations

import time
from collections.abc import Callable

from mapless import wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import localization_service_pb2_grpc as rpcs
from mapless.wire import FieldError

from . import __version__
from .decode import ImageLimits
from .engine import Engine
from .messages.enums import enum_from_message, enum_to_message
from .messages.naming import reference_ids_from_names
from .messages.photos import photo_from_message
from .messages.priors import narrowing_from_message
from .method.accuracy import accuracy_from_covariance
from .method.localize import Localization, LocalizeOptions
from .method.rejection import Rejection
from .method.scale import MetricScale
from .observability.metrics import LOCALIZED, Metrics
from .query import DEFAULT_REFERENCE_COUNT, Query, Result
from .rpc import Call
from .scheduling.jobs import Visit
from .tenancy import key_of

MAX_REFERENCES = 64
MAX_CANDIDATES = 1000
"""References that a request may name when the server is to choose among them."""


class LocalizationService(rpcs.LocalizationServiceServicer):
    """Says where a photograph was taken."""

    def __init__(self, engine: Callable[[], Engine], metrics: Metrics) -> None:
        """`engine` gives it, or raises Unavailable as long as there is none."""
        self._engine = engine
        self._metrics = metrics

    async def Localize(self, request: pb.LocalizeRequest, call: Call) -> pb.LocalizeResponse:
        """Implements LocalizationService.Localize."""
        engine = self._engine()
        query = _query_from_message(request, call.principal.tenant, engine.options.image_limits)
        call.note(scene=query.scene_key, references=len(query.reference_ids))
        visits: list[Visit] = []
        try:
            result, _ = await engine.localize(query, call.caller, visits=visits)
        finally:
            for visit in visits:
                call.waited(visit.stage, visit.queued_s, visit.start_s)
                if visit.jobs:
                    call.computed(visit.stage, visit.start_s, visit.end_s, batch=visit.batch, batch_size=visit.jobs)
        self._count(result, call)
        response = pb.LocalizeResponse()
        outcome = result.attempt.answer.outcome
        if isinstance(outcome, Localization):
            response.localization.CopyFrom(_localization_to_message(outcome))
        else:
            response.rejection.CopyFrom(_rejection_to_message(outcome))
        for echoed in ("capture_time", "session_from_camera"):
            if request.HasField(echoed):
                getattr(response, echoed).CopyFrom(getattr(request, echoed))
        response.diagnostics.CopyFrom(self._diagnostics(result, query.options, call))
        return response

    def _count(self, result: Result, call: Call) -> None:
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
        covariance = outcome.covariance
        measured = covariance is not None
        self._metrics.answered(
            LOCALIZED,
            inlier_count=outcome.inlier_count if measured else None,
            match_count=outcome.match_count if measured else None,
            reprojection_error_px=outcome.reprojection_error_px if measured else None,
            scale_deviation=answer.scale.deviation if answer.scale else None,
            accuracy_radius_m=None if covariance is None else accuracy_from_covariance(covariance).position_68_m,
        )

    @staticmethod
    def _diagnostics(result: Result, options: LocalizeOptions, call: Call) -> pb.Diagnostics:
        attempt, answer = result.attempt, result.attempt.answer
        reconstructor = attempt.tier.pipeline.reconstructor
        message = pb.Diagnostics(
            request_id=call.request_id,
            backend=reconstructor.name,
            weights_sha256=reconstructor.weights_sha256,
            features=attempt.tier.extractor.name,
            variant=enum_to_message(options.variant, pb.Variant),
            store_generation=attempt.generation,
            scale=_scale_to_message(answer.scale) if answer.scale else None,
            processed_width_px=attempt.processed.width_px,
            processed_height_px=attempt.processed.height_px,
            server_version=__version__,
            retrieval=attempt.choice.descriptor if attempt.choice else "",
        )
        # Counts are missing when the stage that counts was not reached.
        match_counts = answer.reference_match_counts or (0,) * len(attempt.references)
        inlier_counts = answer.reference_inlier_counts or (0,) * len(attempt.references)
        chosen = attempt.choice.references if attempt.choice else ()
        similarities = {it.key: it.similarity for it in chosen}
        for reference, matches, inliers in zip(attempt.references, match_counts, inlier_counts, strict=True):
            similarity = similarities.get(reference.key, 0.0)
            message.references.add(
                name=reference.name, match_count=matches, inlier_count=inliers, similarity=similarity
            )
        for stage, seconds in result.stage_seconds.items():
            message.stages.add(stage=stage).duration.FromNanoseconds(round(1e9 * seconds))
        message.queue_duration.FromNanoseconds(round(1e9 * (call.trail.queue_s or 0.0)))
        message.total_duration.FromNanoseconds(round(1e9 * (time.monotonic() - call.arrived_s)))
        return message


def _query_from_message(request: pb.LocalizeRequest, tenant: str, limits: ImageLimits) -> Query:
    """Checks everything that can be checked without the store; FieldError or InvalidArgument names the field."""
    scene_id = wire.scene_id_from_name(request.scene, "scene")
    if request.HasField("session_from_camera"):
        wire.transform_from_message(request.session_from_camera, "session_from_camera")
    reference_count = request.options.reference_count
    if not 0 <= reference_count <= MAX_REFERENCES:
        raise FieldError("options.reference_count", f"must be 0 to {MAX_REFERENCES}, is {reference_count}")
    most = MAX_CANDIDATES if request.options.rerank_references else MAX_REFERENCES
    return Query(
        scene_key=key_of(tenant, scene_id),
        reference_ids=reference_ids_from_names(request.references, scene_id, most),
        photo=photo_from_message(request, "", limits),
        narrowing=narrowing_from_message(request),
        reference_count=reference_count or DEFAULT_REFERENCE_COUNT,
        options=_options_from_message(request.options),
        allow_coarse=request.options.allow_coarse,
        rerank=request.options.rerank_references and bool(request.references),
    )


def _options_from_message(message: pb.LocalizeOptions) -> LocalizeOptions:
    defaults = LocalizeOptions()
    return LocalizeOptions(
        variant=enum_from_message(message.variant, pb.Variant, defaults.variant, "options.variant"),
        scale_strategy=enum_from_message(
            message.scale_strategy, pb.ScaleStrategy, defaults.scale_strategy, "options.scale_strategy"
        ),
    )


def _localization_to_message(localization: Localization) -> pb.Localization:
    message = pb.Localization(
        world_from_camera=wire.transform_to_message(localization.world_from_camera),
        pose_stage=enum_to_message(localization.pose_stage, pb.PoseStage),
        inlier_count=localization.inlier_count,
        match_count=localization.match_count,
        reprojection_error_px=localization.reprojection_error_px,
    )
    if localization.covariance is not None:
        message.covariance.row_major.extend(localization.covariance.ravel().tolist())
        radii = accuracy_from_covariance(localization.covariance)
        message.accuracy.CopyFrom(
            pb.Accuracy(
                position_68_m=radii.position_68_m,
                position_95_m=radii.position_95_m,
                rotation_68_deg=radii.rotation_68_deg,
                rotation_95_deg=radii.rotation_95_deg,
                calibrated=False,
            )
        )
    return message


def _rejection_to_message(rejection: Rejection) -> pb.Rejection:
    return pb.Rejection(reason=enum_to_message(rejection.reason, pb.RejectionReason), message=rejection.message)


def _scale_to_message(scale: MetricScale) -> pb.ScaleEstimate:
    return pb.ScaleEstimate(
        metres_per_unit=scale.metres_per_unit,
        stage=enum_to_message(scale.stage, pb.ScaleStage),
        deviation=scale.deviation,
    )
