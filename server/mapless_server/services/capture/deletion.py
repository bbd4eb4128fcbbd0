"""Deletes captured calls on time, in two threads of its own, independent of new calls.

- One deletes expired calls. It needs only the folder, so it also works if the store does not answer.
- One deletes calls whose scene or references were deleted by any server, within `STORE_CHECK_S` or as soon as the store
  can be read, and drops what was deleted from the folder by hand.

The limit of size is kept where calls are written, see `CaptureFolder.add`.
"""

import logging
import threading
import time
from itertools import groupby

from mapless_server.errors import DataLoss, NotFound, Unavailable
from mapless_server.security import SceneKey
from mapless_server.store import SceneRecord, Store, time_us

from .folder import CapturedEntry, CaptureFolder

References = frozenset[tuple[str, str]]
"""Ids and keys."""

log = logging.getLogger(__name__)

STORE_CHECK_S = 30.0
"""Period of the comparison with the store: the longest time that a deleted scene's calls remain."""
EXPIRY_CHECK_S = 1.0
"""Largest delay of an expiry after the clock was set; otherwise calls expire on time."""
_MIN_PAUSE_S = 0.01


class StaleCalls:
    """Finds calls whose scene or references were deleted; reads each generation of a scene once. For one thread."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._known: dict[SceneKey, tuple[int, References]] = {}

    def delete(self, folder: CaptureFolder) -> int:
        """Deletes these calls; a fault of one scene or file does not keep those of the others. Returns their number.

        Unavailable if the store cannot be read, and nothing more is found until it can; OSError if a file cannot be
        deleted; or the exception because of which a scene cannot be read.
        """
        entries = sorted(folder.entries(), key=lambda it: it.scene_key)
        by_scene = {key: list(calls) for key, calls in groupby(entries, lambda it: it.scene_key)}
        self._known = {key: known for key, known in self._known.items() if key in by_scene}
        stale: list[CapturedEntry] = []
        faults: list[Exception] = []
        try:
            for scene_key, calls in by_scene.items():
                stale += self._stale(scene_key, calls, faults)
        finally:
            folder.remove_all(stale)
        if faults:
            raise faults[0]
        return len(stale)

    def _stale(self, scene_key: SceneKey, calls: list[CapturedEntry], faults: list[Exception]) -> list[CapturedEntry]:
        try:
            scene = self._store.get_scene(scene_key)
            created_us = time_us(scene.create_time)
            of_this = [it for it in calls if it.scene_created_us == created_us]
            existing = self._existing(scene, References().union(*(it.references for it in of_this)))
        except NotFound:
            return calls
        except DataLoss:  # it exists, and cannot be read
            return []
        except Unavailable:  # for the other scenes, too
            raise
        except Exception as error:
            faults.append(error)
            return []
        return [it for it in calls if it.scene_created_us != created_us or not it.references <= existing]

    def _existing(self, scene: SceneRecord, wanted: References) -> References:
        """Returns existing references, among them all of the wanted ones that exist; each generation is read once."""
        generation, existing = self._known.get(scene.scene_key, (scene.generation, References()))
        if generation != scene.generation:
            existing = References()
        unknown = wanted - existing
        if unknown:
            existing |= unknown & self._store.find_keys(scene.scene_key, sorted({it for it, _ in unknown})).items()
        self._known[scene.scene_key] = scene.generation, existing
        return existing


class Deletion:
    """Deletes the calls of one folder on time, until it is closed."""

    def __init__(self, folder: CaptureFolder, store: Store) -> None:
        """Starts its threads, of which only one reads the store."""
        self._folder = folder
        self._stale = StaleCalls(store)
        self._closing = threading.Event()
        self._threads = [
            threading.Thread(target=self._expire, name="capture-expiry", daemon=True),
            threading.Thread(target=self._follow_store, name="capture-deletion", daemon=True),
        ]
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Ends the threads; returns when a running deletion is done."""
        self._closing.set()
        for thread in self._threads:
            thread.join()

    # Each of these threads goes on after any exception: an unexpected fault must not end the deletion.

    def _expire(self) -> None:
        pause_s = 0.0
        while not self._closing.wait(pause_s):
            pause_s = EXPIRY_CHECK_S
            try:
                pause_s = min(max(self._folder.expire(), _MIN_PAUSE_S), EXPIRY_CHECK_S)
            except Exception as error:
                _log_fault("captured calls that are too old cannot be deleted", error)

    def _follow_store(self) -> None:
        pause_s = 0.0
        while not self._closing.wait(pause_s):
            begin_s = time.monotonic()
            try:
                self._folder.forget_deleted()
            except Exception as error:
                _log_fault("what is left of captured calls cannot be deleted", error)
            self._delete_stale()
            pause_s = max(begin_s + STORE_CHECK_S - time.monotonic(), _MIN_PAUSE_S)

    def _delete_stale(self) -> None:
        try:
            count = self._stale.delete(self._folder)
            if count:
                log.info("%d captured calls are deleted, since their scenes or references were", count)
        except Unavailable:
            log.debug("the store is not available; captured calls are checked later")
        except Exception as error:
            _log_fault("captured calls cannot be compared with the store", error)


def _log_fault(what: str, error: Exception) -> None:
    """Logs what failed; an unexpected error with its traceback.

    As a record of the caller's line: repeated records are limited by line, and one fault must not hide the others.
    """
    log.error("%s: %s", what, error, exc_info=None if isinstance(error, OSError) else error, stacklevel=2)
