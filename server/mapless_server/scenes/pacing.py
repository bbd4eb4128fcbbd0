"""Work in the background is done in steps, after each of which it waits while the server computes for callers."""

import math
import threading
import time
from collections.abc import Callable

_LOOK_S = 0.01


class Pace:
    """The pace of one thread's work, which uses all of a core while the server is idle, else a small share of it.

    Attributes:
        closing: set when the work is to end; waiting ends then.
    """

    def __init__(self, is_idle: Callable[[], bool], busy_share: float) -> None:
        """`is_idle` is whether the server computes nothing for a caller; `busy_share` is that of a core if it does."""
        self.closing = threading.Event()
        self._is_idle = is_idle
        self._busy_share = busy_share
        self._begin_s = time.monotonic()
        self._busy_s = -math.inf

    def begin_step(self) -> None:
        """Begins a step now: what was before has used no time of a core."""
        self._begin_s = time.monotonic()

    def end_step(self, quiet_s: float = 0.0, longest_s: float = math.inf) -> None:
        """Waits while the server computes for callers, as long as its share demands, and begins the next step.

        The server counts as idle when it has computed nothing for `quiet_s`. It waits at most `longest_s`.
        """
        now_s = time.monotonic()
        until_s = now_s + min((now_s - self._begin_s) / self._busy_share, longest_s)
        while now_s < until_s:
            if not self._is_idle():
                self._busy_s = now_s
            if (self._busy_s < now_s and now_s - self._busy_s >= quiet_s) or self.closing.wait(_LOOK_S):
                break
            now_s = time.monotonic()
        self.begin_step()
