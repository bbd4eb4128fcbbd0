"""Results for files that are kept from one run to the next, so that an interrupted run is continued."""

import hashlib
import json
from pathlib import Path
from typing import Any

_VERSION = 1
"""Version of the computations: results of another version are not used."""


class Remembered:
    """A log of results, one line each, by the identity of the file that they are of; a line that is cut is ignored."""

    def __init__(self, log: Path) -> None:
        self._log = log
        self._results: dict[str, Any] = {}
        for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if log.exists() else ():
            try:
                key, result = json.loads(line)
            except ValueError:
                continue
            self._results[key] = result

    def get(self, key: str) -> Any:
        """The result of a file's identity; None if there is none."""
        return self._results.get(key)

    def put(self, key: str, result: Any) -> None:
        """Adds a result, of JSON's types, and writes it to the log."""
        self._results[key] = result
        with self._log.open("a", encoding="utf-8") as stream:
            stream.write("\n" + json.dumps([key, result]) + "\n")  # the line before may have been cut


def identity(file: Path) -> str:
    """A digest of a file's path, size and time of change: equal while the file is the same."""
    about = file.stat()
    content = f"{_VERSION} {file.resolve()} {about.st_size} {about.st_mtime_ns}"
    return hashlib.sha256(content.encode("utf-8", "surrogateescape")).hexdigest()[:16]
