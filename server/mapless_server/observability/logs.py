"""The log: one JSON object a line for programs, or text for people; repeated warnings are counted, not written.

A record's fields besides its message are given by `extra=`, or together, which is faster, as `extra={"fields": {...}}`.
No value of a field can break the line, and bytes are never written. The thread that logs writes the line at once, so
that the last lines before a crash are not lost.
"""

import json
import logging
import math
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from datetime import datetime, timezone
from enum import Enum
from itertools import islice
from numbers import Integral, Real
from typing import TextIO, TypeVar

from mapless_server.settings import Settings

T = TypeVar("T")

MAX_TEXT = 16_000
"""Characters of a message or exception; a longer one is cut."""
_MAX_FIELD_TEXT = 1000
_MAX_ITEMS = 64
_MAX_DEPTH = 4
_MAX_INTEGER = 2**63  # JSON parsers read no larger ones

_OWN_ATTRIBUTES = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "taskName"}
_ENCODER = json.JSONEncoder(allow_nan=False)  # `json.dumps` would make one for every line
_OWN_KEYS = frozenset({"ts", "level", "logger", "message", "exception", "stack"})


class JsonFormatter(logging.Formatter):
    """Formats a record as one JSON object: ts (UTC), level, logger, message, its fields, and exception, if any."""

    def format(self, record: logging.LogRecord) -> str:
        """Implements logging.Formatter."""
        line: dict[str, object] = {
            "ts": _timestamp(record),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": _cut(_message(record), MAX_TEXT),
        }
        for name, value in fields_of(record).items():
            line[f"{name}_" if name in _OWN_KEYS else name] = value
        if record.exc_info:
            line["exception"] = _cut(self.formatException(record.exc_info), MAX_TEXT)
        if record.stack_info:
            line["stack"] = _cut(record.stack_info, MAX_TEXT)
        return _ENCODER.encode(line)


class TextFormatter(logging.Formatter):
    """Formats a record as time, level, logger, message, and fields as name=value; no record can look like two."""

    def format(self, record: logging.LogRecord) -> str:
        """Implements logging.Formatter."""
        words = [_timestamp(record), record.levelname, f"{record.name}:", _cut(_message(record), MAX_TEXT)]
        words += [f"{name}={_ENCODER.encode(value)}" for name, value in fields_of(record).items()]
        text = " ".join(words)
        if record.exc_info:
            text += f"\n{_cut(self.formatException(record.exc_info), MAX_TEXT)}"
        if record.stack_info:
            text += f"\n{_cut(record.stack_info, MAX_TEXT)}"
        return "\n  ".join(_visible(line) for line in text.split("\n"))


class RepeatFilter(logging.Filter):
    """Limits the rate of warnings and errors from one place in the code; a later record has the number of omitted ones.

    A place is a line of code and, if there is an exception, its type. Records below a warning always pass.
    """

    def __init__(self, burst: int = 10, period_s: float = 60.0, clock: Callable[[], float] = time.monotonic) -> None:
        """Allows at most `burst` records of one place in each period, seconds."""
        super().__init__()
        self._burst = burst
        self._period_s = period_s
        self._clock = clock
        self._places: dict[tuple[object, ...], _Place] = {}  # bounded by the lines of code that warn
        self._lock = threading.Lock()

    def filter(self, record: logging.LogRecord) -> bool:
        """Implements logging.Filter."""
        if record.levelno < logging.WARNING:
            return True
        error_type = record.exc_info[0] if record.exc_info else None
        with self._lock:
            now_s = self._clock()
            place = self._places.setdefault((record.name, record.pathname, record.lineno, error_type), _Place(now_s))
            if now_s - place.since_s >= self._period_s:
                if place.suppressed:
                    vars(record)["suppressed"] = place.suppressed
                place.since_s, place.passed, place.suppressed = now_s, 0, 0
            if place.passed >= self._burst:
                place.suppressed += 1
                return False
            place.passed += 1
            return True


class _Place:
    def __init__(self, since_s: float) -> None:
        self.since_s = since_s
        self.passed = 0
        self.suppressed = 0


def configure_logging(settings: Settings, stream: TextIO | None = None) -> None:
    """Writes all logs to a stream (stderr) as the settings say; replaces an earlier configuration."""
    handler = logging.StreamHandler(stream or sys.stderr)
    handler.setFormatter(JsonFormatter() if settings.log_format == "json" else TextFormatter())
    handler.addFilter(RepeatFilter())
    logging.basicConfig(level=settings.log_level.upper(), handlers=[handler], force=True)
    logging.captureWarnings(True)


def fields_of(record: logging.LogRecord) -> dict[str, object]:
    """The fields of a record besides its message, as JSON values: those of its dictionary `fields`, if it has one."""
    fields = vars(record).get("fields")
    if not isinstance(fields, dict):
        names = (name for name in vars(record) if name not in _OWN_ATTRIBUTES)
        fields = {name: vars(record)[name] for name in names if not name.startswith("_")}  # marks of other libraries
    return {name: plain(value) for name, value in fields.items()}


def plain(value: object) -> object:
    """Converts a value to a JSON value: text, finite numbers, lists and objects; large ones are cut.

    Bytes become their count, other values their `repr`. Never raises.
    """
    if value.__class__ is str and len(value) <= _MAX_FIELD_TEXT:  # the usual case first
        return value
    try:
        return _plain(value, 0)
    except Exception as error:  # the rest of the line is still of use
        return f"<{type(value).__name__} that raises {type(error).__name__}>"


def _plain(value: object, depth: int) -> object:
    kind = type(value)  # the usual cases first
    if (kind is float and math.isfinite(value)) or (kind is int and abs(value) < _MAX_INTEGER):  # type: ignore[arg-type]
        return value
    if isinstance(value, Enum):
        return _plain(value.value, depth)
    if value is None or isinstance(value, bool):
        return value
    if isinstance(value, str):
        return _cut(value, _MAX_FIELD_TEXT)
    if isinstance(value, Integral):  # NumPy's too
        number = int(value)
        return number if abs(number) < _MAX_INTEGER else _cut(hex(number), _MAX_FIELD_TEXT)
    if isinstance(value, Real):
        real = float(value)
        return real if math.isfinite(real) else str(real)
    if isinstance(value, bytes | bytearray | memoryview):
        return f"<{len(value)} bytes>"
    if depth < _MAX_DEPTH and isinstance(value, Mapping):
        shown = {str(_plain(name, _MAX_DEPTH)): _plain(item, depth + 1) for name, item in _first(value.items())}
        return shown | {"...": f"{len(value) - len(shown)} more"} if len(value) > len(shown) else shown
    if depth < _MAX_DEPTH and isinstance(value, list | tuple | set | frozenset):
        items = [_plain(item, depth + 1) for item in _first(value)]
        return items + [f"... {len(value) - len(items)} more"] if len(value) > len(items) else items
    return _cut(_repr(value), _MAX_FIELD_TEXT)


def _repr(value: object) -> str:
    try:
        return repr(value)
    except Exception as error:  # the other items of its list are still of use
        return f"<{type(value).__name__} that raises {type(error).__name__}>"


def _first(items: Iterable[T]) -> Iterator[T]:
    return islice(items, _MAX_ITEMS)


def _message(record: logging.LogRecord) -> str:
    try:
        return record.getMessage()
    except Exception:  # arguments that do not fit the message, or cannot be shown
        return f"{record.msg} {plain(record.args)}"


def _timestamp(record: logging.LogRecord) -> str:
    moment = datetime.fromtimestamp(record.created, timezone.utc)
    return moment.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def _cut(text: str, length: int) -> str:
    return text if len(text) <= length else f"{text[:length]}... {len(text) - length} more characters"


def _visible(text: str) -> str:
    """The text with control characters, and characters that cannot be encoded, escaped."""
    if text.isprintable():
        return text
    return "".join(c if c.isprintable() or c == "\t" else c.encode("unicode_escape").decode("ascii") for c in text)
