"""Fields of messages by their path, as errors name them: "frames[1].intrinsics.width_px"."""

import re
from typing import Any

from google.protobuf.message import Message

from mapless.v1 import localization_service_pb2 as pb


def set_field(message: Message, path: str, value: Any) -> None:
    """Sets one: a number or bytes, a message that is copied, a list that is appended, or None, which clears it."""
    *parents, last = re.findall(r"\w+", path)
    target: Any = message
    for name in parents:
        target = target[int(name)] if name.isdigit() else getattr(target, name)
    if value is None:
        target.ClearField(last)
    elif isinstance(value, Message):
        getattr(target, last).CopyFrom(value)
    elif isinstance(value, list):
        getattr(target, last).extend(value)
    else:
        setattr(target, last, value)


def essence(answer: pb.LocalizeResponse, with_stages: bool = False) -> bytes:
    """All of an answer but its times, the call's name and what the background lacks; stages only where asked for."""
    kept = pb.LocalizeResponse()
    kept.CopyFrom(answer)
    for name in (
        "request_id",
        "queue_duration",
        "total_duration",
        "processor_duration",
        "missing_evidence",
        *([] if with_stages else ["stages"]),
    ):
        kept.diagnostics.ClearField(name)
    for stage in kept.diagnostics.stages:
        stage.ClearField("duration")
    for attempt in kept.diagnostics.attempts:
        attempt.ClearField("duration")
        attempt.ClearField("processor_duration")
    return bytes(kept.SerializeToString(deterministic=True))
