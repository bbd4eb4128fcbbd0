"""How many calls at a time: fewer when the server has no room for them, more again while it has."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from ..client import Client
from ..errors import MaplessError, ResourceExhausted
from ..exchange import Pause
from ..options import ConnectOptions


class Pace:
    """Turns for the threads that call: a refusal for lack of room halves their number, answers raise it one by one.

    Who is refused keeps the turn until the call ends: fresh ones do not take the room that it waits for.
    """

    def __init__(self, most: int) -> None:
        self._most = most
        self._limit = float(most)
        self._taken = 0
        self._changed = threading.Condition()

    @contextmanager
    def turn(self) -> Iterator[None]:
        """Waits for a turn; the block is the call."""
        with self._changed:
            self._changed.wait_for(lambda: self._taken < int(self._limit))
            self._taken += 1
        try:
            yield
        except MaplessError as error:
            self.failed(error)
            raise
        else:
            with self._changed:
                self._limit = min(self._limit + 1 / self._limit, self._most)
        finally:
            with self._changed:
                self._taken -= 1
                self._changed.notify_all()

    def failed(self, error: MaplessError) -> None:
        """A call failed, or an attempt of one that is tried again."""
        if isinstance(error, ResourceExhausted):
            with self._changed:
                self._limit = max(self._limit / 2, 1.0)


class PacedClient(Client):
    """A client whose refused attempts are counted as well, not only calls that end so."""

    def __init__(self, address: str, options: ConnectOptions, pace: Pace) -> None:
        super().__init__(address, options)
        self._pace = pace

    def _pause(self, pause: Pause) -> None:
        self._pace.failed(pause.error)
        super()._pause(pause)
