"""Answers from their messages; the parts are shared by single photographs, rigs and sequences."""

from collections.abc import Iterable
from typing import Any

import numpy as np

from . import wire
from .answers import (
    Accuracy,
    Debug,
    Diagnostics,
    FramedPose,
    Hint,
    Hypothesis,
    IntrinsicsCheck,
    LocalizationResult,
    PriorCheck,
    ReferenceUse,
    Rejected,
    ScaleEstimate,
)
from .geodesy import GeoPose
from .geometry import Array, Quaternion, RigidTransform
from .v1 import localization_service_pb2 as pb
from .wire import optional


def answer_from_message(message: pb.LocalizeResponse) -> LocalizationResult | Rejected:
    """Converts the answer of a call from its message."""
    common: dict[str, Any] = {
        "diagnostics": diagnostics_from_message(message.diagnostics),
        "capture_time": optional(message, "capture_time", wire.time_from_message),
        "session_from_camera": _optional_transform(message, "session_from_camera"),
        "debug": optional(message, "debug", _debug_from_message),
    }
    if message.WhichOneof("outcome") == "rejection":
        common["intrinsics_checks"] = _intrinsics_checks_from(message.rejection)
        return wire.filled(Rejected, message.rejection, **rejection_fields(message.rejection), **common)
    found = message.localization
    return wire.filled(
        LocalizationResult,
        found,
        world_from_camera=wire.transform_from_message(found.world_from_camera, "localization.world_from_camera"),
        covariance=covariance_from_message(found),
        accuracy=optional(found, "accuracy", accuracy_from_message),
        pose_stage=wire.value_name(pb.PoseStage, found.pose_stage),
        trust=found.trust if found.HasField("trust") else None,
        scale_source=wire.value_name(pb.ScaleSource, found.scale_source or pb.SCALE_SOURCE_REFERENCES),
        in_axes=optional(found, "in_axes", _framed_from_message),
        geo_pose=optional(found, "geo_pose", geo_pose_from_message),
        prior_checks=prior_checks_from_messages(found.prior_checks),
        intrinsics_checks=_intrinsics_checks_from(found),
        **common,
    )


def rejection_fields(message: pb.Rejection) -> dict[str, Any]:
    """Returns the fields of a rejection that `Rejected` and `GroupRejected` share."""
    return {
        "reason": wire.value_name(pb.RejectionReason, message.reason),
        "hint": optional(message, "hint", _hint_from_message),
        "hypotheses": tuple(map(_hypothesis_from_message, message.hypotheses)),
    }


def _intrinsics_checks_from(message: pb.Localization | pb.Rejection) -> tuple[IntrinsicsCheck, ...]:
    return tuple(
        wire.filled(IntrinsicsCheck, it, parameter=wire.value_name(pb.IntrinsicsParameter, it.parameter))
        for it in message.intrinsics_checks
    )


def covariance_from_message(message: Any) -> Array | None:
    """Covariance (6, 6) of a message; None if the message has none."""
    return np.array(message.covariance.row_major).reshape(6, 6) if message.HasField("covariance") else None


def accuracy_from_message(message: pb.Accuracy) -> Accuracy:
    """Converts radii from their message; one of an older server states only whether they were measured."""
    source = message.calibration or (
        pb.CALIBRATION_SOURCE_MEASURED if message.calibrated else pb.CALIBRATION_SOURCE_GENERIC
    )
    return wire.filled(Accuracy, message, calibration=wire.value_name(pb.CalibrationSource, source))


def geo_pose_from_message(message: pb.GeoPose) -> GeoPose:
    """Converts a GeoPose from its message."""
    position, q = message.position, message.quaternion
    return GeoPose(position.lat, position.lon, position.h, Quaternion(q.x, q.y, q.z, q.w))


def _optional_transform(message: Any, field: str, path: str = "") -> RigidTransform | None:
    return optional(message, field, wire.transform_from_message, path + field)


def _framed_from_message(message: pb.FramedPose) -> FramedPose:
    return FramedPose(
        axes=wire.value_name(pb.Axes, message.axes),
        world_from_camera=wire.transform_from_message(message.world_from_camera, "in_axes.world_from_camera"),
        covariance=covariance_from_message(message),
        world_from_session=_optional_transform(message, "world_from_session", "in_axes."),
    )


def _hint_from_message(message: pb.Hint) -> Hint:
    return wire.filled(Hint, message, advice=wire.value_name(pb.Advice, message.advice))


def _hypothesis_from_message(message: pb.Hypothesis) -> Hypothesis:
    pose = wire.transform_from_message(message.world_from_camera, "hypotheses.world_from_camera")
    return wire.filled(Hypothesis, message, world_from_camera=pose, references=tuple(message.references))


def _debug_from_message(message: pb.Debug) -> Debug:
    def columns(*fields: str) -> Array:
        return np.stack([np.array(getattr(message, field), float) for field in fields], axis=1)

    return Debug(
        query_px=columns("query_x_px", "query_y_px"),
        x_in_world=columns("point_x_m", "point_y_m", "point_z_m"),
        is_inlier=np.array(message.is_inlier, bool),
        error_px=np.array(message.error_px, float),
        reference=np.array(message.reference, np.intp),
        reference_px=columns("reference_x_px", "reference_y_px"),
    )


def diagnostics_from_message(message: pb.Diagnostics) -> Diagnostics:
    """Converts diagnostics from their message."""
    return wire.filled(
        Diagnostics,
        message,
        variant=wire.value_name(pb.Variant, message.variant),
        references=tuple(wire.filled(ReferenceUse, use) for use in message.references),
        scale=optional(message, "scale", _scale_from_message),
        stage_s={timing.stage: _seconds(timing.duration) for timing in message.stages},
        queue_s=_seconds(message.queue_duration),
        total_s=_seconds(message.total_duration),
    )


def _scale_from_message(message: pb.ScaleEstimate) -> ScaleEstimate:
    return wire.filled(ScaleEstimate, message, stage=wire.value_name(pb.ScaleStage, message.stage))


def _seconds(duration: Any) -> float:
    return float(duration.ToNanoseconds() / 1e9)


def prior_checks_from_messages(messages: Iterable[pb.PriorCheck]) -> tuple[PriorCheck, ...]:
    """Converts the checks of priors from their messages."""
    return tuple(wire.filled(PriorCheck, check, kind=wire.value_name(pb.PriorKind, check.kind)) for check in messages)
