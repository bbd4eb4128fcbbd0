"""Scenes in memory, to choose references by: read once, then kept up to date by what has changed."""

from __future__ import annotations

import logging
import threading
from collections import OrderedDict
from collections.abc import Mapping

from mapless_server.errors import DataLoss, NotFound
from mapless_server.method.context import StageContext
from mapless_server.method.features import FeatureExtractor
from mapless_server.security.tenancy import SceneKey
from mapless_server.store import Store

from .library import ReferenceLibrary
from .retrieval.descriptor import GlobalDescriptor, Vector
from .retrieval.index import Entries, SceneIndex

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
        self._size_bytes = 0
        self._lock = threading.Lock()

    def entries(self, scene_key: SceneKey, context: StageContext) -> Entries:
        """The references of a scene as it is now.

        Those without a descriptor are described now, one by one until the turn is over; what was done by then stays
        done. One that cannot be described because it is damaged stays without.

        Raises:
            NotFound: there is no such scene (field "scene").
            Over: the turn is over.
        """
        # Whatever becomes of the scene meanwhile, this call goes on with what it has begun with.
        held = self._hold(scene_key)
        entries = self._refresh(scene_key, held)
        while undescribed := held.describable(entries):
            log.info("describing %d references of scene %s for retrieval", len(undescribed), scene_key)
            with context.stage("describe"):
                for reference_id, key in undescribed:
                    self._describe(scene_key, held, reference_id, key, context)
            entries = self._refresh(scene_key, held)
        return entries

    def forget(self, scene_key: SceneKey) -> None:
        """Takes no more memory for a scene, which has been deleted."""
        held = self._find(scene_key)
        if held is not None:
            self._forget(scene_key, held)

    def is_damaged(self, scene_key: SceneKey, reference_id: str) -> bool:
        """Whether a reference is in the scene, but not among its entries, since its pose or descriptor is damaged."""
        held = self._find(scene_key)
        if held is None or reference_id not in held.damaged_ids:
            return False
        try:
            self._store.get_reference(scene_key, reference_id)
        except DataLoss:
            return True
        except NotFound:  # its deletion was told by its key, which nobody knows of one that is damaged
            held.damaged_ids.discard(reference_id)
            return False
        return True

    def tell_damaged(self, scene_key: SceneKey, reference_id: str, error: Exception) -> None:
        """Logs, once while the scene is held, that a reference is not used because it is damaged."""
        held = self._find(scene_key)
        if held is None or reference_id not in held.told:
            if held is not None:
                held.told.add(reference_id)
            log.error("reference %s of scene %s is not used: %s", reference_id, scene_key, error)

    def _describe(self, scene_key: SceneKey, held: _Held, reference_id: str, key: str, context: StageContext) -> None:
        """Finds and keeps a reference's descriptor; nothing if it was deleted since."""
        context.check()
        claims = self._library.claims
        with claims.claimed((key, self._descriptor.name)) as is_mine:
            if not is_mine:
                claims.wait((key, self._descriptor.name), context.check)
                return
            try:
                _, (reference,) = self._library.load(
                    scene_key, (reference_id,), self._extractor, StageContext(context.check)
                )
                if reference.key != key:  # another one of the same name by now
                    return
                vector = self._descriptor.describe(reference.view)
                self._store.add_descriptor(key, self._descriptor.name, vector)
            except NotFound:
                return
            except DataLoss as error:
                held.undescribable.add(key)
                self.tell_damaged(scene_key, reference_id, error)
                return
        held.describe({key: vector})

    def _refresh(self, scene_key: SceneKey, held: _Held) -> Entries:
        try:
            entries = held.refresh(self._store, scene_key, self._descriptor.name)
        except Exception:
            # What cannot be brought up to date is not to be believed; and a scene that is gone takes no memory.
            self._forget(scene_key, held)
            raise
        self._make_room(scene_key, held)
        return entries

    @property
    def size_bytes(self) -> int:
        """What all indexes hold in memory."""
        with self._lock:
            return self._size_bytes

    def _find(self, scene_key: SceneKey) -> _Held | None:
        with self._lock:
            return self._held.get(scene_key)

    def _hold(self, scene_key: SceneKey) -> _Held:
        """What is held of a scene that is asked for, from now on at the latest."""
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
                self._size_bytes -= held.counted_bytes

    def _make_room(self, used: SceneKey, held: _Held) -> None:
        """Counts what the scene takes now, and forgets those used longest ago until there is room for it."""
        with self._lock:
            if self._held.get(used) is not held:
                return
            size_bytes = held.index.size_bytes
            self._size_bytes += size_bytes - held.counted_bytes
            held.counted_bytes = size_bytes
            while self._size_bytes > self._capacity_bytes and len(self._held) > 1:
                _, oldest = self._held.popitem(last=False)
                self._size_bytes -= oldest.counted_bytes


class _Held:
    """An index and the lock of who brings it up to date.

    Attributes:
        index: of the scene.
        counted_bytes: what it took when it was last counted.
        damaged_ids: of references that were left out of it; some may be deleted by now.
        undescribable: keys of references that were found damaged when they were to be described.
        told: ids of references that the log has been told of.
    """

    def __init__(self, index: SceneIndex) -> None:
        self.index = index
        self.counted_bytes = 0
        self.damaged_ids: set[str] = set()
        self.undescribable: set[str] = set()
        self.told: set[str] = set()
        self._updating = threading.Lock()

    def describable(self, entries: Entries) -> list[tuple[str, str]]:
        """Id and key of the entries that have no descriptor and may get one."""
        return [(reference_id, key) for reference_id, key in entries.undescribed() if key not in self.undescribable]

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
            if changes.is_whole:
                self.damaged_ids.clear()
            self.damaged_ids.difference_update(it.reference_id for it in changes.added)
            self.damaged_ids.update(changes.damaged)
            if changes.is_whole or changes.generation != since:
                self.index.apply(changes)
            return self.index.entries()

    def describe(self, vectors: Mapping[str, Vector]) -> None:
        with self._updating:
            self.index.describe(vectors)
