"""Answers as `mapless localize --debug` writes them, read again."""

import json
from collections.abc import Iterator
from dataclasses import dataclass, fields, is_dataclass
from datetime import datetime
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf import json_format

from mapless import Camera, LocalizationResult, Rejected, RigidTransform, wire
from mapless.v1 import geometry_pb2

_COMMAND = "`mapless localize --debug --output FILE`"


@dataclass(frozen=True, eq=False)
class Written:
    """An answer with the photograph's name and camera."""

    photo: str
    camera: Camera
    answer: LocalizationResult | Rejected


def read_answers(text: str, name: str) -> Iterator[Written]:
    """The answers of a file: one, or one on each line; a failed call among them is passed over.

    ValueError, which has the file's `name` and the line, for anything else.
    """
    try:
        entries = [(name, json.loads(text))]
    except ValueError:
        lines = [(f"{name}, line {i}", line) for i, line in enumerate(text.splitlines(), 1) if line.strip()]
        entries = [(where, _parsed(where, line)) for where, line in lines]
    if not entries:
        raise ValueError(f"{name} is empty: it must be a file that {_COMMAND} wrote")
    for where, entry in entries:
        if not isinstance(entry, dict) or "photo" not in entry:
            raise ValueError(f"{where}: no answer with its photograph and camera, as {_COMMAND} writes it")
        if "error" in entry:
            continue
        if "camera" not in entry:
            raise ValueError(f"{where}: the answer has no camera and no matches; {_COMMAND} writes them")
        kind = Rejected if "reason" in entry else LocalizationResult
        try:
            answer = _value(kind, entry)
            _check_lengths(answer)
            yield Written(str(entry["photo"]), _value(Camera, entry["camera"]), answer)
        except (KeyError, TypeError, ValueError, AttributeError, json_format.ParseError) as error:
            raise ValueError(f"{where}: no answer as {_COMMAND} writes it: {error!r}") from error


def _parsed(where: str, line: str) -> Any:
    try:
        return json.loads(line)
    except ValueError as error:
        raise ValueError(f"{where} is not JSON: {error}") from None


def _value(kind: Any, value: Any) -> Any:
    """A value of a type, as `mapless.cli.output.plain` makes JSON of it."""
    if get_origin(kind) is UnionType:
        if value is None:
            return None
        (kind,) = (it for it in get_args(kind) if it is not NoneType)
    if kind is RigidTransform:
        return wire.transform_from_message(json_format.ParseDict(value, geometry_pb2.RigidTransform()), "")
    if kind is Camera:
        return wire.camera_from_message(json_format.ParseDict(value, geometry_pb2.CameraIntrinsics()), "")
    if get_origin(kind) is np.ndarray:
        (element,) = get_args(get_args(kind)[1])
        return np.array(value, element)  # None, for a number that is not finite, becomes NaN
    if get_origin(kind) is tuple:
        return tuple(_value(get_args(kind)[0], it) for it in value)
    if kind is datetime:
        return datetime.fromisoformat(value)
    if kind is float and value is None:
        return float("nan")
    if isinstance(kind, type) and is_dataclass(kind):
        types = get_type_hints(kind)
        given = {it.name: value[it.name] for it in fields(kind) if it.init and it.name in value}
        return kind(**{name: _value(types[name], it) for name, it in given.items()})
    return value


def _check_lengths(answer: LocalizationResult | Rejected) -> None:
    if answer.debug is None:
        return
    counts = {name: len(column) for name, column in vars(answer.debug).items()}
    if len(set(counts.values())) > 1:
        raise ValueError(f"the matches have columns of different lengths: {counts}")
