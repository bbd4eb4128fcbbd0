"""Deletes what was set apart, see `removing`: a portion at a time, and again where that was cut off."""

from __future__ import annotations

import logging
import threading

from mapless_server.errors import Overloaded

from . import removing
from .damage import DamagedPages
from .database import Database

logger = logging.getLogger(__name__)

REFERENCES_AT_A_TIME = 100
"""At most; of larger ones fewer, see `removing.next_portion`. So long others wait who want to write to SQLite."""
PAUSE_S = 0.01
"""Between portions: whoever waits to write meanwhile would not get SQLite's lock, which knows no order, without."""


class Leftovers:
    """What is left of deleted scenes in a database; safe for many threads."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None

    def resume(self) -> None:
        """Have what an earlier deletion has left deleted, if there is any, by a thread of its own; never raises."""
        if self._database.only_reads:
            return
        try:
            is_left = self._is_left()
        except Exception as error:
            _tell(error)
            return
        if is_left:
            logger.info("deleting what is left of scenes whose deletion was cut off")
            self._thread = threading.Thread(target=self._delete_or_tell, name="leftovers", daemon=True)
            self._thread.start()

    def close(self) -> None:
        """End the thread after the portion that it is deleting."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()

    def delete(self) -> None:
        """Delete all of it, by whomever it was left. References on pages that cannot be freed are put aside.

        Raises:
            Overloaded: the disk has not even the room to delete one.
        """
        if not self._is_left():
            return
        at_most = count = REFERENCES_AT_A_TIME
        was_full = False
        while True:
            # Before, since a portion that finds no room has by then taken all that this would need.
            self._database.make_room()
            keys: list[str] = []
            try:
                if not self._delete_portion(count, keys):
                    return
                count, was_full = at_most, False
            except DamagedPages:
                if count == 1:
                    self._set_aside(keys)
                count, was_full = 1 if count > 1 else at_most, False
            except Overloaded:
                if was_full:
                    raise
                at_most, count, was_full = 1, 1, True
            if self._closing.wait(PAUSE_S):
                return

    def _is_left(self) -> bool:
        with self._database.read() as connection:
            return removing.is_left(connection)

    def _delete_portion(self, count: int, keys: list[str]) -> bool:
        """Whether there is more to delete; `keys` hears of the portion before it is deleted."""
        with self._database.write() as connection:  # changes nothing that anybody sees
            keys += removing.next_portion(connection, count)
            removing.remove(connection, *keys)
            removing.forget_empty(connection)
            return bool(keys) and removing.is_left(connection)

    def _set_aside(self, keys: list[str]) -> None:
        if not keys:  # it is not theirs what is damaged, but where references are looked up
            raise DamagedPages
        with self._database.write() as connection:
            removing.set_aside(connection, keys[0])

    def _delete_or_tell(self) -> None:
        try:
            self.delete()
        except Exception as error:
            _tell(error)


def _tell(error: Exception) -> None:
    logger.warning("what is left of deleted scenes stays until the next start or deletion of a scene: %s", error)
