"""Mutations of protobuf messages, field by field, and of the bytes on the wire.

An input is one byte that chooses the kind of message, then the message as it came over the wire.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cache
from random import Random
from typing import Any

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import DecodeError, Message

from .images import seeds as image_seeds
from .target import MutateBytes

Kinds = Sequence[type[Message]]

_FLOATS = (0.0, -0.0, 1.0, -1.0, 0.5, 1e-320, 1e-160, 1e-7, 1e-3, 90.0, 180.0, 1e6, 1e7, 1e8, 1e154, 1.7e308)
_NOT_FINITE = (float("nan"), float("inf"), float("-inf"))
_INTEGERS = (0, 1, -1, 2, 31, 32, 33, 64, 65, 1000, 1001, 16384, 16385, 2**31 - 1, -(2**31))
_TEXTS = ("", "a", "a/b", "..", "scenes/", "scenes/a", "scenes/a/references/b", "scenes/a\n", "\0", "é", "x" * 129)
_LETTERS = "aZ0_.-/\n\0 \u00e9\u0663\u2028\U0001f600"
_MOST_REPEATED = 40


def encoded(kinds: Kinds, message: Message) -> bytes:
    """The input of a message."""
    data: bytes = message.SerializeToString()
    return bytes([kinds.index(type(message))]) + data


def decoded(kinds: Kinds, data: bytes) -> Message | None:
    """The message of an input; None if it is none, which callers receive as an error."""
    message = kinds[(data[0] if data else 0) % len(kinds)]()
    try:
        message.ParseFromString(data[1:])
    except DecodeError:
        return None
    return message


def mutate(kinds: Kinds, data: bytes, random: Random, mutate_bytes: MutateBytes) -> bytes:
    """Changes some fields, or now and then the bytes."""
    message = decoded(kinds, data)
    if message is None or random.random() < 0.15:
        return data[:1] + mutate_bytes(data[1:])
    for _ in range(random.randrange(1, 4)):
        _change(random.choice([*_nodes(message)]), random, mutate_bytes)
    return encoded(kinds, message)


def _nodes(message: Message) -> Iterator[Message]:
    """The message and all within it."""
    yield message
    for field, value in message.ListFields():
        if field.message_type is not None and not _is_map(field):
            for inner in value if _is_repeated(message, field) else [value]:
                yield from _nodes(inner)


def _is_repeated(message: Message, field: FieldDescriptor) -> bool:
    return hasattr(getattr(message, field.name), "append")


def _is_map(field: FieldDescriptor) -> bool:
    return field.message_type is not None and field.message_type.GetOptions().map_entry


@cache
def _fields(kind: Any) -> tuple[FieldDescriptor, ...]:
    return tuple(kind.DESCRIPTOR.fields)


def _change(message: Message, random: Random, mutate_bytes: MutateBytes) -> None:
    kind: Any = type(message)
    fields = _fields(kind)
    if not fields:
        return
    field = random.choice(fields)
    if _is_repeated(message, field):
        _change_list(getattr(message, field.name), field, random, mutate_bytes)
    elif _is_map(field):
        _change_map(getattr(message, field.name), random)
    elif random.random() < 0.1:
        message.ClearField(field.name)
    elif field.message_type is not None:
        getattr(message, field.name).SetInParent()
    else:
        setattr(message, field.name, _other(getattr(message, field.name), field, random, mutate_bytes))


def _change_list(values: Any, field: FieldDescriptor, random: Random, mutate_bytes: MutateBytes) -> None:
    chosen = random.randrange(len(values)) if values else 0
    kind = random.randrange(4)
    if kind == 0 and values:
        del values[chosen]
    elif kind == 1 and values and field.message_type is None:
        values[chosen] = _other(values[chosen], field, random, mutate_bytes)
    elif len(values) >= _MOST_REPEATED:
        del values[_MOST_REPEATED // 2 :]
    elif field.message_type is not None:
        added = values.add()
        if values and random.random() < 0.8:
            added.CopyFrom(values[chosen])
    elif values and kind == 2:
        values.append(values[chosen])
    else:
        values.append(_other(field.default_value or _empty(field), field, random, mutate_bytes))


def _change_map(values: Any, random: Random) -> None:
    """Texts by texts: adds one, or changes or removes one that there is."""
    name = random.choice([*values]) if values and random.random() < 0.7 else _other_text("site", random)
    if name in values and random.random() < 0.3:
        del values[name]
    elif len(values) < _MOST_REPEATED:
        values[name] = _other_text(values.get(name, "a"), random)


def _empty(field: FieldDescriptor) -> Any:
    return {FieldDescriptor.CPPTYPE_STRING: ""}.get(field.cpp_type, 0)


def _other(value: Any, field: FieldDescriptor, random: Random, mutate_bytes: MutateBytes) -> Any:
    """Another value of a field that is no message."""
    if field.type == FieldDescriptor.TYPE_BYTES:
        return random.choice(image_seeds()) if random.random() < 0.6 else mutate_bytes(value)
    if field.cpp_type == FieldDescriptor.CPPTYPE_STRING:
        return _other_text(value, random)
    if field.cpp_type in (FieldDescriptor.CPPTYPE_DOUBLE, FieldDescriptor.CPPTYPE_FLOAT):
        return _other_float(value, random)
    if field.cpp_type == FieldDescriptor.CPPTYPE_BOOL:
        return not value
    if field.cpp_type in (FieldDescriptor.CPPTYPE_UINT32, FieldDescriptor.CPPTYPE_UINT64):
        return abs(random.choice(_INTEGERS))
    return random.choice(_INTEGERS) if random.random() < 0.7 else random.randrange(-5, 70)


def _other_text(value: str, random: Random) -> str:
    if random.random() < 0.3:
        return random.choice(_TEXTS)
    at = random.randrange(len(value) + 1)
    if random.random() < 0.3:
        return value[:at] + value[at + 1 :]
    return value[:at] + random.choice(_LETTERS) + value[at + random.randrange(2) :]


def _other_float(value: float, random: Random) -> float:
    chance = random.random()
    if chance < 0.1:
        return random.choice(_NOT_FINITE)
    if chance < 0.5:
        return random.choice(_FLOATS) * random.choice((1, -1))
    if chance < 0.75:
        return value * random.choice((-1.0, 1 + 1e-12, 0.999, 1.01, 2.0))
    return random.uniform(-2, 2)
