"""Answers as JSON, and as text for a terminal."""

import argparse
import dataclasses
import difflib
import json
import math
import re
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import date
from enum import Enum
from itertools import islice
from typing import Any

import numpy as np
from google.protobuf import json_format
from google.protobuf.message import Message

from mapless import wire
from mapless.answers import LocalizationResult, Rejected
from mapless.calls.health import SERVICES
from mapless.client import Client
from mapless.depth import DepthImage
from mapless.errors import MaplessError, NotFound
from mapless.geometry import Camera, RigidTransform
from mapless.pixels import size_of_image

_NUMBER = re.compile(r"-?[\d.]+")


def is_json(arguments: argparse.Namespace) -> bool:
    """Whether to print JSON: not on a terminal, unless --json or --text decides."""
    return bool(arguments.json if arguments.json is not None else not sys.stdout.isatty())


def show(arguments: argparse.Namespace, value: object, text: Sequence[str]) -> int:
    """Prints a value as JSON or as its text, see `is_json`; returns exit code 0."""
    print(json.dumps(plain(value), indent=2) if is_json(arguments) else "\n".join(text), flush=True)
    return 0


def is_confirmed(arguments: argparse.Namespace, what: str) -> bool:
    """Whether the user wants what cannot be undone: asked where there is a terminal, unless --yes is given."""
    if arguments.yes or not (sys.stdin.isatty() and sys.stderr.isatty()):
        return True
    print(f"mapless: {what}? [y/N] ", end="", file=sys.stderr, flush=True)
    return sys.stdin.readline().strip().lower() in ("y", "yes")


def serving_states(client: Client, whole: str) -> dict[str, bool]:
    """Whether the server as a whole, under this name, and each of its services accept calls."""
    states = {whole: client.is_serving()}
    for service in SERVICES:
        with suppress(NotFound):  # a proxy may answer for the whole server only
            states[service.rpartition(".")[2]] = client.is_serving(service)
    return states


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> list[str]:
    """Lines of a table: a heading and rows, with numbers aligned to the right."""
    columns = [[name, *map(str, cells)] for name, *cells in zip(head, *rows, strict=True)]
    for column in columns:
        is_number = len(column) > 1 and all(map(_NUMBER.fullmatch, column[1:]))
        width = max(map(len, column))
        column[:] = [cell.rjust(width) if is_number else cell.ljust(width) for cell in column]
    return ["  ".join(cells).rstrip() for cells in zip(*columns, strict=True)]


def card(**fields: object) -> list[str]:
    """Lines with a name and a value each; omits fields that are None."""
    known = {name: value for name, value in fields.items() if value is not None}
    width = max(map(len, known), default=0)
    return [f"{name:{width}}  {value}" for name, value in known.items()]


def plain(value: Any) -> Any:
    """A result as JSON values, with geometry in the form that --camera and --pose read."""
    if isinstance(value, Camera):
        return plain(wire.camera_to_message(value))
    if isinstance(value, RigidTransform):
        return plain(wire.transform_to_message(value))
    if isinstance(value, Message):
        # Zeros too, which protobuf's JSON leaves out: a program that reads translation_m.x finds it wherever the
        # camera is. What can be absent, such as a lens, stays absent.
        return json_format.MessageToDict(
            value, preserving_proto_field_name=True, always_print_fields_with_no_presence=True
        )
    if isinstance(value, DepthImage):  # without its bytes
        numbers = {it.name: plain(getattr(value, it.name)) for it in dataclasses.fields(value)}
        form, size = ("png", size_of_image(value.data, "depth")) if value.size is None else ("float32", value.size)
        return numbers | {"data": form, "confidence": bool(value.confidence), "size": list(size)}
    if dataclasses.is_dataclass(value):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {key: plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, np.ndarray):
        return plain(value.tolist())
    if isinstance(value, date):  # or a time
        return value.isoformat()
    if isinstance(value, Enum):
        return value.value
    if isinstance(value, float) and not math.isfinite(value):
        return None  # JSON has neither NaN nor infinity
    return value


def line(name: str, answer: LocalizationResult | Rejected, with_scene: bool = False) -> str:
    """An answer as one row of a table, which ends with its scene if that is wanted."""
    if isinstance(answer, Rejected):
        return f"{name}  not localized: {answer.reason}"
    x, y, z = answer.world_from_camera.translation
    unit, radius = "units" if answer.arbitrary_unit else "m", " " * 11
    if answer.accuracy is not None:
        radius_m = answer.accuracy.position_95_m
        radius = f"{radius_m:11.4g}" if answer.arbitrary_unit else f"{100 * radius_m:8.2f} cm"
    trust = f"{answer.trust:6.3f}" if answer.trust is not None else " " * 6
    counts = f"{answer.inlier_count}/{answer.match_count}"
    scene = f"  {answer.scene.removeprefix('scenes/')}" if with_scene else ""
    return f"{name}  {x:9.3f} {y:9.3f} {z:9.3f} {unit} {radius} {trust}  {counts:>9}{scene}"


def heading(width: int, with_scene: bool = False) -> str:
    """Heading of the table of `line`, for names of this width."""
    scene, numbers = "  scene" if with_scene else "", f"{'x':>9} {'y':>9} {'z':>9}   {'95 % within':>11} {'trust':>6}"
    return f"{'photograph':{width}}  {numbers}  {'inliers':>9}{scene}"


_MAX_COMPARED = 10_000


@contextmanager
def suggesting(client: Client) -> Iterator[None]:
    """Adds to a NotFound of the block the existing scene or reference whose name resembles the given one."""
    try:
        yield
    except NotFound as error:
        nearest: list[str] = []
        with suppress(MaplessError):  # such as that of a token that may not list them
            nearest = difflib.get_close_matches(error.resource.rpartition("/")[2], _existing(client, error.resource), 1)
        if not nearest:
            raise
        message = f"{error.message}; did you mean {nearest[0]!r}?"
        raise NotFound(
            error.code, message, reason=error.reason, resource=error.resource, request_id=error.request_id
        ) from error


def _existing(client: Client, resource: str) -> list[str]:
    """Ids of the existing resources of the same kind and parent as a resource that does not exist."""
    parent, _, _ = resource.rpartition("/references/")
    if parent:
        return [it.reference_id for it in islice(client.list_references(parent), _MAX_COMPARED)]
    return [it.scene_id for it in islice(client.list_scenes(), _MAX_COMPARED)]
