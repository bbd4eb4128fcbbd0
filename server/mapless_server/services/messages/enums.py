"""Enums and their twins on the wire, whose values have the same names but for a prefix, "VARIANT_"."""

from __future__ import annotations

from enum import Enum
from typing import Any, TypeVar

from mapless import wire
from mapless.wire import FieldError

E = TypeVar("E", bound=Enum)


def enum_to_message(value: Enum, enum: wire.ProtoEnum) -> Any:
    """The number of a value on the wire."""
    return enum.Value(wire.enum_prefix(enum) + value.name)


def enum_from_message(number: int, enum: wire.ProtoEnum, default: E, field: str) -> E:
    """The value of a number, the default for 0; FieldError if it is none."""
    if number == 0:
        return default
    if number not in enum.values():
        raise FieldError(field, f"{number} is no value of {enum.DESCRIPTOR.name}")
    return type(default)[enum.Name(number).removeprefix(wire.enum_prefix(enum))]
