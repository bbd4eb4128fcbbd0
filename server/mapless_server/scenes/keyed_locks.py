"""Who is at what: so that threads do nothing twice."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

_POLL_S = 0.05


class Claims:
    """Things that threads are at, each claimed by one thread at a time."""

    def __init__(self) -> None:
        self._held: set[tuple[str, str]] = set()
        self._changed = threading.Condition()

    @contextmanager
    def claimed(self, thing: tuple[str, str]) -> Iterator[bool]:
        """Whether the thing is the caller's while the block runs; False if it is somebody else's."""
        with self._changed:
            is_mine = thing not in self._held
            self._held.add(thing)
        try:
            yield is_mine
        finally:
            if is_mine:
                with self._changed:
                    self._held.remove(thing)
                    self._changed.notify_all()

    def wait(self, thing: tuple[str, str], check: Callable[[], None]) -> None:
        """Returns when nobody holds the thing; lets through what `check` raises, which is called again and again."""
        with self._changed:
            while thing in self._held:
                check()
                self._changed.wait(_POLL_S)
