"""How long an import waits for a server that is busy or away."""

from __future__ import annotations

import threading
import time
from dataclasses import dataclass


@dataclass(frozen=True)
class UploadOptions:
    """Options of storing.

    Attributes:
        parallel: messages in flight. The server describes their photographs side by side; more only wait.
        busy_patience_s: how long a server may say that it is too busy before the import gives up.
        away_patience_s: how long it may be unreachable; a restart takes seconds.
    """

    parallel: int = 3
    busy_patience_s: float = 600.0
    away_patience_s: float = 60.0

    def __post_init__(self) -> None:
        if not 1 <= self.parallel <= 64:
            raise ValueError(f"--parallel is the number of messages in flight, 1 to 64, not {self.parallel}")
        if not (self.busy_patience_s > 0 and self.away_patience_s > 0):
            raise ValueError("times must be above 0")


class Waiting:
    """Waiting for the server on behalf of one message."""

    def __init__(self, options: UploadOptions, stop: threading.Event) -> None:
        self.lost_an_answer = False
        self._options = options
        self._stop = stop
        self._start_s = time.monotonic()
        self._away_s = 0.0

    def for_busy(self, retry_after_s: float) -> bool:
        """Waits as the server asks; False when that has been going on for too long."""
        if time.monotonic() - self._start_s > self._options.busy_patience_s:
            return False
        self._stop.wait(min(max(retry_after_s, 0.05), 30.0))
        return True

    def for_return(self) -> bool:
        """Waits a little longer each time; False when it has been long enough."""
        if self._away_s >= self._options.away_patience_s:
            return False
        pause_s = min(max(0.5, self._away_s / 2), 5.0)
        self._stop.wait(pause_s)
        self._away_s += pause_s
        return True
