"""What goes wrong with captures, for the log: it may do so at every call, and the log tells of it once a minute."""

from __future__ import annotations

import logging
import threading
import time
from collections import Counter

log = logging.getLogger(__name__)

SILENCE_S = 60.0
"""So long the log tells nothing of the same kind again."""


class Telling:
    """Tells the log; from any thread."""

    def __init__(self) -> None:
        self._guard = threading.Lock()
        self._told_s: dict[str, float] = {}
        self._dropped: Counter[str] = Counter()

    def complain(self, what: str, error: Exception, request_id: str = "") -> None:
        """Something failed, with a call of this id if with any; what nobody expects is told with its origin."""
        if self._is_time_to_tell(what):
            origin = None if isinstance(error, OSError) else error
            log.error("%s: %s", what, error, exc_info=origin, extra={"request_id": request_id} if request_id else None)

    def dropped(self, reason: str) -> None:
        """A call was not captured; those that the log does not tell of now it tells of later."""
        with self._guard:
            self._dropped[reason] += 1
        if self._is_time_to_tell("dropped"):
            self.tell_dropped()

    def tell_dropped(self) -> None:
        """Tells of all that were dropped since the log last told of some."""
        with self._guard:
            told, self._dropped = self._dropped, Counter()
        if told:
            log.warning("calls were not captured: %s", ", ".join(f"{name} {count}" for name, count in told.items()))

    def _is_time_to_tell(self, what: str) -> bool:
        with self._guard:
            now_s = time.monotonic()
            is_time = now_s - self._told_s.get(what, -SILENCE_S) >= SILENCE_S
            if is_time:
                self._told_s[what] = now_s
            return is_time
