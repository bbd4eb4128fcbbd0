"""How far a long command has come: one line on a terminal, redrawn; nothing where nobody watches."""

from __future__ import annotations

import sys
import threading
import time
from collections import Counter
from types import TracebackType
from typing import TextIO

_BAR_CHARACTERS = 24
_REDRAW_S = 0.1


class Progress:
    """A bar on standard error; use it from any thread, as a context manager."""

    def __init__(self, total: int, stream: TextIO | None = None) -> None:
        self._total = total
        self._stream = stream or sys.stderr
        self._is_shown = self._stream.isatty()
        self._start_s = time.monotonic()
        self._drawn_s = 0.0
        self._done = 0
        self._without: Counter[str] = Counter()
        self._lock = threading.Lock()

    def __enter__(self) -> Progress:
        self._draw()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.clear()

    def step(self, without: str = "") -> None:
        """One more is done; `without` what was hoped for, in words: "not localized"."""
        with self._lock:
            self._done += 1
            if without:
                self._without[without] += 1
            if time.monotonic() - self._drawn_s >= _REDRAW_S or self._done == self._total:
                self._draw()

    def clear(self) -> None:
        """Makes room for other output; the next step draws it again."""
        if self._is_shown:
            self._drawn_s = 0.0
            self._stream.write("\r\x1b[K")
            self._stream.flush()

    def text(self) -> str:
        """The line."""
        filled = _BAR_CHARACTERS * self._done // max(self._total, 1)
        took_s = time.monotonic() - self._start_s
        line = f"[{'#' * filled}{'.' * (_BAR_CHARACTERS - filled)}] {self._done}/{self._total}"
        line += self.without()
        if 0 < self._done < self._total:
            line += f", {took_s / self._done * (self._total - self._done):.0f} s to go"
        return line

    def without(self) -> str:
        """How many were done without what was hoped for, to be appended: ", 2 not localized, 1 failed"."""
        return "".join(f", {count} {what}" for what, count in sorted(self._without.items(), reverse=True))

    def _draw(self) -> None:
        if self._is_shown:
            self._drawn_s = time.monotonic()
            self._stream.write(f"\r{self.text()}\x1b[K")
            self._stream.flush()
