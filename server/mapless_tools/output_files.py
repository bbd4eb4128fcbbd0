"""The files that commands write: JSON for programs, tables, and self-contained HTML reports without scripts."""

import json
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any


def check_writable(file: Path) -> None:
    """Raises ValueError if a file cannot be written, before the work and without creating it."""
    target = file if file.exists() else file.parent
    if file.is_dir() or not file.parent.is_dir() or not os.access(target, os.W_OK):
        raise ValueError(f"{file} cannot be written")


def finite(value: float) -> float | None:
    """The value; None for what JSON and CSV have no word for."""
    return value if math.isfinite(value) else None


def write_json(file: Path, content: Any) -> None:
    """Writes strict JSON; it has no infinities."""
    file.write_text(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


def markdown_table(head: str, rows: Iterable[Iterable[object]]) -> list[str]:
    """Lines of a table in Markdown; `head` has its headings, "scene | median"."""
    lines = (f"| {' | '.join(map(str, row))} |" for row in rows)
    return [f"| {head} |", "|---" * (head.count("|") + 1) + "|", *lines]


def text_table(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table in columns, of which the first is on the left, independent of a terminal's width."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    return ["  ".join(f"{cell:{'>' if i else '<'}{widths[i]}}" for i, cell in enumerate(row)) for row in rows]


@contextmanager
def whole_file(file: Path) -> Iterator[Path]:
    """A file to write, which gets its name when the block ends without an error: completely or not at all."""
    partial = file.with_name(f".{file.name}.partial")
    try:
        yield partial
        with partial.open("rb") as stream:
            os.fsync(stream.fileno())
        os.replace(partial, file)
    finally:
        partial.unlink(missing_ok=True)


def render(template: str, **values: object) -> str:
    """A page of `templates/`, with `values` for its names; text is escaped."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    environment = Environment(
        loader=PackageLoader("mapless_tools"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
