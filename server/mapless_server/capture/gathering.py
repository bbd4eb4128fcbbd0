"""What a photograph was compared with, gathered from the store when its call has been answered."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

from mapless.names import parse_reference_name

from ..errors import DataLoss, NotFound
from ..query import Query, Result
from ..store import DescribedReference, ReferenceRecord, Store, codec
from ..tenancy import SceneKey, tenant_of
from .calls import CapturedPart, CapturedReference
from .folder import CaptureFolder

_REMEMBERED_VIEWS = 100_000


class Gone(Exception):
    """A reference that was used has been deleted since, so what was made of it is not to be kept either."""


class Gatherer:
    """Reads references from the store; what the folder has already is not read again. For one thread."""

    def __init__(self, store: Store, folder: CaptureFolder) -> None:
        self._store = store
        self._folder = folder
        self._views: dict[tuple[str, str], str] = {}  # blobs by the reference's key and the extractor's name

    def part(self, query: Query, result: Result, extractors: Sequence[str], blobs: dict[str, bytes]) -> CapturedPart:
        """What a photograph was compared with.

        Args:
            query: the photograph.
            result: what was made of it.
            extractors: names of all that the server has: a replay may try each of them.
            blobs: gets those that the folder lacks.

        Raises:
            Gone: a reference that was used was deleted meanwhile, or is another one by now.
            DataLoss: it is damaged.
            Unavailable: the store is not there.
        """
        attempt = result.attempt
        if attempt.choice is not None:
            wanted = {it.reference_id: it.key for it in attempt.choice.references}
        else:
            wanted = {parse_reference_name(it.name)[1]: it.key for it in attempt.references}
        references = self._references(query.scene_key, wanted, extractors, blobs)
        if not {it.key for it in attempt.references} <= {it.key for it in references}:
            raise Gone
        return CapturedPart(query.photo.field, attempt.generation, tuple(references), attempt.choice)

    def _references(
        self, scene_key: SceneKey, wanted: dict[str, str], extractors: Sequence[str], blobs: dict[str, bytes]
    ) -> list[CapturedReference]:
        views: dict[str, dict[str, str]] = {key: {} for key in wanted.values()}
        records: dict[str, ReferenceRecord] = {}
        for extractor in extractors:
            described, undescribed = self._load(scene_key, list(wanted), extractor)
            records |= {it.key: it for it in (*(one.record for one in described), *undescribed)}
            for one in described:
                if one.record.key in views:
                    views[one.record.key][extractor] = self._view(scene_key, one, extractor, blobs)
        for key in wanted.values():
            if key in records:
                self._image(scene_key, records[key], blobs)
        return [
            CapturedReference(it.reference_id, key, it.camera, it.world_from_camera, it.image_sha256, views[key])
            for key in wanted.values()
            if (it := records.get(key)) is not None
        ]

    def _load(
        self, scene_key: SceneKey, reference_ids: Sequence[str], extractor: str
    ) -> tuple[list[DescribedReference], list[ReferenceRecord]]:
        """References that have features of an extractor, and those that have none; without those that are not there."""
        try:
            snapshot = self._store.load_references(scene_key, reference_ids, extractor)
            return list(snapshot.references), list(snapshot.undescribed)
        except (NotFound, DataLoss) as error:
            if error.field == "scene" or len(reference_ids) <= 1:
                return [], []
        each = [self._load(scene_key, [it], extractor) for it in reference_ids]
        return [it for described, _ in each for it in described], [it for _, rest in each for it in rest]

    def _view(self, scene_key: SceneKey, described: DescribedReference, extractor: str, blobs: dict[str, bytes]) -> str:
        tenant, known = tenant_of(scene_key), (described.record.key, extractor)
        name = self._views.get(known)
        if name is None or not (name in blobs or self._folder.has_blob(tenant, name)):
            data = codec.encode_view(described.view)
            name = hashlib.sha256(data).hexdigest()
            blobs[name] = data
            if len(self._views) >= _REMEMBERED_VIEWS:
                self._views.clear()
            self._views[known] = name
        return name

    def _image(self, scene_key: SceneKey, record: ReferenceRecord, blobs: dict[str, bytes]) -> None:
        name = record.image_sha256
        if name in blobs or self._folder.has_blob(tenant_of(scene_key), name):
            return
        try:
            blobs[name] = self._store.read_image_of(record.key)
        except NotFound:
            raise Gone from None
