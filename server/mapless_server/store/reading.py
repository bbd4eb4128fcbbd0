"""The half of the store that reads it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import Any, NoReturn

from sqlalchemy import Connection, Row, select

from mapless_server.security.tenancy import SceneKey

from . import queries, rows, tables
from .base import Attributes, BaseStore, Resolved
from .changes import read_changes
from .damage import DamagedPages, unless_damaged
from .observed import observed
from .records import DescribedReference, ReferenceRecord, SceneAttributes, SceneChanges, SceneRecord, SceneSnapshot

NAME_BYTES = 300
"""About the size of a reference's id and key in memory."""
RECORD_BYTES = 700
"""About the size of a ReferenceRecord in memory, arrays and strings included."""
ATTRIBUTES_BYTES = 2000
"""The same of SceneAttributes."""


class ReadingStore(BaseStore):
    """Each method sees one moment of the database."""

    @observed
    def get_scene(self, scene_key: SceneKey) -> SceneRecord:
        """A scene.

        Raises:
            NotFound: there is no such scene.
            DataLoss: its attributes are damaged.
        """
        with self._database.read() as connection:
            return rows.scene_record(queries.find_scene(connection, scene_key))

    @observed
    def get_generation(self, scene_key: SceneKey) -> int:
        """Generation of a scene, of one whose attributes are damaged, too.

        Raises:
            NotFound: there is no such scene.
        """
        with self._database.read() as connection:
            return queries.read_generation(connection, scene_key)

    @observed
    def get_attributes(self, scene_key: SceneKey) -> SceneAttributes:
        """What is known of a scene as a whole: for every query, so from memory where this process alone writes.

        Raises:
            NotFound: there is no such scene.
            DataLoss: it is damaged.
        """
        state = self._state
        remembered = None if self._database.is_shared else self._attributes.get(scene_key)
        if remembered is not None and remembered.state is state:
            return remembered.attributes
        with self._database.read() as connection:
            row = queries.find_attributes(connection, scene_key)
        attributes = rows.scene_attributes(row)
        if not self._database.is_shared:
            self._attributes.put(scene_key, Attributes(state, attributes), ATTRIBUTES_BYTES)
        return attributes

    @observed
    def list_scenes(self, tenant: str, limit: int, after: str = "") -> list[SceneRecord]:
        """At most ``limit`` scenes of a tenant, by id, of those whose id is greater than ``after``.

        Raises:
            DataLoss: the attributes of one of them are damaged.
        """
        page = queries.select_scenes_of(tenant, after).limit(limit)
        with self._database.read() as connection:
            return [rows.scene_record(row) for row in connection.execute(page)]

    @observed
    def has_features(self, key: str, extractor: str) -> bool:
        """Whether a reference has features of this extractor; False if it was deleted."""
        with self._database.read() as connection:
            return queries.has_features(connection, key, extractor)

    @observed
    def get_reference(self, scene_key: SceneKey, reference_id: str) -> ReferenceRecord:
        """A reference without its image.

        Raises:
            NotFound: there is no such scene or reference.
            DataLoss: its camera and pose are damaged.
        """
        with self._database.read() as connection:
            key = queries.find_key(connection, scene_key, reference_id)
            row = connection.execute(select(tables.reference).where(tables.reference.c.key == key)).one()
        return rows.reference_record(row)

    @observed
    def read_image(self, scene_key: SceneKey, reference_id: str) -> bytes:
        """The image's bytes as they came.

        Raises:
            NotFound: there is no such scene or reference.
            DataLoss: the bytes are damaged.
        """
        with self._database.read() as connection:
            key = queries.find_key(connection, scene_key, reference_id)
            row = unless_damaged(connection, lambda: queries.find_image(connection, key), lambda: None)
        if row is None:
            raise rows.data_loss(reference_id, "image")
        return rows.image(row)

    @observed
    def read_image_of(self, key: str) -> bytes:
        """The image's bytes as they came, by the reference's key: the very image that a snapshot spoke of.

        Raises:
            NotFound: the reference was deleted.
            DataLoss: the bytes are damaged.
        """
        with self._database.read() as connection:
            row = unless_damaged(connection, lambda: queries.find_image(connection, key), lambda: None)
            if row is None:
                raise rows.data_loss(queries.find_reference_id(connection, key), "image")
        return rows.image(row)

    @observed
    def list_references(self, scene_key: SceneKey, limit: int, after: str = "") -> list[ReferenceRecord]:
        """At most ``limit`` references of a scene, by id, of those whose id is greater than ``after``.

        Raises:
            NotFound: there is no such scene.
            DataLoss: camera and pose of one of them are damaged.
        """
        column = tables.reference.c
        page = select(tables.reference).where(column.scene_id == scene_key, column.reference_id > after)
        with self._database.read() as connection:
            queries.read_generation(connection, scene_key)
            found = connection.execute(page.order_by(column.reference_id).limit(limit)).all()
        return [rows.reference_record(row) for row in found]

    @observed
    def list_reference_ids(self, scene_key: SceneKey, limit: int, after: str = "") -> list[str]:
        """The same ids alone, of damaged references too.

        Raises:
            NotFound: there is no such scene.
        """
        column = tables.reference.c
        page = select(column.reference_id).where(column.scene_id == scene_key, column.reference_id > after)
        with self._database.read() as connection:
            queries.read_generation(connection, scene_key)
            return list(connection.scalars(page.order_by(column.reference_id).limit(limit)))

    @observed
    def find_keys(self, scene_key: SceneKey, reference_ids: Sequence[str]) -> dict[str, str]:
        """Keys by id of those of these references that exist, damaged ones too.

        Raises:
            NotFound: there is no such scene.
        """
        with self._database.read() as connection:
            queries.read_generation(connection, scene_key)
            return queries.find_keys(connection, scene_key, reference_ids)

    @observed
    def load_references(
        self, scene_key: SceneKey, reference_ids: Sequence[str] | None, extractor: str
    ) -> SceneSnapshot:
        """References with their features, which of them have none, and the generation, all read at one moment.

        References that were loaded before come from memory.

        Args:
            scene_key: the scene.
            reference_ids: which references, in the order wanted; None for all, by id.
            extractor: whose features.

        Raises:
            NotFound: there is no such scene (field "scene") or reference (field "references[i]").
            DataLoss: features, camera or pose of one of them are damaged.
        """
        state, deletion = self._state, self._deletion
        names = None if reference_ids is None else tuple(reference_ids)
        resolved = None if names is None else self._resolved.get((scene_key, names))
        remembered: dict[str, DescribedReference | None] = {}  # each is asked for once: hits and misses are counted
        if resolved is not None and resolved.state is state and not self._database.is_shared:
            remembered, snapshot = self._recall(resolved, extractor)
            if snapshot is not None:
                return snapshot
        with self._database.read() as connection:
            generation = queries.read_generation(connection, scene_key)
            if resolved is not None and resolved.generation == generation and self._database.is_shared:
                remembered, snapshot = self._recall(resolved, extractor)
                if snapshot is not None:
                    return snapshot
            if reference_ids is None:
                keys = queries.list_keys(connection, scene_key)
                reference_ids = list(keys)
            else:
                keys = queries.find_keys(connection, scene_key, reference_ids)
            for index, reference_id in enumerate(reference_ids):
                if reference_id not in keys:
                    raise queries.reference_not_found(scene_key, reference_id, field=f"references[{index}]")
            wanted = [keys[reference_id] for reference_id in reference_ids]
            remembered |= {key: self._described.get((key, extractor)) for key in wanted if key not in remembered}
            described = {key: it for key, it in remembered.items() if it is not None}
            unknown = {key: reference_id for reference_id, key in keys.items() if key not in described}
            unknown = {key: unknown[key] for key in wanted if key in unknown}
            found = _features(connection, unknown, extractor)
            lacking = [key for key in wanted if key not in described and key not in found]
            undescribed = queries.rows_by_key(connection, lacking)
        if names is not None:
            size_bytes = NAME_BYTES * (1 + len(names))
            self._resolved.put((scene_key, names), Resolved(state, generation, tuple(wanted)), size_bytes)
        for key, row in found.items():
            described[key] = rows.described_reference(row)
            self._described.put((key, extractor), described[key], len(row.data) + RECORD_BYTES)
        if self._deletion is not deletion:  # perhaps of these, and who deleted them has had them forgotten already
            self._described.forget(lambda key, _: key[0] in found)
            self._resolved.forget(lambda key, _: key == (scene_key, names))
        return SceneSnapshot(
            generation,
            tuple(described[key] for key in wanted if key in described),
            tuple(rows.reference_record(undescribed[key]) for key in lacking),
        )

    @observed
    def list_changes(self, scene_key: SceneKey, since_generation: int | None, descriptor_name: str) -> SceneChanges:
        """What became of a scene since a generation, read at one moment.

        Args:
            scene_key: the scene.
            since_generation: the one that the caller knows; None for the whole scene.
            descriptor_name: whose global descriptors.

        Raises:
            NotFound: there is no such scene.
        """
        with self._database.read() as connection:
            return read_changes(connection, scene_key, since_generation, descriptor_name)

    def _recall(
        self, resolved: Resolved, extractor: str
    ) -> tuple[dict[str, DescribedReference | None], SceneSnapshot | None]:
        """What is remembered of references, by key, and all of it as a snapshot if it is all."""
        remembered = {key: self._described.get((key, extractor)) for key in resolved.keys}
        in_memory = tuple(it for it in map(remembered.get, resolved.keys) if it is not None)
        is_all = len(in_memory) == len(resolved.keys)
        return remembered, SceneSnapshot(resolved.generation, in_memory) if is_all else None


def _features(connection: Connection, ids: Mapping[str, str], extractor: str) -> dict[str, Row[Any]]:
    """Rows of `queries.features_by_key`, by key; DataLoss names the first of the references that cannot be read.

    Args:
        connection: its transaction is gone on with.
        ids: of the references, by their keys.
        extractor: whose features.
    """

    def read(keys: Sequence[str]) -> dict[str, Row[Any]]:
        return queries.features_by_key(connection, keys, extractor)

    def blame() -> dict[str, Row[Any]]:
        found: dict[str, Row[Any]] = {}
        for key, reference_id in ids.items():
            row = unless_damaged(connection, partial(read, [key]), lambda: None)
            if row is None:
                unless_damaged(connection, partial(queries.rows_by_key, connection, [key]), _blame_nobody)
                raise rows.data_loss(reference_id, "features")
            found |= row
        return found

    return unless_damaged(connection, lambda: read(list(ids)), blame) if ids else {}


def _blame_nobody() -> NoReturn:
    """It is not what belongs to one reference that is damaged, but where references are looked up."""
    raise DamagedPages
