"""Deletes captured calls when they are to go, whatever becomes of the calls that come: what is promised of them.

- What is too old goes on time, whether the store answers or not: a thread that asks nobody but the folder sees to that.
- What was made of a scene or of references that have been deleted since, by whatever server, goes within
  `STORE_CHECK_S` or as soon as the store can be asked; what somebody deleted by hand is forgotten as soon. Another
  thread does that.

Neither thread ends before it is told to. The third promise, the limit of size, is kept where calls are written; see
`CaptureFolder.add`.
"""

from __future__ import annotations

import logging
import threading
import time

from mapless_server.errors import Unavailable
from mapless_server.store import Store

from .folder import CaptureFolder
from .staleness import Staleness
from .telling import Telling

log = logging.getLogger(__name__)

STORE_CHECK_S = 30.0
"""How long after a scene or a reference was deleted what was made of it is there at most."""
EXPIRY_CHECK_S = 1.0
"""How late a call may go, where the clock has been set; else it goes on time."""
_MIN_PAUSE_S = 0.01


class Deletion:
    """Watches over one folder until it is closed."""

    def __init__(self, folder: CaptureFolder, store: Store, telling: Telling) -> None:
        """Begins; asks the store in a thread of its own."""
        self._folder = folder
        self._staleness = Staleness(store)
        self._telling = telling
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._keep_the_time_limit, name="capture-expiry", daemon=True),
            threading.Thread(target=self._follow_the_store, name="capture-deletion", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Ends it; returns when what is being deleted is."""
        self._closing.set()
        for thread in self._threads:
            thread.join()

    def _keep_the_time_limit(self) -> None:
        pause_s = 0.0
        while not self._closing.wait(pause_s):
            pause_s = EXPIRY_CHECK_S
            try:
                pause_s = min(max(self._folder.expire(), _MIN_PAUSE_S), EXPIRY_CHECK_S)
            except Exception as error:  # whatever it is, the time limit holds for all others
                self._telling.complain("captured calls that are too old cannot be deleted", error)

    def _follow_the_store(self) -> None:
        pause_s = 0.0
        while not self._closing.wait(pause_s):
            begin_s = time.monotonic()
            self._forget_deleted()
            self._delete_stale()
            pause_s = max(begin_s + STORE_CHECK_S - time.monotonic(), _MIN_PAUSE_S)

    def _forget_deleted(self) -> None:
        try:
            self._folder.forget_deleted()
        except Exception as error:  # this one and all below: it is tried again, and keeps nothing else
            self._telling.complain("what is left of captured calls cannot be deleted", error)

    def _delete_stale(self) -> None:
        try:
            stale = self._staleness.delete_stale(self._folder)
            if stale:
                log.info("%d captured calls are deleted, since their scenes or references were", stale)
        except Unavailable:
            log.debug("the store is away; captured calls are checked later")
        except Exception as error:
            self._telling.complain("captured calls cannot be compared with the store", error)
