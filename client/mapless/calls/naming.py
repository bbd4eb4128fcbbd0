"""What callers may write in short, in full."""

from __future__ import annotations

from enum import Enum
from typing import Any

from .. import names, wire


def scene_name(scene: str) -> str:
    """The name of a scene given by id or by name."""
    return scene if scene.startswith("scenes/") else names.scene_name(scene)


def reference_name(scene: str, reference: str) -> str:
    """The name of a reference given by id or by name, of a scene given by either."""
    return reference if reference.startswith("scenes/") else f"{scene_name(scene)}/references/{reference}"


def enum_value(enum: wire.ProtoEnum, value: str | Enum) -> Any:
    """The number of an option's value, in small or capital letters; ValueError names those there are."""
    prefix = wire.enum_prefix(enum)
    written = str(value.value if isinstance(value, Enum) else value)
    if not written:
        return 0
    known = [name.removeprefix(prefix).lower() for name in enum.keys()[1:]]
    if written.lower() not in known:
        raise ValueError(f"{enum.DESCRIPTOR.name} is one of {', '.join(known)}, not {written!r}")
    return enum.Value(prefix + written.upper())
