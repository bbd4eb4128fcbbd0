"""Scenes in memory, to choose references by: read once, then kept up to date by what has changed."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Mapping

from .errors import NotFound
from .library import ReferenceLibrary
from .method.features import FeatureExtractor
from .retrieval.descriptor import GlobalDescriptor, Vector
from .retrieval.index import Entries, SceneIndex
from .store import Store
from .tenancy import SceneKey
from .turns import Turn

log = logging.getLogger(__name__)


class SceneIndexes:
    """Indexes of scenes, those used longest ago forgotten; safe to use from several threads."""

    def __init__(
        self,
        store: Store,
        library: ReferenceLibrary,
        descriptor: GlobalDescriptor,
        extractor: FeatureExtractor,
        capacity_bytes: int,
    ) -> None:
        """No index yet.

        Args:
            store: of the references.
            library: loads those that have no descriptor yet.
            descriptor: what the indexes hold.
            extractor: finds the features that it is made of.
            capacity_bytes: of all indexes; the scene used last is held however large it is.
        """
        self._store = store
        self._library = library
        self._descriptor = descriptor
        self._extractor = extractor
        self._capacity_bytes = capacity_bytes
        self._held: OrderedDict[SceneKey, _Held] = OrderedDict()
        self._lock = threading.Lock()

    def entries(self, scene_key: SceneKey, turn: Turn) -> Entries:
        """The references of a scene as it is now.

        Those without a descriptor are described now, one by one until the turn is over; what was done by then stays
        done.

        Raises:
            NotFound: there is no such scene (field "scene").
            Over: the turn is over.
            DataLoss: what is stored of a reference is damaged.
        """
        entries = self._refresh(scene_key)
        while undescribed := entries.undescribed():
            log.info("describing %d references of scene %s for retrieval", len(undescribed), scene_key)
            with turn.stage("describe"):
                for reference_id, key in undescribed:
                    self._describe(scene_key, reference_id, key, turn)
            entries = self._refresh(scene_key)
        return entries

    def _describe(self, scene_key: SceneKey, reference_id: str, key: str, turn: Turn) -> None:
        """Finds and keeps a reference's descriptor; nothing if it was deleted since."""
        turn.check()
        claims = self._library.claims
        with claims.claimed((key, self._descriptor.name)) as is_mine:
            if not is_mine:
                claims.wait((key, self._descriptor.name), turn.check)
                return
            try:
                _, (reference,) = self._library.load(scene_key, (reference_id,), self._extractor, Turn(turn.check))
                if reference.key != key:  # another one of the same name by now
                    return
                vector = self._descriptor.describe(reference.view)
                self._store.add_descriptor(key, self._descriptor.name, vector)
            except NotFound:
                return
        self._find(scene_key).describe({key: vector})

    def _refresh(self, scene_key: SceneKey) -> Entries:
        held = self._find(scene_key)
        try:
            entries = held.refresh(self._store, scene_key, self._descriptor.name)
        except Exception:
            # What cannot be brought up to date is not to be believed; and a scene that is gone takes no memory.
            self._forget(scene_key, held)
            raise
        self._make_room(scene_key)
        return entries

    @property
    def size_bytes(self) -> int:
        """What all indexes hold in memory."""
        with self._lock:
            return sum(held.index.size_bytes for held in self._held.values())

    def _find(self, scene_key: SceneKey) -> _Held:
        with self._lock:
            held = self._held.get(scene_key)
            if held is None:
                held = self._held[scene_key] = _Held(SceneIndex(self._descriptor.dimension))
            self._held.move_to_end(scene_key)
            return held

    def _forget(self, scene_key: SceneKey, held: _Held) -> None:
        with self._lock:
            if self._held.get(scene_key) is held:
                del self._held[scene_key]

    def _make_room(self, used: SceneKey) -> None:
        with self._lock:
            size_bytes = sum(held.index.size_bytes for held in self._held.values())
            for scene_key in list(self._held):
                if size_bytes <= self._capacity_bytes:
                    return
                if scene_key != used:
                    size_bytes -= self._held.pop(scene_key).index.size_bytes


class _Held:
    """An index and the lock of who brings it up to date."""

    def __init__(self, index: SceneIndex) -> None:
        self.index = index
        self._updating = threading.Lock()

    def refresh(self, store: Store, scene_key: SceneKey, descriptor: str) -> Entries:
        with self._updating:
            since = self.index.generation
            changes = store.list_changes(scene_key, since if since >= 0 else None, descriptor)
            for reference_id in changes.damaged:
                log.error(
                    "reference %s of scene %s is damaged in the store and is not chosen any more: delete it and add it "
                    "again",
                    reference_id,
                    scene_key,
                )
            if changes.is_whole or changes.generation != since:
                self.index.apply(changes)
            return self.index.entries()

    def describe(self, vectors: Mapping[str, Vector]) -> None:
        with self._updating:
            self.index.describe(vectors)
