"""Fields of messages by their path, as errors name them: "frames[1].intrinsics.width_px"."""

from __future__ import annotations

import re
from typing import Any

from google.protobuf.message import Message


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
