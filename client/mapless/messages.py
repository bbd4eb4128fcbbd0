"""Answers, scenes and references of messages.

A field of a dataclass has the value of the message's field of the same name, converted by its type (`read`); what is
arranged in another way has a function of its own.
"""

from collections.abc import Callable, Iterable
from dataclasses import fields, is_dataclass
from datetime import datetime, timezone
from functools import cache
from types import NoneType, UnionType
from typing import Any, TypeVar, get_args, get_origin, get_type_hints

import numpy as np

from . import names, wire
from .answers import Accuracy, Hypothesis, LocalizationResult, Rejected
from .depth import DepthImage, depth_from_message
from .diagnostics import Attempt, Debug, Diagnostics
from .geodesy import Datum, GeoPose
from .geometry import Array, Camera, Quaternion, RigidTransform, Similarity
from .groups import GroupRejected, ImageReport, RigLocalization, SequenceLocalization
from .provenance import Provenance, provenance_from_message
from .results import PendingWork, Reference, Scene
from .scenes import (
    AdoptionPolicy,
    Calibration,
    Vector,
    adoption_from_message,
    calibration_from_message,
    datum_from_message,
    direction_from_message,
)
from .used_intrinsics import UsedIntrinsics
from .v1 import localization_service_pb2 as pb
from .v1 import reference_service_pb2 as reference_pb

T = TypeVar("T")


def read(kind: type[T], message: Any, path: str = "", **values: Any) -> T:
    """A dataclass of a message: with the given values, and for other fields those of the message, or defaults.

    FieldError if a number violates the interface; its path begins with that of the message.
    """
    return kind(**_values(kind, message, path, values), **values)


def _values(kind: type, message: Any, path: str = "", given: Iterable[str] = ()) -> dict[str, Any]:
    """Values of a message for those fields of a dataclass that it has, but for the given ones."""
    known = message.DESCRIPTOR.fields_by_name
    return {
        name: _value(wanted, message, known[name], wire.joined(path, name))
        for name, wanted in _types(kind).items()
        if name in known and name not in given
    }


@cache
def _types(kind: Any) -> dict[str, Any]:
    """The types of the fields that a dataclass's constructor takes."""
    types = get_type_hints(kind)
    return {it.name: types[it.name] for it in fields(kind) if it.init}


def _value(wanted: Any, message: Any, field: Any, path: str) -> Any:
    value = getattr(message, field.name)
    if get_origin(wanted) is UnionType:  # X | None
        if not (message.HasField(field.name) if field.has_presence else value):
            return None
        (wanted,) = (it for it in get_args(wanted) if it is not NoneType)
    if get_origin(wanted) is tuple and wanted not in _READERS:
        item, *_ = get_args(wanted)
        return tuple(_converted(item, each, f"{path}[{i}]") for i, each in enumerate(value))
    if field.enum_type:
        return wire.value_name(field.enum_type, value)
    return _converted(wanted, value, path)


def _converted(wanted: Any, value: Any, path: str) -> Any:
    if wanted in _READERS:
        return _READERS[wanted](value, path)
    return read(wanted, value, path) if isinstance(wanted, type) and is_dataclass(wanted) else value


def _accuracy(message: pb.Accuracy, path: str) -> Accuracy:
    """An older server states only whether radii were measured."""
    older = {"calibration": "MEASURED" if message.calibrated else "GENERIC"}
    return read(Accuracy, message, path, **({} if message.calibration else older))


def _geo_pose(message: pb.GeoPose, path: str) -> GeoPose:
    position, q = message.position, message.quaternion
    return GeoPose(position.lat, position.lon, position.h, Quaternion(q.x, q.y, q.z, q.w))


def _debug(message: Any, path: str) -> Debug:
    def columns(*fields: str) -> Array:
        return np.stack([np.array(getattr(message, field), float) for field in fields], axis=1)

    sources = message.DESCRIPTOR.fields_by_name["source"].enum_type
    return Debug(
        query_px=columns("query_x_px", "query_y_px"),
        x_in_world=columns("point_x_m", "point_y_m", "point_z_m"),
        is_inlier=np.array(message.is_inlier, bool),
        error_px=np.array(message.error_px, float),
        reference=np.array(message.reference, np.intp),
        reference_px=columns("reference_x_px", "reference_y_px"),
        source=np.array([wire.value_name(sources, it) for it in message.source], np.str_),
    )


def _used_intrinsics(message: pb.UsedIntrinsics, path: str) -> UsedIntrinsics:
    camera = wire.camera_from_message(message.intrinsics, wire.joined(path, "intrinsics"))
    return read(UsedIntrinsics, message, path, camera=camera)


def _attempt(message: pb.Attempt, path: str) -> Attempt:
    times = {"duration_s": _seconds(message.duration), "processor_s": _seconds(message.processor_duration)}
    return read(Attempt, message, path, **times)


_OFFER: wire.ProtoEnum = pb.AdoptionOffer


def _diagnostics(message: pb.Diagnostics, path: str) -> Diagnostics:
    stage_s = {timing.stage: _seconds(timing.duration) for timing in message.stages}
    times = {
        "queue_s": _seconds(message.queue_duration),
        "total_s": _seconds(message.total_duration),
        "processor_s": _seconds(message.processor_duration),
    }
    adoption = wire.value_name(_OFFER.DESCRIPTOR, message.adoption) if message.adoption else ""
    return read(Diagnostics, message, path, stage_s=stage_s, adoption=adoption, **times)


def _seconds(duration: Any) -> float:
    return float(duration.ToNanoseconds() / 1e9)


def _image_report(message: Any, path: str) -> ImageReport:
    alone = message.alone
    reason = alone.DESCRIPTOR.fields_by_name["reason"].enum_type
    rejected_alone = wire.value_name(reason, alone.reason) if message.HasField("alone") else None
    given = alone.hypotheses
    hypotheses = tuple(read(Hypothesis, it, f"{path}.alone.hypotheses[{i}]") for i, it in enumerate(given))
    return read(ImageReport, message, path, rejected_alone=rejected_alone, hypotheses_alone=hypotheses)


_READERS: dict[Any, Callable[[Any, str], Any]] = {
    Accuracy: _accuracy,
    AdoptionPolicy: adoption_from_message,
    Attempt: _attempt,
    Array: lambda covariance, path: np.array(covariance.row_major).reshape(6, 6),
    Calibration: calibration_from_message,
    Camera: wire.camera_from_message,
    Datum: datum_from_message,
    DepthImage: depth_from_message,
    Debug: _debug,
    Diagnostics: _diagnostics,
    GeoPose: _geo_pose,
    ImageReport: _image_report,
    Provenance: provenance_from_message,
    RigidTransform: wire.transform_from_message,
    UsedIntrinsics: _used_intrinsics,
    Vector: direction_from_message,
    datetime: lambda timestamp, path: timestamp.ToDatetime(timezone.utc),
}
"""Readers of types whose messages have other fields, or bounds."""


def answer_from_message(message: pb.LocalizeResponse) -> LocalizationResult | Rejected:
    """The answer of `Localize`."""
    if message.WhichOneof("outcome") == "rejection":
        return read(Rejected, message.rejection, "rejection", **_values(Rejected, message))
    found, common = message.localization, _values(LocalizationResult, message)
    if not found.scale_source:  # an older server
        common["scale_source"] = "REFERENCES"
    return read(LocalizationResult, found, "localization", **common)


def rig_from_message(message: pb.LocalizeRigResponse) -> RigLocalization | GroupRejected:
    """The answer of `LocalizeRig`."""
    if message.WhichOneof("outcome") == "rejection":
        return read(GroupRejected, message.rejection, "rejection", **_values(GroupRejected, message))
    found = message.localization
    common = _values(RigLocalization, message) | _without_covariance(found)
    return read(RigLocalization, found, "localization", **common)


def sequence_from_message(message: pb.LocalizeSequenceResponse) -> SequenceLocalization | GroupRejected:
    """The answer of `LocalizeSequence`."""
    if message.WhichOneof("outcome") == "rejection":
        return read(GroupRejected, message.rejection, "rejection", **_values(GroupRejected, message))
    found = message.localization
    rigid = wire.transform_from_message(found.world_from_session, "localization.world_from_session")
    return read(
        SequenceLocalization,
        found,
        "localization",
        world_from_session=Similarity(found.session_scale, rigid.rotation, rigid.translation),
        scale_sigma=found.session_scale_sigma,
        world_from_camera=tuple(
            wire.transform_from_message(pose.world_from_camera, f"localization.poses[{i}].world_from_camera")
            for i, pose in enumerate(found.poses)
        ),
        **_values(SequenceLocalization, message),
        **_without_covariance(found),
    )


def _without_covariance(message: Any) -> dict[str, Any]:
    return {} if message.HasField("covariance") else {"covariance": np.full((6, 6), np.nan)}


def scene_from_message(message: reference_pb.Scene, response: Any = None) -> Scene:
    """A scene, and what the response of the call says about it beside."""
    found = {name: getattr(response, name) for name in _SAID_OF_SCENES if hasattr(response, name)}
    if "warnings" in found:
        found["warnings"] = tuple(found["warnings"])
    if isinstance(response, reference_pb.GetSceneResponse):
        found["pending_work"] = tuple(PendingWork(it.kind, it.name, it.reference_count) for it in response.pending_work)
    scene_id, labels = names.parse_scene_name(message.name), dict(message.labels)
    return read(Scene, message, scene_id=scene_id, labels=labels, **found)


_SAID_OF_SCENES = (
    "warnings",
    "contradiction",
    "compared_pair_count",
    "agreeing_pair_count",
    "adopted_reference_count",
    "retired_reference_count",
)


def reference_from_message(message: reference_pb.Reference, warnings: Iterable[str] = ()) -> Reference:
    """A reference, and what was found when it was added."""
    scene_id, reference_id = names.parse_reference_name(message.name)
    camera = wire.camera_from_message(message.intrinsics, "intrinsics")
    place = message.place_reference
    return read(
        Reference,
        message,
        scene_id=scene_id,
        reference_id=reference_id,
        camera=camera,
        warnings=tuple(warnings),
        place_reference=names.parse_reference_name(place)[1] if place else "",
    )
