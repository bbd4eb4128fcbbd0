"""Retrieval indexes of scenes, in memory: read once, then updated by what has changed in the store."""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import Future, wait
from functools import partial

import numpy as np

from mapless.geometry import Array
from mapless_server.cache import LruCache
from mapless_server.errors import DataLoss, NotFound, RequestError
from mapless_server.method.features.extractors import FeatureExtractor
from mapless_server.method.features.views import PosedView
from mapless_server.method.options import StageContext
from mapless_server.security import SceneKey
from mapless_server.store import GroupedScene, Store
from mapless_server.store.queries import reference_not_found

from .index_files import IndexFiles, Read, again_if_damaged
from .library import KeyedLocks, Loaded, ReferenceLibrary, load_usable
from .retrieval.index import Entries, GlobalDescriptor, SceneIndex

log = logging.getLogger(__name__)


REMEMBERED_EXTENTS = 100_000
"""Scenes of which the extent is remembered after their index was evicted, some 20 MB."""


_LOOK_S = 0.05
"""Time between two looks whether a call that waits for a large scene has been cancelled."""


class SceneIndexes:
    """Indexes of scenes, of which the least recently used are evicted; thread-safe."""

    def __init__(
        self,
        store: Store,
        library: ReferenceLibrary,
        descriptor: GlobalDescriptor,
        extractor: FeatureExtractor,
        capacity_bytes: int,
        files: IndexFiles | None = None,
    ) -> None:
        """Makes the object without any index.

        The library loads references that have no descriptor yet, with the extractor's features, from which descriptors
        are computed. All indexes have at most `capacity_bytes`; the most recently used one is kept however large it is.
        Large scenes are in files, if these are given.
        """
        self._store = store
        self._library = library
        self._descriptor = descriptor
        self._extractor = extractor
        self._files = files
        self._cached: LruCache[_CachedIndex] = LruCache(capacity_bytes, keeps_latest=True)
        self._extents: LruCache[tuple[int, float]] = LruCache(REMEMBERED_EXTENTS)
        self._lock = threading.Lock()

    def extents_m(self, scenes: Sequence[GroupedScene]) -> Array:
        """Distances (N,), at least, of the furthest references of scenes from the origins of their worlds.

        Infinite where it is not known as of the scene's generation.
        """
        known = [self._extents.get(it.scene_key) for it in scenes]
        pairs = zip(scenes, known, strict=True)
        return np.array([it[1] if it and it[0] == scene.generation else math.inf for scene, it in pairs])

    @property
    def size_bytes(self) -> int:
        """Memory of all indexes, bytes."""
        return self._cached.used

    @property
    def filed(self) -> list[int]:
        """Sizes of the index files in use, bytes."""
        return [it.index.file.size_bytes for it in self._cached.values() if it.index.file is not None]

    @property
    def locks(self) -> KeyedLocks:
        """Locks of what is being computed of references, see `ReferenceLibrary`."""
        return self._library.locks

    def entries(self, scene_key: SceneKey, context: StageContext, waits: bool = True) -> Entries:
        """Returns the references of a scene as it is now.

        References without a descriptor are described now, one by one, and finished ones are kept if the context is
        cancelled; if `waits` is False they remain without. So does one that cannot be described because it is damaged.
        NotFound if there is no such scene (field "scene"); Abandoned if the context is cancelled.
        """
        return again_if_damaged(lambda: self._current(scene_key, context, waits))

    def _current(self, scene_key: SceneKey, context: StageContext, waits: bool) -> Entries:
        # Even if the scene is evicted meanwhile, this call continues with the same index.
        cached = self._get(scene_key)
        if cached.index.generation < 0 and self._files is not None:
            self._begin(scene_key, cached, self._files, context)
        while True:
            self._refresh(scene_key, cached)
            self._consider(scene_key, cached)
            undescribed = self._undescribed(cached)
            if not undescribed or not waits:
                return cached.index.entries()
            log.info("describing %d references of scene %s for retrieval", len(undescribed), scene_key)
            with context.stage("describe"):
                for reference_id, key in undescribed:
                    self._describe(scene_key, cached, reference_id, key, context)

    def known(self, scene_key: SceneKey, generation: int | None) -> Entries | None:
        """The references of a scene in memory, if these are of a generation or a later one; else None.

        None, too, where some have no descriptor. The store is not asked.
        """
        cached = None if generation is None else self._cached.get(scene_key)
        if cached is None or generation is None or cached.index.generation < generation:
            return None
        entries = cached.index.entries()
        return None if entries.undescribed() else entries

    def describe(self, scene_key: SceneKey, references: Sequence[tuple[str, str]], context: StageContext) -> None:
        """Describes those of these references, ids and keys, that have no descriptor, while the context has time.

        What is described, and what is left, is recorded in the context.
        """
        cached, took_s = self._get(scene_key), 0.0
        lacking = {key for _, key in cached.describable(cached.index.entries())}
        for reference_id, key in references:
            if key in lacking:
                is_made, begin_s = context.makes(took_s), time.monotonic()
                if is_made:
                    with context.stage("describe"):
                        self._describe(scene_key, cached, reference_id, key, context)
                context.lacks("retrieval", self._descriptor.name, key, is_made)
                took_s = time.monotonic() - begin_s if is_made else took_s

    def _undescribed(self, cached: _CachedIndex) -> list[tuple[str, str]]:
        """Id and key of the entries without a descriptor, after those that were stored meanwhile have been read."""
        undescribed = cached.describable(cached.index.entries())
        if not undescribed:
            return []
        stored = self._store.load_descriptors([key for _, key in undescribed], self._descriptor.name)
        if stored:
            with cached.updating:
                cached.index.describe(stored)
        return [it for it in undescribed if it[1] not in stored]

    def forget(self, scene_key: SceneKey) -> None:
        """Frees the index of a deleted scene, and deletes its file."""
        with self._lock:
            self._cached.forget(lambda key, _: key == scene_key)
        if self._files is not None:
            self._files.discard(scene_key)

    def close(self) -> None:
        """Ends the work on files."""
        if self._files is not None:
            self._files.close()

    def is_damaged(self, scene_key: SceneKey, reference_id: str) -> bool:
        """Whether a reference is missing from the entries of its scene because its pose or descriptor is damaged."""
        cached = self._cached.get(scene_key)
        if cached is None or reference_id not in cached.damaged_ids:
            return False
        try:
            self._store.get_reference(scene_key, reference_id)
        except DataLoss:
            return True
        except NotFound:  # deletions are listed by key, which is not known of a damaged reference
            cached.damaged_ids.discard(reference_id)
            return False
        return True

    def why_missing(self, scene_key: SceneKey, reference_id: str, field: str) -> RequestError:
        """The error for a named reference that is not among the entries of its scene."""
        if self.is_damaged(scene_key, reference_id):
            message = f"reference {reference_id!r} is damaged in the store: delete it and add it again"
            return DataLoss(message, field=field)
        missing = reference_not_found(scene_key, reference_id, field)
        if reference_id not in self._store.list_retirements(scene_key, [reference_id]):
            return missing
        message = f"reference {reference_id!r} is retired, so that it is not chosen: restore it, or rerank without it"
        return NotFound(message, reason="REFERENCE_RETIRED", field=field, resource=missing.resource)

    def report_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Logs that a reference is not used because it is damaged; once while the scene is in memory."""
        cached = self._cached.get(scene_key)
        if cached is None or reference_id not in cached.reported_ids:
            if cached is not None:
                cached.reported_ids.add(reference_id)
            log.error("reference %s of scene %s is not used: %s", reference_id, scene_key, error)

    def load_existing(
        self,
        library: ReferenceLibrary,
        scene_key: SceneKey,
        reference_ids: Sequence[str],
        extractor: FeatureExtractor,
        context: StageContext,
    ) -> tuple[PosedView, ...]:
        """Loads those of the references that exist and are not damaged, in order; reports the damaged ones."""

        def report(reference_id: str, error: RequestError) -> None:
            if isinstance(error, DataLoss):
                self.report_damaged(scene_key, reference_id, error)

        def load(some: Sequence[str]) -> Loaded:
            return library.load(scene_key, some, extractor, context)

        return load_usable(load, reference_ids, (DataLoss, NotFound), report)[1]

    def describe_stored(
        self, library: ReferenceLibrary, scene_key: SceneKey, reference_id: str, key: str, context: StageContext
    ) -> None:
        """Stores a reference's descriptor unless it has one; the library loads its features."""
        if not self._store.load_descriptors([key], self._descriptor.name):
            self._describe(scene_key, self._get(scene_key), reference_id, key, context, library)

    def _describe(
        self,
        scene_key: SceneKey,
        cached: _CachedIndex,
        reference_id: str,
        key: str,
        context: StageContext,
        library: ReferenceLibrary | None = None,
    ) -> None:
        """Computes and stores a reference's descriptor, unless the reference has been deleted."""
        context.check()
        locks = self._library.locks
        with locks.try_lock((key, self._descriptor.name)) as is_mine:
            if not is_mine:
                locks.wait((key, self._descriptor.name), context.check)
                return
            try:
                untimed = StageContext(context.check)
                _, (reference,) = (library or self._library).load(scene_key, (reference_id,), self._extractor, untimed)
                if reference.key != key:  # it was replaced by another one with the same id
                    return
                vector = self._descriptor.describe(reference.view)
                self._store.add_descriptor(key, self._descriptor.name, vector)
            except NotFound:
                return
            except DataLoss as error:
                cached.undescribable.add(key)
                self.report_damaged(scene_key, reference_id, error)
                return
        with cached.updating:
            cached.index.describe({key: vector})

    def _refresh(self, scene_key: SceneKey, cached: _CachedIndex) -> Entries:
        try:
            entries = cached.refresh(self._store, scene_key, self._descriptor.name)
        except Exception as error:
            # An index that cannot be updated is not valid, and that of a deleted scene wastes memory and disk.
            self._discard_damaged(scene_key, cached)
            if isinstance(error, NotFound) and self._files is not None:  # another server has deleted it
                self._files.discard(scene_key)
            with self._lock:
                self._cached.forget(lambda _, it: it is cached)
            raise
        with self._lock:
            if self._cached.get(scene_key) is cached:
                self._cached.put(scene_key, cached, cached.index.size_bytes)
        before = self._extents.get(scene_key)
        if before is None or before[0] != entries.generation:
            self._extents.put(scene_key, (entries.generation, entries.extent_m()), 1)
        return entries

    def _begin(self, scene_key: SceneKey, cached: _CachedIndex, files: IndexFiles, context: StageContext) -> None:
        """Begins with a large scene's file or, without one, with what is read of it while this and other calls wait."""
        opened = files.open(scene_key)
        if opened is not None:
            cached.begin(scene_key, opened)
        elif files.is_large(scene_key):
            with self._lock:
                reading = cached.reading = cached.reading or files.read(scene_key)
            try:
                while not wait([reading], _LOOK_S).done:
                    context.check()
                cached.begin(scene_key, reading.result())
            finally:
                if reading.done():  # it holds what it has read
                    cached.reading = None

    def _consider(self, scene_key: SceneKey, cached: _CachedIndex) -> None:
        if self._files is not None and self._files.is_due(cached.index.entries()):
            self._files.want(scene_key, partial(cached.adopt, self._store, scene_key, self._descriptor.name))

    def _discard_damaged(self, scene_key: SceneKey, cached: _CachedIndex) -> None:
        if self._files is not None and cached.is_damaged:
            log.error("the index file of scene %s is damaged, and is made again", scene_key)
            self._files.discard(scene_key)

    def _get(self, scene_key: SceneKey) -> _CachedIndex:
        """Returns the scene's index, created if missing, or if its file is damaged."""
        cached = self._cached.get(scene_key)
        if cached is not None and not cached.is_damaged:
            return cached
        if cached is not None:
            self._discard_damaged(scene_key, cached)
        with self._lock:
            found = self._cached.get(scene_key)
            if found is not None and found is not cached:  # another thread was faster
                return found
            new = _CachedIndex(SceneIndex(self._descriptor.dimension))
            self._cached.put(scene_key, new, 0)
            return new


class _CachedIndex:
    """An index, and the lock `updating` of the thread that updates it.

    `damaged_ids` are of references that are not in the index, of which some may have been deleted; `undescribable` are
    keys of references found damaged when they were to be described; of `reported_ids` the damage has been logged;
    `reading` is what calls for a large scene without a file wait for.
    """

    def __init__(self, index: SceneIndex) -> None:
        self.index = index
        self.damaged_ids: set[str] = set()
        self.undescribable: set[str] = set()
        self.reported_ids: set[str] = set()
        self.updating = threading.Lock()
        self.reading: Future[Read] | None = None

    @property
    def is_damaged(self) -> bool:
        """Whether the index uses a file in which damage was found."""
        return self.index.file is not None and self.index.file.is_damaged

    def adopt(self, store: Store, scene_key: SceneKey, descriptor: str, index: SceneIndex) -> None:
        """Replaces the index by one that was just opened, with what has changed since."""
        with self.updating:
            changes = store.list_changes(scene_key, index.generation, descriptor)
            if changes.generation != index.generation:
                index.apply(changes)
            self.damaged_ids.update(changes.damaged)
            self.index = index

    def begin(self, scene_key: SceneKey, read: Read) -> None:
        """Begins with what was read, unless the index has begun already."""
        with self.updating:
            if self.index.generation < 0:
                self.index, damaged_ids = read
                self.damaged_ids = set(damaged_ids)
                _log_damaged(scene_key, damaged_ids)

    def describable(self, entries: Entries) -> list[tuple[str, str]]:
        """Id and key of the entries that have no descriptor but may get one."""
        return [(reference_id, key) for reference_id, key in entries.undescribed() if key not in self.undescribable]

    def refresh(self, store: Store, scene_key: SceneKey, descriptor: str) -> Entries:
        with self.updating:
            since = self.index.generation
            changes = store.list_changes(scene_key, since if since >= 0 else None, descriptor)
            _log_damaged(scene_key, changes.damaged)
            if changes.is_whole:
                self.damaged_ids.clear()
            self.damaged_ids.difference_update(it.reference_id for it in changes.added)
            self.damaged_ids.update(changes.damaged)
            if changes.is_whole or changes.generation != since:
                self.index.apply(changes)
            return self.index.entries()


def _log_damaged(scene_key: SceneKey, reference_ids: Iterable[str]) -> None:
    message = "reference %s of scene %s is damaged in the store and is not chosen any more: delete it and add it again"
    for reference_id in reference_ids:
        log.error(message, reference_id, scene_key)
