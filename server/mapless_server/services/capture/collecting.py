"""Reads the references that a photograph was compared with from the store, after its call has been answered."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from mapless.names import parse_reference_name
from mapless_server.engine.query import Query, Result
from mapless_server.errors import DataLoss, NotFound
from mapless_server.scenes import Choice
from mapless_server.security import SceneKey, tenant_of
from mapless_server.store import ReferenceRecord, SceneRecord, Store, codec

from .calls import CapturedPart, CapturedReference
from .folder import CaptureFolder

_REMEMBERED = 100_000


class ReferencesDeleted(Exception):
    """A reference that was used has been deleted since, so its call must not be captured."""


@dataclass(frozen=True, eq=False)
class UsedReferences:
    """The references that a photograph was compared with, by key only, so that a queued call needs little memory.

    `used` are the keys of the references that the answer was computed from, `wanted` those, by id, of the references
    that were named or ranked. Field, generation and choices are as of `CapturedPart`.
    """

    field: str
    generation: int
    used: frozenset[str]
    wanted: Mapping[str, str]
    choices: tuple[Choice, ...]


def used_references(query: Query, result: Result) -> UsedReferences:
    """Extracts what an answered photograph was compared with."""
    choices = () if result.choice is None else (result.choice, *result.other_choices)
    wanted = {it.reference_id: it.key for choice in choices for it in choice.references}
    if not choices:
        wanted = {parse_reference_name(it.name)[1]: it.key for it in result.references}
    used = frozenset(it.key for it in result.references)
    return UsedReferences(query.photo.field, result.generation, used, wanted, choices)


class Collector:
    """Reads references from the store, except what the folder has already; for use by one thread."""

    def __init__(self, store: Store, folder: CaptureFolder) -> None:
        """Uses a store that is `uncached`, since the cache is for the references of queries."""
        self._store = store
        self._folder = folder
        self._records: dict[str, ReferenceRecord] = {}  # by key; references never change
        self._views: dict[tuple[str, str], str] = {}  # blobs by the reference's key and the extractor's name

    def part(
        self, scene: SceneRecord, used: UsedReferences, extractors: Sequence[str], blobs: dict[str, bytes]
    ) -> CapturedPart:
        """Reads what a photograph was compared with; `blobs` receives the blobs that the folder lacks.

        The extractors are all of the server's, since a replay may use each of them. ReferencesDeleted if a reference
        that was used was deleted or replaced meanwhile, or none was used and the scene has changed, so that it may be
        another scene of the same name; DataLoss if a reference is damaged; Unavailable if the store cannot be read.
        """
        if not used.used and used.generation != scene.generation:
            raise ReferencesDeleted
        wanted = dict(used.wanted)
        read_at = {used.generation, *(it.generation for it in used.choices)}
        if read_at != {scene.generation}:
            current = self._store.find_keys(scene.scene_key, list(wanted))
            wanted = {it: key for it, key in wanted.items() if current.get(it) == key}
        if max(len(self._records), len(self._views)) > _REMEMBERED:
            self._records.clear()
            self._views.clear()
        for extractor in extractors:
            self._read(scene.scene_key, wanted, extractor, blobs)
        known = {key: self._records[key] for key in wanted.values() if key in self._records}
        if not used.used <= known.keys():
            raise ReferencesDeleted
        for record in known.values():
            self._file(record, record.image_sha256, self._store.read_image_of, blobs)
            if record.mask_sha256:
                self._file(record, record.mask_sha256, self._store.read_mask_of, blobs)
        references = [
            CapturedReference(
                it.reference_id,
                key,
                it.camera,
                it.world_from_camera,
                it.image_sha256,
                {name: self._views[key, name] for name in extractors if (key, name) in self._views},
                it.mask_sha256,
            )
            for key, it in known.items()
        ]
        return CapturedPart(used.field, used.generation, tuple(references), used.choices)

    def _read(self, scene_key: SceneKey, wanted: Mapping[str, str], extractor: str, blobs: dict[str, bytes]) -> None:
        """Reads an extractor's features that exist and whose blobs are missing."""
        tenant = tenant_of(scene_key)

        def has_blob(key: str) -> bool:
            name = self._views.get((key, extractor))
            return name is not None and (name in blobs or self._folder.has_blob(tenant, name))

        missing = [reference_id for reference_id, key in wanted.items() if not has_blob(key)]
        for reference_id in missing:
            self._views.pop((wanted[reference_id], extractor), None)
        self._load(scene_key, missing, extractor, blobs)

    def _load(self, scene_key: SceneKey, reference_ids: Sequence[str], extractor: str, blobs: dict[str, bytes]) -> None:
        """Loads all references together; if one is damaged or deleted, one by one."""
        if not reference_ids:
            return
        try:
            snapshot = self._store.load_references(scene_key, reference_ids, extractor)
        except (NotFound, DataLoss) as error:
            if error.field != "scene" and len(reference_ids) > 1:
                for it in reference_ids:
                    self._load(scene_key, [it], extractor, blobs)
            return
        for one in snapshot.references:
            data = codec.encode_view(one.view)
            name = hashlib.sha256(data).hexdigest()
            if not self._folder.has_blob(tenant_of(scene_key), name):
                blobs[name] = data
            self._views[one.record.key, extractor] = name
        for record in (*(it.record for it in snapshot.references), *snapshot.undescribed):
            self._records[record.key] = record

    def _file(self, record: ReferenceRecord, name: str, read: Callable[[str], bytes], blobs: dict[str, bytes]) -> None:
        if name in blobs or self._folder.has_blob(tenant_of(record.scene_key), name):
            return
        try:
            blobs[name] = read(record.key)
        except NotFound:
            raise ReferencesDeleted from None
