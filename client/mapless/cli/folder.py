"""Localizing a folder of photographs: number of concurrent calls, outcomes, and progress."""

import sys
import threading
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager

from ..answers import LocalizationResult, Rejected
from ..diagnostics import ADOPTION_OFFERS
from ..errors import MaplessError, ResourceExhausted
from ..options import ConnectOptions
from .waiting import WaitingClient

EXIT_FAILED, EXIT_USAGE, EXIT_REJECTED = 1, 2, 3
Outcome = LocalizationResult | Rejected | MaplessError
LOCALIZED, NOT_LOCALIZED, FAILED = "localized", "not localized", "failed"
_BAR_CHARACTERS = 24
_REDRAW_S = 0.1


class Concurrency:
    """Limits the number of concurrent calls: a refusal for lack of room halves it, each answer raises it a little.

    A refused call keeps its place until it ends, so that new calls do not overtake it.
    """

    def __init__(self, maximum: int) -> None:
        self._maximum = maximum
        self._limit = float(maximum)
        self._running = 0
        self._changed = threading.Condition()

    @contextmanager
    def call(self) -> Iterator[None]:
        """Waits until a call may start; the block makes the call."""
        with self._changed:
            self._changed.wait_for(lambda: self._running < int(self._limit))
            self._running += 1
        try:
            yield
        except MaplessError as error:
            self.failed(error)
            raise
        else:
            with self._changed:
                self._limit = min(self._limit + 1 / self._limit, self._maximum)
        finally:
            with self._changed:
                self._running -= 1
                self._changed.notify_all()

    def failed(self, error: MaplessError) -> None:
        """Counts a failed call, or a failed attempt of a call that is retried."""
        if isinstance(error, ResourceExhausted):
            with self._changed:
                self._limit = max(self._limit / 2, 1.0)


class LimitedClient(WaitingClient):
    """A client that reports each refused attempt, not only calls that fail, to a limit of concurrency."""

    def __init__(self, address: str, options: ConnectOptions, concurrency: Concurrency) -> None:
        super().__init__(address, options)
        self._concurrency = concurrency

    async def _pause(self, duration_s: float, error: MaplessError) -> None:
        self._concurrency.failed(error)
        await super()._pause(duration_s, error)


class Tally:
    """Counts outcomes by kind and reason, and draws a progress bar on standard error if that is a terminal."""

    def __init__(self, total: int) -> None:
        self.done = 0
        self._total = total
        self._counts: Counter[str] = Counter()
        self._reasons: dict[str, Counter[str]] = {NOT_LOCALIZED: Counter(), FAILED: Counter()}
        self._captured = 0
        self._offers: Counter[str] = Counter()
        self._is_drawn = sys.stderr.isatty()
        self._start_s = time.monotonic()
        self._drawn_s = 0.0

    def count(self, outcome: Outcome) -> None:
        """Adds an outcome."""
        kind = LOCALIZED
        if isinstance(outcome, Rejected | MaplessError):
            kind = FAILED if isinstance(outcome, MaplessError) else NOT_LOCALIZED
            self._reasons[kind][outcome.reason] += 1
        self.done += 1
        self._counts[kind] += 1
        if not isinstance(outcome, MaplessError):
            self._captured += outcome.diagnostics.captured
            self._offers.update([outcome.diagnostics.adoption] if outcome.diagnostics.adoption else [])
        if time.monotonic() - self._drawn_s >= _REDRAW_S or self.done == self._total:
            self.draw()

    @property
    def exit_code(self) -> int:
        """The command's exit code for these outcomes."""
        if self._counts[FAILED]:
            return EXIT_FAILED
        return EXIT_REJECTED if self._counts[NOT_LOCALIZED] else 0

    def summary(self) -> str:
        """One line: "15 of 20 localized, 5 failed (4 QUEUE_FULL, 1 DEADLINE_EXCEEDED)"."""
        text = "" if self.done == self._total else f"ended after {self.done} of {self._total}: "
        text += f"{self._counts[LOCALIZED]} of {self.done} localized"
        for kind, reasons in self._reasons.items():
            if reasons:
                why = ", ".join(f"{count} {reason}" for reason, count in reasons.most_common())
                text += f", {self._counts[kind]} {kind} ({why})"
        text += f"; {self._captured} captured by the server" if self._captured else ""
        offers = "".join(f"; {count} {ADOPTION_OFFERS.get(it, it)}" for it, count in self._offers.most_common())
        return text + offers

    def progress(self) -> str:
        """The progress bar: "[######......] 4/8, 1 not localized, 1 failed, 3 s to go"."""
        filled = _BAR_CHARACTERS * self.done // max(self._total, 1)
        line = f"[{'#' * filled}{'.' * (_BAR_CHARACTERS - filled)}] {self.done}/{self._total}"
        line += "".join(f", {self._counts[kind]} {kind}" for kind in (NOT_LOCALIZED, FAILED) if self._counts[kind])
        if 0 < self.done < self._total:
            took_s = time.monotonic() - self._start_s
            line += f", {took_s / self.done * (self._total - self.done):.0f} s to go"
        return line

    def draw(self) -> None:
        """Draws the progress bar."""
        if self._is_drawn:
            self._drawn_s = time.monotonic()
            sys.stderr.write(f"\r{self.progress()}\x1b[K")
            sys.stderr.flush()

    def clear(self) -> None:
        """Erases the progress bar, to make room for other output."""
        if self._is_drawn:
            self._drawn_s = 0.0
            sys.stderr.write("\r\x1b[K")
            sys.stderr.flush()
