"""LocalizationService: message to values, engine, values to message. No maths here."""
# ruff: noqa: N802  methods carry the names of their RPCs

from __future__ import annotations

import time
from enum import Enum
from typing import Any, TypeVar

from mapless import names, wire
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1 import localization_service_pb2_grpc as rpcs
from mapless.wire import FieldError

from . import __version__
from .decode import ImageLimits
from .engine import Engine, PositionPrior, Query, Result
from .method.accuracy import accuracy_from_covariance
from .method.localize import Localization, LocalizeOptions
from .method.rejection import Rejection
from .method.scale import MetricScale
from .photos import photo_from_message
from .rpc import Call

MAX_REFERENCES = 64
DEFAULT_REFERENCE_COUNT = 10

E = TypeVar("E", bound=Enum)


class LocalizationService(rpcs.LocalizationServiceServicer):
    """Says where a photograph was taken."""

    def __init__(self, engine: Engine) -> None:
        self._engine = engine

    async def Localize(self, request: pb.LocalizeRequest, call: Call) -> pb.LocalizeResponse:
        """Implements LocalizationService.Localize."""
        query = _query_from_message(request, self._engine.options.image_limits)
        result = await self._engine.localize(query, call.deadline_s)
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

    @staticmethod
    def _diagnostics(result: Result, options: LocalizeOptions, call: Call) -> pb.Diagnostics:
        attempt, answer = result.attempt, result.attempt.answer
        reconstructor = attempt.tier.pipeline.reconstructor
        message = pb.Diagnostics(
            request_id=call.request_id,
            backend=reconstructor.name,
            weights_sha256=reconstructor.weights_sha256,
            features=attempt.tier.extractor.name,
            variant=_enum_to_message(options.variant, pb.Variant),
            store_generation=attempt.generation,
            scale=_scale_to_message(answer.scale) if answer.scale else None,
            processed_width_px=attempt.processed.width_px,
            processed_height_px=attempt.processed.height_px,
            server_version=__version__,
        )
        # Counts are missing when the stage that counts was not reached.
        match_counts = answer.reference_match_counts or (0,) * len(attempt.references)
        inlier_counts = answer.reference_inlier_counts or (0,) * len(attempt.references)
        for reference, matches, inliers in zip(attempt.references, match_counts, inlier_counts, strict=True):
            message.references.add(name=reference.name, match_count=matches, inlier_count=inliers)
        for stage, seconds in result.stage_seconds.items():
            message.stages.add(stage=stage).duration.FromNanoseconds(round(1e9 * seconds))
        message.queue_duration.FromNanoseconds(round(1e9 * result.queue_s))
        message.total_duration.FromNanoseconds(round(1e9 * (time.monotonic() - call.arrived_s)))
        return message


def _query_from_message(request: pb.LocalizeRequest, limits: ImageLimits) -> Query:
    """Checks everything that can be checked without the store; FieldError or InvalidArgument names the field."""
    scene_id = wire.scene_id_from_name(request.scene, "scene")
    if request.HasField("session_from_camera"):
        wire.transform_from_message(request.session_from_camera, "session_from_camera")
    reference_count = request.options.reference_count
    if not 0 <= reference_count <= MAX_REFERENCES:
        raise FieldError("options.reference_count", f"must be 0 to {MAX_REFERENCES}, is {reference_count}")
    return Query(
        scene_id=scene_id,
        reference_ids=_reference_ids(request, scene_id),
        photo=photo_from_message(request, "", limits),
        prior=_prior_from_message(request.position_prior) if request.HasField("position_prior") else None,
        reference_count=reference_count or DEFAULT_REFERENCE_COUNT,
        options=_options_from_message(request.options),
    )


def _reference_ids(request: pb.LocalizeRequest, scene_id: str) -> tuple[str, ...]:
    if len(request.references) > MAX_REFERENCES:
        raise FieldError("references", f"must be at most {MAX_REFERENCES}, are {len(request.references)}")
    reference_ids: dict[str, None] = {}
    for i, name in enumerate(request.references):
        field = f"references[{i}]"
        its_scene_id, reference_id = wire.reference_ids_from_name(name, field)
        if its_scene_id != scene_id:
            raise FieldError(field, f"{names.shown(name)} is a reference of another scene than {scene_id!r}")
        if reference_id in reference_ids:
            raise FieldError(field, f"{names.shown(name)} stands twice")
        reference_ids[reference_id] = None
    return tuple(reference_ids)


def _prior_from_message(message: pb.PositionPrior) -> PositionPrior:
    if not message.HasField("position_m"):
        raise FieldError("position_prior.position_m", "is required")
    position = wire.vector_from_message(message.position_m, "position_prior.position_m")
    if not 0 < message.radius_m < float("inf"):
        raise FieldError("position_prior.radius_m", f"must be finite and above 0, is {message.radius_m:g}")
    return PositionPrior(position, message.radius_m)


def _options_from_message(message: pb.LocalizeOptions) -> LocalizeOptions:
    defaults = LocalizeOptions()
    return LocalizeOptions(
        variant=_enum_from_message(message.variant, pb.Variant, defaults.variant, "options.variant"),
        scale_strategy=_enum_from_message(
            message.scale_strategy, pb.ScaleStrategy, defaults.scale_strategy, "options.scale_strategy"
        ),
    )


def _localization_to_message(localization: Localization) -> pb.Localization:
    message = pb.Localization(
        world_from_camera=wire.transform_to_message(localization.world_from_camera),
        pose_stage=_enum_to_message(localization.pose_stage, pb.PoseStage),
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
    return pb.Rejection(reason=_enum_to_message(rejection.reason, pb.RejectionReason), message=rejection.message)


def _scale_to_message(scale: MetricScale) -> pb.ScaleEstimate:
    return pb.ScaleEstimate(
        metres_per_unit=scale.metres_per_unit,
        stage=_enum_to_message(scale.stage, pb.ScaleStage),
        deviation=scale.deviation,
    )


# An enum here and its twin on the wire have the same value names, but for the wire's prefix, "VARIANT_".


def _enum_to_message(value: Enum, enum: wire.ProtoEnum) -> Any:
    return enum.Value(wire.enum_prefix(enum) + value.name)


def _enum_from_message(number: int, enum: wire.ProtoEnum, default: E, field: str) -> E:
    if number == 0:
        return default
    if number not in enum.values():
        raise FieldError(field, f"{number} is no value of {enum.DESCRIPTOR.name}")
    return type(default)[enum.Name(number).removeprefix(wire.enum_prefix(enum))]
