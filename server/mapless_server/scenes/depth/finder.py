"""Lets queries find the depths stored with references."""

import logging
import threading
from collections.abc import Sequence
from dataclasses import replace

from mapless_server.method.views import KeypointDepths, PosedView
from mapless_server.store import LruCache
from mapless_server.store.database import Database
from mapless_server.store.depths import load_depths

from ..observer import BackgroundObserver

log = logging.getLogger(__name__)

_CACHE_BYTES = 32 * 2**20
"""Depths at the keypoints of some 4000 references with 2000 keypoints each."""


class DepthFinder:
    """Adds stored depths to loaded references; thread-safe."""

    def __init__(self, database: Database, observer: BackgroundObserver, kind: str | None = None) -> None:
        """`kind` is that of the depths; None for any kind of the present version, made by any server."""
        self._database = database
        self._observer = observer
        self._kind = kind
        self._cache: LruCache[KeypointDepths] = LruCache(_CACHE_BYTES)
        self._damaged: set[tuple[str, str]] = set()
        self._guard = threading.Lock()

    def with_depths(self, references: Sequence[PosedView], extractor: str) -> tuple[PosedView, ...]:
        """Returns the references with the depths stored for their keypoints, of this extractor; never raises."""
        found = {it.key: self._cache.get((it.key, extractor)) for it in references}
        missing = [it for it in references if found[it.key] is None]
        if missing:
            try:
                found |= self._read(missing, extractor)
            except Exception as error:  # the query can do without
                log.warning("kept depths cannot be read, and are not used: %s", error)
                self._observer.count("depth_failures")
        return tuple(it if found[it.key] is None else replace(it, depths=found[it.key]) for it in references)

    def _read(self, references: Sequence[PosedView], extractor: str) -> dict[str, KeypointDepths]:
        stored = load_depths(self._database, [it.key for it in references], self._kind)
        if stored.damaged:
            log.error("%d damaged depths of references are not used, and made again", len(stored.damaged))
            with self._guard:
                self._damaged |= stored.damaged
        found = {it.key: stored.depths[it.key].at_keypoints(it.view) for it in references if it.key in stored.depths}
        for key, depths in found.items():
            self._cache.put((key, extractor), depths, depths.depth.nbytes)
        damaged_count = len({key for _, key in stored.damaged} - found.keys())
        absent_count = len(references) - len(found) - damaged_count
        self._observer.looked_up("stored_depths", len(found), absent_count, damaged_count)
        return found

    def take_damaged(self) -> frozenset[tuple[str, str]]:
        """Returns kinds and keys of the depths that were found damaged since the last call."""
        with self._guard:
            damaged, self._damaged = frozenset(self._damaged), set()
        return damaged
