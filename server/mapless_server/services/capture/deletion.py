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
from itertools import groupby

from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.security.tenancy import SceneKey
from mapless_server.store import SceneRecord, Store, time_us

from .folder import CaptureFolder
from .held import Held
from .telling import Telling

References = frozenset[tuple[str, str]]
"""Ids and keys."""


class Staleness:
    """Remembers what was found out of a scene as long as it does not change; for one thread."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._known: dict[SceneKey, tuple[int, References]] = {}

    def delete_stale(self, folder: CaptureFolder) -> int:
        """Deletes the calls of scenes that were deleted, and those that a deleted reference took part in.

        Whatever is wrong with one scene or one file keeps nothing of another.

        Returns:
            How many calls went.

        Raises:
            Unavailable: the store is away and says nothing; what is to go then goes when it is back, or for its age.
            OSError: a file cannot be deleted.
            Exception: a scene cannot be asked for.
        """
        held = sorted(folder.held(), key=lambda it: it.scene_key)
        of_scene = {key: list(calls) for key, calls in groupby(held, lambda it: it.scene_key)}
        self._known = {key: known for key, known in self._known.items() if key in of_scene}
        stale: list[Held] = []
        faults: list[Exception] = []
        try:
            for scene_key, calls in of_scene.items():
                stale += self._stale_unless_faulty(scene_key, calls, faults)
        finally:
            folder.remove_all(stale)
        if faults:
            raise faults[0]
        return len(stale)

    def _stale_unless_faulty(self, scene_key: SceneKey, calls: list[Held], faults: list[Exception]) -> list[Held]:
        try:
            return self._stale(scene_key, calls)
        except Unavailable:  # and is so for the others
            raise
        except Exception as error:
            faults.append(error)
            return []

    def _stale(self, scene_key: SceneKey, calls: list[Held]) -> list[Held]:
        try:
            scene = self._store.get_scene(scene_key)
            created_us = time_us(scene.create_time)
            others = [it for it in calls if it.scene_created_us != created_us]
            its = [it for it in calls if it.scene_created_us == created_us]
            there = self._there(scene, References().union(*(it.references for it in its)))
        except NotFound:
            return calls
        except DataLoss:  # it is there, and cannot be read
            return []
        return [*others, *(it for it in its if not it.references <= there)]

    def _there(self, scene: SceneRecord, used: References) -> References:
        """Of the references, those that are still there, and maybe more; each is asked for once a generation."""
        generation, there = self._known.get(scene.scene_key, (scene.generation, References()))
        if generation != scene.generation:
            there = References()
        unknown = used - there
        if unknown:
            there |= unknown & self._store.find_keys(scene.scene_key, sorted({it for it, _ in unknown})).items()
        self._known[scene.scene_key] = scene.generation, there
        return there


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
