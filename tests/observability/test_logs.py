"""Whatever is logged, a line is one JSON object with time and origin, and holds no bytes; repetitions are counted."""

import io
import json
import logging
import math
import warnings
from collections.abc import Iterator
from datetime import datetime, timezone
from enum import Enum, IntEnum
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from mapless_server.observability.logs import (
    MAX_TEXT,
    JsonFormatter,
    RepeatFilter,
    TextFormatter,
    configure_logging,
    plain,
)
from mapless_server.settings import Settings


class Unshowable:
    def __repr__(self) -> str:
        raise RuntimeError("no")

    __str__ = __repr__


class Colour(Enum):
    RED = "red"


class Level(IntEnum):
    HIGH = 3


def record_of(
    message: object = "m", /, *args: object, levelno: int = logging.INFO, **fields: object
) -> logging.LogRecord:
    return logging.getLogger("a.b").makeRecord("a.b", levelno, "file.py", 7, message, args, None, extra=fields)


def written(message: object = "m", /, *args: object, **fields: Any) -> dict[str, Any]:
    line = JsonFormatter().format(record_of(message, *args, fields=fields))
    assert line.isascii()
    assert line.isprintable()  # one line, and nothing that a terminal obeys
    read: dict[str, Any] = json.loads(line)
    return read


def test_a_line_has_time_level_logger_and_message() -> None:
    record = record_of("%s of %d", "one", 2, scene="hall", inlier_count=90)
    record.created = datetime(2026, 11, 21, 8, 30, 15, 123456, timezone.utc).timestamp()
    assert json.loads(JsonFormatter().format(record)) == {
        "ts": "2026-11-21T08:30:15.123Z",
        "level": "info",
        "logger": "a.b",
        "message": "one of 2",
        "scene": "hall",
        "inlier_count": 90,
    }


HOSTILE = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats()
    | st.text(alphabet=st.characters())  # surrogates, control characters and line separators among them
    | st.binary()
    | st.just(object())
    | st.complex_numbers()
    | st.datetimes(),
    lambda values: (
        st.lists(values) | st.dictionaries(st.text() | st.integers() | st.binary(), values) | st.tuples(values)
    ),
    max_leaves=20,
)


@given(st.text(alphabet=st.characters()), st.dictionaries(st.text(min_size=1), HOSTILE, max_size=5))
def test_any_message_and_any_fields_are_one_object_on_one_line(message: str, fields: dict[str, Any]) -> None:
    line = written(message, **{"scene": "s", **fields})
    assert line["message"] == message
    assert line["logger"] == "a.b"
    assert len(line) >= 5


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (math.nan, "nan"),
        (-math.inf, "-inf"),
        (np.float32(0.5), 0.5),
        (np.int64(7), 7),
        ([10**5000], None),
        (b"\xff\xd8 a photograph", "<15 bytes>"),
        (memoryview(b"abc"), "<3 bytes>"),
        (
            {"image": b"abc", 1: [b"d", Unshowable()]},
            {"image": "<3 bytes>", "1": ["<1 bytes>", "<Unshowable that raises RuntimeError>"]},
        ),
        (Colour.RED, "red"),
        (Level.HIGH, 3),
        (Path("a/b"), None),
        (Unshowable(), "<Unshowable that raises RuntimeError>"),
        ("half a character \ud800", "half a character \ud800"),
    ],
)
def test_every_value_has_a_form_in_json(value: object, shown: object) -> None:
    line = written(value=value)["value"]
    assert line == shown if shown is not None else line


def test_a_list_that_holds_itself_and_large_ones_are_cut() -> None:
    endless: list[object] = []
    endless.append(endless)
    assert len(json.dumps(plain(endless))) < 2000
    many = plain(list(range(1000)))
    assert isinstance(many, list)
    assert many[-1] == "... 936 more"
    assert len(str(plain("x" * 10**6))) < 2000
    assert len(str(plain(dict.fromkeys(range(1000), "x" * 10**6)))) < 100_000
    assert len(written("x" * 10**6)["message"]) < MAX_TEXT + 100


def test_fields_cannot_replace_those_of_every_line() -> None:
    line = written("m", level="fake", ts="fake", logger="fake", name="scene", message="x", args="y", exception="z")
    assert (line["level"], line["logger"], line["message"]) == ("info", "a.b", "m")
    assert (line["level_"], line["name"], line["message_"], line["exception_"]) == ("fake", "scene", "x", "z")


@pytest.mark.parametrize("formatter", [JsonFormatter(), TextFormatter()])
def test_marks_of_other_libraries_are_no_fields(formatter: logging.Formatter) -> None:
    line = formatter.format(record_of("m", scene="hall", _mark_of_a_library=1))
    assert "hall" in line
    assert "_mark_of_a_library" not in line


def test_arguments_that_do_not_fit_the_message_are_shown() -> None:
    assert written("%d of %d", "one")["message"] == "%d of %d ['one']"
    assert written("%s", Unshowable())["message"] == "%s ['<Unshowable that raises RuntimeError>']"


@pytest.mark.parametrize("formatter", [JsonFormatter(), TextFormatter()])
def test_an_exception_belongs_to_its_line(formatter: logging.Formatter) -> None:
    stream = io.StringIO()
    handler = logging.StreamHandler(stream)
    handler.setFormatter(formatter)
    try:
        raise ValueError("bad\n2026-11-21T08:30:15.123Z ERROR forged: \x1b[2J")
    except ValueError as error:
        record = record_of("failed")
        record.exc_info = (ValueError, error, error.__traceback__)
        handler.handle(record)
    lines = stream.getvalue().splitlines()
    assert "ValueError: bad" in stream.getvalue()
    assert "\x1b" not in stream.getvalue()
    assert all(line.startswith("  ") for line in lines[1:])
    assert isinstance(formatter, TextFormatter) or len(lines) == 1


def test_text_shows_fields_and_escapes_line_breaks() -> None:
    text = TextFormatter().format(record_of("a\nb", scene="x y\n", count=3, escape="\x1b[2J"))
    first, second = text.split("\n")
    assert first.endswith(" INFO a.b: a")
    assert second == '  b scene="x y\\n" count=3 escape="\\u001b[2J"'


# What repeats


def filtered(kept: RepeatFilter, count: int, **record: Any) -> list[logging.LogRecord]:
    records = [record_of(**record) for _ in range(count)]
    return [it for it in records if kept.filter(it)]


def test_a_repeated_warning_passes_few_times_then_is_counted() -> None:
    now_s = [0.0]
    kept = RepeatFilter(burst=3, period_s=60, clock=lambda: now_s[0])
    assert len(filtered(kept, 10, levelno=logging.WARNING)) == 3
    now_s[0] = 59.0
    assert filtered(kept, 5, levelno=logging.WARNING) == []
    now_s[0] = 60.0
    first, *rest = filtered(kept, 2, levelno=logging.WARNING)
    assert json.loads(JsonFormatter().format(first))["suppressed"] == 12
    assert "suppressed" not in json.loads(JsonFormatter().format(rest[0]))
    now_s[0] = 120.0
    (quiet,) = filtered(kept, 1, levelno=logging.WARNING)
    assert not hasattr(quiet, "suppressed")


def test_what_is_no_warning_always_passes() -> None:
    kept = RepeatFilter(burst=1)
    assert len(filtered(kept, 50, levelno=logging.INFO)) == 50


def test_another_place_or_exception_is_another_warning() -> None:
    kept = RepeatFilter(burst=1)
    records = []
    for line in (1, 2):
        for error in (None, ValueError(), KeyError()):
            record = record_of(levelno=logging.ERROR)
            record.lineno = line
            record.exc_info = None if error is None else (type(error), error, None)
            records += [record, record]
    assert [kept.filter(record) for record in records] == [True, False] * 6


# All together


@pytest.fixture
def untouched_root() -> Iterator[None]:
    root = logging.getLogger()
    handlers, level = root.handlers[:], root.level
    for handler in handlers:
        root.removeHandler(handler)
    yield
    logging.captureWarnings(False)
    for handler in root.handlers[:]:
        root.removeHandler(handler)
    for handler in handlers:
        root.addHandler(handler)
    root.setLevel(level)


@pytest.mark.usefixtures("untouched_root")
def test_every_log_is_one_object_a_line() -> None:
    stream = io.StringIO()
    configure_logging(Settings(log_level="info", log_format="json"), stream)
    log = logging.getLogger("somewhere.else")
    log.debug("not this")
    log.info("a\nb", extra={"tenant": "t"})
    for _ in range(50):
        log.error("the same")
    with warnings.catch_warnings():
        warnings.simplefilter("always")
        warnings.warn("old", stacklevel=1)
    lines = [json.loads(line) for line in stream.getvalue().splitlines()]
    assert lines[0]["message"] == "a\nb"
    assert lines[0]["tenant"] == "t"
    assert sum(line["message"] == "the same" for line in lines) == 10
    assert "old" in lines[-1]["message"]
    assert len(lines) == 12


@pytest.mark.usefixtures("untouched_root")
def test_text_is_text_and_configuring_again_replaces() -> None:
    first, second = io.StringIO(), io.StringIO()
    configure_logging(Settings(log_format="json"), first)
    configure_logging(Settings(log_format="text", log_level="warning"), second)
    logging.getLogger("x").info("no")
    logging.getLogger("x").warning("yes", extra={"n": 1})
    assert first.getvalue() == ""
    assert second.getvalue().endswith(" WARNING x: yes n=1\n")
