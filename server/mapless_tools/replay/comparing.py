"""The differences between an answer and the same answer computed again.

Durations, the call's id, the server's version and whether it was captured are no part of an answer; versions, settings
and weights are compared separately.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from mapless import wire
from mapless.geometry import rotation_angle_deg
from mapless.v1 import geometry_pb2 as geometry_pb
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.services.capture.calls import Response, diagnostics_of

DESCRIBE = "describe"
"""The stage in which a server extracts the features that a replay already has."""
ABSENT = "-"

MAX_CHANGES = 40
"""Most changes shown of one answer; `Debug` alone has thousands of numbers."""


@dataclass(frozen=True)
class Change:
    """A difference: the field, and both values as text."""

    field: str
    then: str
    now: str


@dataclass(frozen=True)
class Comparison:
    """Whether an answer is the same to the last bit, the first differences, and how far two poses are apart."""

    is_identical: bool
    changes: tuple[Change, ...] = ()
    apart_cm: float | None = None
    apart_deg: float | None = None


def compare(then: Response, now: Response) -> Comparison:
    """Compares a captured answer with a new one."""
    first, second = _essence(then), _essence(now)
    if first.SerializeToString(deterministic=True) == second.SerializeToString(deterministic=True):
        return Comparison(True)
    was, is_now = dict(_leaves(first)), dict(_leaves(second))
    different = [it for it in was | is_now if was.get(it, ABSENT) != is_now.get(it, ABSENT)]
    changes = [Change(it, was.get(it, ABSENT), is_now.get(it, ABSENT)) for it in different]
    apart_cm, apart_deg = _apart(_pose_of(first), _pose_of(second))
    return Comparison(False, tuple(changes[:MAX_CHANGES]), apart_cm, apart_deg)


def changed(then: Mapping[str, str], now: Mapping[str, str]) -> list[Change]:
    """Differences of versions, settings and weights."""
    names = [it for it in {**then, **now} if then.get(it, ABSENT) != now.get(it, ABSENT)]
    return [Change(it, then.get(it, ABSENT), now.get(it, ABSENT)) for it in names]


def stage_seconds(response: Response) -> dict[str, float]:
    """Time of each stage, over all photographs."""
    seconds: dict[str, float] = {}
    for diagnostics in diagnostics_of(response):
        for it in diagnostics.stages:
            seconds[it.stage] = seconds.get(it.stage, 0.0) + it.duration.ToNanoseconds() / 1e9
    return seconds


def outcome_of(response: Any) -> str:
    """The outcome in a word: "localized", or the reason of the rejection."""
    if response.HasField("localization"):
        return "localized"
    known = response.rejection.DESCRIPTOR.fields_by_name["reason"].enum_type.values_by_number
    return str(known[response.rejection.reason].name).removeprefix("REJECTION_REASON_").lower()


def _essence(response: Any) -> Any:
    """A copy without the fields that are not part of the answer."""
    copy = type(response)()
    copy.CopyFrom(response)
    for diagnostics in diagnostics_of(copy):
        for name in (
            "request_id",
            "queue_duration",
            "total_duration",
            "processor_duration",
            "attempts",
            "server_version",
            "captured",
        ):
            diagnostics.ClearField(name)
        kept = [it.stage for it in diagnostics.stages if it.stage != DESCRIBE]
        del diagnostics.stages[:]
        diagnostics.stages.extend(pb.StageTiming(stage=it) for it in kept)
    return copy


def _leaves(message: Message, path: str = "") -> Iterator[tuple[str, str]]:
    """Every value of a message, by its path, as text that two values share only if they are equal."""
    for field, value in message.ListFields():
        name = f"{path}.{field.name}" if path else field.name
        if not field.is_repeated:
            yield from _leaf(field, name, value)
            continue
        for index, item in enumerate(value):
            yield from _leaf(field, f"{name}[{index}]", item)


def _leaf(field: FieldDescriptor, name: str, value: Any) -> Iterator[tuple[str, str]]:
    if field.message_type is not None:
        yield name, "{}"
        yield from _leaves(value, name)
    elif field.enum_type is not None:
        known = field.enum_type.values_by_number.get(value)
        yield name, known.name if known else str(value)
    else:
        yield name, repr(value) if not isinstance(value, str) else value


def _pose_of(response: Any) -> geometry_pb.RigidTransform | None:
    if not response.HasField("localization"):
        return None
    if isinstance(response, pb.LocalizeResponse):
        found = response.localization.world_from_camera
    elif isinstance(response, pb.LocalizeRigResponse):
        found = response.localization.world_from_rig
    else:
        found = response.localization.poses[-1].world_from_camera
    return found


def _apart(
    first: geometry_pb.RigidTransform | None, second: geometry_pb.RigidTransform | None
) -> tuple[float | None, float | None]:
    if first is None or second is None:
        return None, None
    was, is_now = wire.transform_from_message(first, "pose"), wire.transform_from_message(second, "pose")
    centimetres = 100 * math.dist(was.translation, is_now.translation)
    return centimetres, rotation_angle_deg(was.rotation.T @ is_now.rotation)
