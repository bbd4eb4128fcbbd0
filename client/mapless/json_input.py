"""Reads messages from JSON that people write: a wrong field is named as written, with its value and bounds."""

import difflib
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from google.protobuf.descriptor import FieldDescriptor
from google.protobuf.message import Message

from .text_files import read_text, without_mark
from .wire import FieldError, joined

M = TypeVar("M", bound=Message)
T = TypeVar("T")

_MAX_SHOWN = 40
_WHOLE = (FieldDescriptor.TYPE_INT32, FieldDescriptor.TYPE_INT64)


def read_message(source: str, message: M, required: Sequence[str], convert: Callable[[M, str], T], what: str) -> T:
    """Reads what a JSON file, or JSON text, describes, into a message with the same fields.

    `convert` makes the result of the message at a path, and checks its bounds; `what` is a name for the text in error
    messages. ValueError, if it is not JSON, or a field is unknown, missing or wrong, names the file and the field;
    OSError if the file cannot be read.
    """
    is_text = is_inline(source)
    name = what if is_text else source
    text = without_mark(source) if is_text else read_text(Path(source))
    try:
        content = read_json(text)
        written: dict[str, str] = {}
        _fill(message, content, "", "", written)
        if missing := [field for field in required if field not in written]:
            raise ValueError(f"{', '.join(missing)} {'is' if len(missing) == 1 else 'are'} missing")
        return convert(message, "")
    except FieldError as error:
        raise ValueError(
            f"{name}: {str(error).replace(error.field, written.get(error.field, error.field), 1)}"
        ) from None
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def is_inline(source: str) -> bool:
    """Whether an argument is JSON itself, not the name of a file."""
    return without_mark(source).lstrip().startswith(("{", "["))


def read_json(text: str) -> Any:
    """Parses JSON that names no field twice; ValueError if it is something else."""
    try:
        if not text.strip():
            raise ValueError("is empty")
        return json.loads(text, object_pairs_hook=_without_repeats)
    except json.JSONDecodeError as error:
        raise ValueError(f"is not JSON: {error.msg} in line {error.lineno}, column {error.colno}") from None
    except RecursionError:
        raise ValueError("is not JSON that can be read: nested too deep") from None


def shown(value: object) -> str:
    """Formats a JSON value for a message; a long one is cut."""
    text = json.dumps(value)
    return text if len(text) <= _MAX_SHOWN else f"{text[:_MAX_SHOWN]}..."


def _without_repeats(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    content: dict[str, Any] = {}
    for key, value in pairs:
        if key in content:
            raise ValueError(f"{key} is given twice")
        content[key] = value
    return content


def _fill(message: Any, content: Any, path: str, shown_path: str, written: dict[str, str]) -> None:
    """Sets a message's fields; adds to `written` the path of each as it was written."""
    if not isinstance(content, dict):
        raise ValueError(f"{shown_path + ' ' if shown_path else ''}must be an object, {{...}}, is {shown(content)}")
    fields = {name: it for it in message.DESCRIPTOR.fields for name in (it.name, it.json_name)}
    for key, value in content.items():
        where = joined(shown_path, key)
        if key not in fields:
            raise ValueError(f"{where} is no field{_suggestion(key, message)}")
        field = fields[key]
        if value is None:  # as if it were not given
            continue
        written[joined(path, field.name)] = where
        if field.message_type is None:
            _set_number(message, field, where, value)
            continue
        other = message.WhichOneof(field.containing_oneof.name) if field.containing_oneof else None
        if other not in (None, field.name):
            raise ValueError(f"{where} and {other} exclude each other")
        part = getattr(message, field.name)
        part.SetInParent()
        _fill(part, value, joined(path, field.name), where, written)


def _suggestion(key: str, message: Any) -> str:
    names = [it.name for it in message.DESCRIPTOR.fields]
    # `focal_x` lacks its unit. Try prefixes first: by edit distance focal_y_px is as near as focal_x_px.
    nearest = [it for it in names if it.startswith(key)] or difflib.get_close_matches(key, names, 1)
    return f", perhaps {nearest[0]}; known: {', '.join(names)}" if nearest else f"; known: {', '.join(names)}"


def _set_number(message: Any, field: Any, where: str, value: Any) -> None:
    is_whole = field.type in _WHOLE
    try:
        number = float("x" if isinstance(value, bool) else value)
        setattr(message, field.name, _whole(number) if is_whole else number)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{where} must be a {'whole ' if is_whole else ''}number, is {shown(value)}") from None


def _whole(number: float) -> int:
    if not number.is_integer():
        raise ValueError
    return int(number)
