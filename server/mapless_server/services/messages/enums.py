"""Enums and dataclasses as protobuf's enums and messages, by their names."""

from enum import Enum
from functools import cache
from typing import Any, TypeVar

from google.protobuf.descriptor import Descriptor
from google.protobuf.message import Message

from mapless import wire
from mapless.wire import FieldError

E = TypeVar("E", bound=Enum)
MessageT = TypeVar("MessageT", bound=Message)


@cache
def enum_to_message(value: Enum, enum: wire.ProtoEnum) -> Any:
    """The protobuf number of a value."""
    return enum.Value(wire.enum_prefix(enum) + value.name)


def message_of(value: object, kind: type[MessageT], **others: Any) -> MessageT:
    """The message of a value whose attributes have the names of the message's fields, all but `others`.

    Enums are converted by their names; None leaves a field empty. AttributeError if the value lacks an attribute.
    """
    descriptor: Any = kind.DESCRIPTOR  # annotated as None
    given = {name: getattr(value, name) for name in _names_of(descriptor) if name not in others}
    fields = {name: _number_of(it, descriptor, name) if isinstance(it, Enum) else it for name, it in given.items()}
    return kind(**fields, **others)


@cache
def _names_of(message: Descriptor) -> tuple[str, ...]:
    return tuple(it.name for it in message.fields)


@cache
def _number_of(value: Enum, message: Descriptor, name: str) -> int:
    values = message.fields_by_name[name].enum_type.values
    return int(next(it.number for it in values if it.name == values[0].name.removesuffix("UNSPECIFIED") + value.name))


def enum_from_message(number: int, enum: wire.ProtoEnum, default: E, field: str) -> E:
    """The value of a protobuf number, and the default for 0; FieldError if the number is unknown."""
    if number == 0:
        return default
    if number not in enum.values():
        raise FieldError(field, f"must be one of {enum.DESCRIPTOR.name}'s values, is {number}")
    return type(default)[enum.Name(number).removeprefix(wire.enum_prefix(enum))]
