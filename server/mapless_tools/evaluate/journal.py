"""What was measured, kept as it comes: a file for each run, a line for each query.

The first line says what the run is of; the file's name ends in a digest of it. A run that is started again with the
same data, options, code and weights goes on where its file ends; with anything else it gets another file.
"""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from .metrics import QueryResult

Identity = Mapping[str, Any]
"""What a run's results depend on, as JSON values."""


class Journal:
    """The results of one run."""

    def __init__(self, folder: Path, name: str, identity: Identity) -> None:
        """Finds what is there already; `folder` exists."""
        text = json.dumps(identity, sort_keys=True)
        self.path = folder / f"{name}.{hashlib.sha256(text.encode()).hexdigest()[:12]}.jsonl"
        self._head = text
        self.results: dict[str, QueryResult] = {}
        if self.path.is_file():
            self._read()

    def _read(self) -> None:
        """Takes whole lines; one that a crash tore, and what follows it, is cut off."""
        content = self.path.read_bytes()
        head, *lines = content.split(b"\n")
        if head.decode() != self._head:
            os.truncate(self.path, 0)
            return
        whole = len(head) + 1
        for line in lines[:-1]:
            try:
                result = _result(json.loads(line))
            except (ValueError, TypeError, KeyError):
                break
            self.results[result.name] = result
            whole += len(line) + 1
        if whole < len(content):
            os.truncate(self.path, whole)

    def add(self, result: QueryResult) -> None:
        """Writes a result; it is on its way to the disk when this returns, and survives the program."""
        begins = not self.path.is_file() or not self.path.stat().st_size
        with self.path.open("a", encoding="utf-8") as stream:
            if begins:
                stream.write(self._head + "\n")
            stream.write(json.dumps(_line(result), allow_nan=False) + "\n")
        self.results[result.name] = result


def _line(result: QueryResult) -> dict[str, Any]:
    """Only rejections have infinities: they are written as null."""
    return {
        name: None if isinstance(value, float) and math.isinf(value) else value
        for name, value in asdict(result).items()
    }


def _result(line: dict[str, Any]) -> QueryResult:
    if set(line) != {field.name for field in fields(QueryResult)}:
        raise KeyError("another version's line")
    infinite = ("translation_error", "rotation_error_deg", "reference_distance")
    line |= {name: math.inf for name in infinite if line[name] is None}
    pose = None if line["pose"] is None else tuple(line["pose"])
    return QueryResult(**line | {"references": tuple(line["references"]), "pose": pose})
