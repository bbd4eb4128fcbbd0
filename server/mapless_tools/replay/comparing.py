"""The differences between an answer and the same answer computed again.

Durations, the call's id, the server's version, whether it was captured and what the server had still to make are no
part of an answer; versions, settings and weights are compared separately.
"""

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from google.protobuf.json_format import MessageToDict

from mapless import wire
from mapless.geometry import rotation_angle_deg
from mapless.v1 import geometry_pb2 as geometry_pb
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.engine.query import TRACK
from mapless_server.services.capture.calls import Response, diagnostics_of

DESCRIBE = "describe"
"""The stage in which a server extracts the features that a replay already has."""
SCENES = "scenes"
"""The stage in which a photograph is matched with references of several scenes, of which a replay computes one."""
NO_ANSWER = (
    *("request_id", "server_version", "captured", "attempts", "missing_evidence", "scenes", "searched_scene_count"),
    *(f"{name}_duration" for name in ("queue", "total", "processor")),
)
"""Fields of diagnostics that are no part of the answer."""
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
    is_among = any(it.searched_scene_count > 1 for it in diagnostics_of(then))
    first, second = _essence(then, is_among), _essence(now, is_among)
    for before, after in zip(_with_intrinsics(first), _with_intrinsics(second), strict=False):
        # Servers before 0.4 do not send it.
        if after.HasField("used_intrinsics") and not before.HasField("used_intrinsics"):
            after.ClearField("used_intrinsics")
    if first.SerializeToString(deterministic=True) == second.SerializeToString(deterministic=True):
        return Comparison(True)
    was, is_now = (dict(_leaves(MessageToDict(it, preserving_proto_field_name=True))) for it in (first, second))
    return Comparison(False, tuple(changed(was, is_now)[:MAX_CHANGES]), *_apart(first, second))


def _with_intrinsics(response: Response) -> list[Any]:
    """The messages of a response that have the intrinsics of a photograph."""
    if isinstance(response, pb.LocalizeResponse):
        return [getattr(response, response.WhichOneof("outcome") or "rejection")]
    return list(response.images)


def changed(then: Mapping[str, str], now: Mapping[str, str]) -> list[Change]:
    """Differences of values by name."""
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
    reasons = response.rejection.DESCRIPTOR.fields_by_name["reason"].enum_type.values_by_number
    return str(reasons[response.rejection.reason].name).removeprefix("REJECTION_REASON_").lower()


def _essence(response: Any, is_among: bool) -> Any:
    """A copy without the fields that are not part of the answer.

    Among several scenes the stages begin with the choice of references, and the attempt near a prior is made in the
    scene of the prior, if at all: so neither the order of stages nor that attempt is a part of it.
    """
    copy = type(response)()
    copy.CopyFrom(response)
    for diagnostics in diagnostics_of(copy):
        for name in NO_ANSWER:
            diagnostics.ClearField(name)
        kept = [it.stage for it in diagnostics.stages if it.stage not in (DESCRIBE, SCENES)]
        kept = sorted({*kept} - {TRACK}) if is_among else kept
        del diagnostics.stages[:]
        diagnostics.stages.extend(pb.StageTiming(stage=it) for it in kept)
    return copy


def _leaves(value: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Every value of a message as a dictionary, by its path, as text that two values share only if they are equal."""
    if isinstance(value, dict):
        yield path, "{}"
        for name, inner in value.items():
            yield from _leaves(inner, f"{path}.{name}" if path else name)
    elif isinstance(value, list):
        for index, inner in enumerate(value):
            yield from _leaves(inner, f"{path}[{index}]")
    else:
        yield path, value if isinstance(value, str) else repr(value)


def _apart(first: Any, second: Any) -> tuple[float | None, float | None]:
    """Distance of two answers' poses, cm and degrees; None if one of them has none."""
    if not (first.HasField("localization") and second.HasField("localization")):
        return None, None
    was, is_now = (wire.transform_from_message(_pose_of(it.localization), "pose") for it in (first, second))
    centimetres = 100 * math.dist(was.translation, is_now.translation)
    return centimetres, rotation_angle_deg(was.rotation.T @ is_now.rotation)


def _pose_of(found: Any) -> geometry_pb.RigidTransform:
    if isinstance(found, pb.RigLocalization):
        return found.world_from_rig
    return found.world_from_camera if isinstance(found, pb.Localization) else found.poses[-1].world_from_camera
