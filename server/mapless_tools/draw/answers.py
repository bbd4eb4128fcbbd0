"""Answers as `mapless localize --debug` writes them, read again."""

import json
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass, replace
from datetime import datetime
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

import numpy as np
from google.protobuf import json_format

from mapless import Camera, LocalizationResult, Rejected, RigidTransform, wire
from mapless.diagnostics import Debug
from mapless.names import parse_reference_name
from mapless.v1 import geometry_pb2

_COMMAND = "`mapless localize --debug --output FILE`"
_ROWS = {"query_px": (2,), "x_in_world": (3,), "reference_px": (2,)}
"""Shapes of a match's values in the columns of `Debug` that have several."""


@dataclass(frozen=True, eq=False)
class Written:
    """An answer with the photograph's name, which is a path in the folder that was localized, and its camera."""

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
            yield Written(_photo(entry["photo"]), _value(Camera, entry["camera"]), _checked(_value(kind, entry)))
        except (KeyError, TypeError, ValueError, AttributeError, OverflowError, json_format.ParseError) as error:
            raise ValueError(f"{where}: no answer as {_COMMAND} writes it: {error}") from error


def _parsed(where: str, line: str) -> Any:
    try:
        return json.loads(line)
    except ValueError as error:
        raise ValueError(f"{where} is not JSON: {error}") from None


def _photo(name: Any) -> str:
    """The name, with / between its parts; ValueError if it is none in a folder: the file may be another machine's."""
    path = Path(_value(str, name))
    if path.anchor or ".." in path.parts or not path.name:
        raise ValueError(f"photo must name a file in the folder of photographs, without '..', is {name!r}")
    return path.as_posix()


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
        array = np.array(value, element)  # None, for a number that is not finite, becomes NaN
        if array.size and array.dtype.kind != "f" and np.array(value).dtype.kind != array.dtype.kind:
            raise ValueError(f"an array must have elements of the type {array.dtype}")
        return array
    if get_origin(kind) is Mapping:
        return {name: _value(get_args(kind)[1], it) for name, it in value.items()}
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
    if kind in (bool, int, float, str) and not isinstance(value, (int, float) if kind is float else kind):
        raise TypeError(f"{value!r} is not of the type {kind.__name__}")
    return value


def _checked(answer: LocalizationResult | Rejected) -> LocalizationResult | Rejected:
    """The answer with the shapes of its arrays; ValueError if one has another, or a reference's name is none."""
    uses = answer.diagnostics.references
    hint = answer.hint if isinstance(answer, Rejected) else None
    for name in [*(it.name for it in uses), *([hint.best_reference] if hint is not None else [])]:
        if name:
            parse_reference_name(name)
    covariance = answer.covariance if isinstance(answer, LocalizationResult) else None
    if covariance is not None and covariance.shape != (6, 6):
        raise ValueError(f"covariance has the shape {covariance.shape}, not (6, 6)")
    return answer if answer.debug is None else replace(answer, debug=_shaped(answer.debug, len(uses)))


def _shaped(debug: Debug, reference_count: int) -> Debug:
    """The matches, also where there are none: JSON keeps no shape (0, 2)."""
    (count,) = debug.is_inlier.shape[:1] or (0,)
    columns: dict[str, Any] = {}
    for name, column in vars(debug).items():
        shape = (count, *_ROWS.get(name, ()))
        if name == "source" and not len(column):  # of an older server
            shape = (0,)
        columns[name] = column.reshape(shape) if count == 0 and column.shape == (0,) else column
        if columns[name].shape != shape:
            raise ValueError(f"debug.{name} has the shape {column.shape}, not {shape}")
    outside = (debug.reference < 0) | (debug.reference >= reference_count)
    if outside.any():
        first = debug.reference[outside][0]
        raise ValueError(f"debug.reference has {first}, but the answer has {reference_count} references, from 0")
    return Debug(**columns)
