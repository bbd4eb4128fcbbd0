"""The store as other rooms use it: opening, reading and changing it."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, insert, select, update

from mapless.geodesy import Datum
from mapless.names import scene_name
from mapless.provenance import ADOPTED
from mapless.scenes import UNCHANGED, AdoptionPolicy, Calibration, UnchangedType, Vector
from mapless_server.cache import LruCache
from mapless_server.errors import AlreadyExists, DataLoss, NotFound, Overloaded
from mapless_server.method.features.views import View
from mapless_server.security import SceneKey, SceneLimit, scene_id_of

from . import changes, deletion, queries, rows, tables
from .attributes import SceneAttributes
from .database import DamagedPages, Database, with_room_to_delete
from .deletion import PendingDeletions
from .depth_images import encode_depth_image
from .reader import NAME_CACHE_BYTES, NO_LABELS, StoreReader, observed
from .records import (
    DescribedReference,
    GroupedScene,
    NamedScenes,
    NewReference,
    ReferenceRecord,
    Retirement,
    SceneRecord,
)
from .scene_groups import SceneGroups
from .sqlite import SqliteDatabase

DEFAULT_CACHE_BYTES = 512 * 2**20
"""About 1,900 references with 2048 SIFT features each; 0 reads the database every time."""

NO_ATTRIBUTES = SceneAttributes()


class Store(StoreReader):
    """Scenes and their references, in the database of a data folder or in one that several servers share.

    Thread-safe. Each method is one transaction: readers see all of a change or nothing. A scene's key includes its
    tenant; messages name it by its id, which is all that the tenant knows.

    DataLoss is raised if stored bytes are damaged; other references are still served, and the damaged
    one can be deleted. Unavailable is raised while the database is unreachable or busy; the next call tries again. A
    change that ends so may have been made: trying again then raises AlreadyExists.
    """

    def __init__(
        self, database: Database, described: LruCache[DescribedReference], name_cache_bytes: int = NAME_CACHE_BYTES
    ) -> None:
        super().__init__(database, described, name_cache_bytes)
        self._pending_deletions = PendingDeletions(database)
        self._groups = SceneGroups(database, name_cache_bytes)

    @staticmethod
    def open(data_dir: Path, cache_bytes: int = DEFAULT_CACHE_BYTES) -> Store:
        """Opens the store of a data folder, on a local disk that no other server uses; creates both if missing.

        At most `cache_bytes` of features are cached in memory. StoreError if the folder or the database cannot be used,
        with one sentence that says why; ValueError if `cache_bytes` is negative.
        """
        described: LruCache[DescribedReference] = LruCache(cache_bytes)
        return Store._resumed(SqliteDatabase.open(data_dir), described)

    @staticmethod
    def connect(database_url: str, cache_bytes: int = DEFAULT_CACHE_BYTES) -> Store:
        """Opens the store of a PostgreSQL database, which other servers may use, too; creates tables if missing.

        The URL is as in `PostgresqlDatabase.open`; at most `cache_bytes` of features are cached in memory. StoreError
        if the database cannot be reached or used, with one sentence that says why, without the password; ValueError if
        `cache_bytes` is negative.
        """
        from .postgresql import PostgresqlDatabase  # most stores are folders

        described: LruCache[DescribedReference] = LruCache(cache_bytes)
        return Store._resumed(PostgresqlDatabase.open(database_url), described)

    @staticmethod
    def _resumed(database: Database, described: LruCache[DescribedReference]) -> Store:
        store = Store(database, described)
        store._pending_deletions.resume()
        return store

    def uncached(self, cache_bytes: int = 0) -> Store:
        """The same database without caches, for reading what queries do not; the caches and their counts do not change.

        It is valid as long as this store, and need not be closed. Only features are written through it, which does not
        invalidate this store's caches. It may have a cache of features of its own, of `cache_bytes`.
        """
        return Store(self.database, LruCache(cache_bytes), name_cache_bytes=0)

    def close(self) -> None:
        """Releases the data folder; no call may be in progress or follow."""
        self._pending_deletions.close()
        self.database.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @observed
    def list_scenes(
        self,
        tenant: str,
        count: int,
        after: str = "",
        labels: Mapping[str, str] = NO_LABELS,
        limit: SceneLimit | None = None,
    ) -> list[SceneRecord]:
        """At most `count` scenes as of `find_scenes`, with ids greater than `after`.

        DataLoss if the attributes of one of them are damaged.
        """
        page = queries.select_scenes_of(tenant, after, labels, limit).limit(count)
        with self.database.read() as connection:
            return queries.read_scenes(connection, connection.execute(page).all())

    @observed
    def find_scenes(
        self, tenant: str, labels: Mapping[str, str] = NO_LABELS, limit: SceneLimit | None = None
    ) -> tuple[GroupedScene, ...]:
        """All scenes of a tenant with all these labels, within the limit if there is one; ordered by id, at one moment.

        Where only this process writes, the database is asked only after a change.
        """
        return self._groups.find(tenant, labels, limit, self._state)

    @observed
    def find_scenes_named(self, scene_keys: Sequence[SceneKey]) -> NamedScenes:
        """Up to 64 scenes by their keys, and the keys of those that do not exist, at one moment.

        Cached as of `find_scenes`. ValueError for more keys, or one that occurs twice.
        """
        return self._groups.find_named(scene_keys, self._state)

    @observed
    def find_within(self, tenant: str, scene_ids: Collection[str], limit: SceneLimit) -> frozenset[str]:
        """The ids of up to 64 that the limit names, or whose scenes have its labels; cached as of `find_scenes`."""
        return self._groups.find_within(tenant, scene_ids, limit, self._state)

    def recall_within(self, tenant: str, scene_ids: Collection[str], limit: SceneLimit) -> frozenset[str] | None:
        """`find_within` at once, in microseconds; None if the database must be asked."""
        return self._groups.recall_within(tenant, scene_ids, limit, self._state)

    @observed
    def create_scene(
        self,
        scene_key: SceneKey,
        attributes: SceneAttributes = NO_ATTRIBUTES,
        labels: Mapping[str, str] = NO_LABELS,
    ) -> SceneRecord:
        """Creates a scene without references; AlreadyExists if the id is taken."""
        now, scene = _now(), tables.scene
        with self.changing() as connection:
            generation = changes.raise_generation(connection, scene_key)
            if connection.scalar(select(scene.c.scene_id).where(scene.c.scene_id == scene_key)) is not None:
                scene_id = scene_id_of(scene_key)
                message = f"scene {scene_id!r} exists already"
                raise AlreadyExists(message, field="scene_id", resource=scene_name(scene_id))
            row = {"scene_id": scene_key, "create_time_us": rows.time_us(now), "first_generation": generation}
            connection.execute(insert(scene).values(row | rows.attributes_row(scene_key, attributes)))
            queries.replace_labels(connection, scene_key, labels)
            return queries.read_scenes(connection, [queries.find_scene(connection, scene_key)])[0]

    @observed
    def update_scene(
        self,
        scene_key: SceneKey,
        *,
        datum: Datum | UnchangedType | None = UNCHANGED,
        down_in_world: Vector | UnchangedType | None = UNCHANGED,
        calibration: Calibration | UnchangedType | None = UNCHANGED,
        arbitrary_unit: bool | UnchangedType = UNCHANGED,
        labels: Mapping[str, str] | UnchangedType = UNCHANGED,
        adoption: AdoptionPolicy | UnchangedType | None = UNCHANGED,
        limit: SceneLimit | None = None,
    ) -> SceneRecord:
        """Changes attributes of a scene, and all of its labels together; None deletes an attribute.

        Labels alone leave the generation as it is: nothing that is computed from a scene depends on them.
        Damaged attributes are replaced if datum, down_in_world and calibration are given; then the unit is the metre
        and nothing is adopted unless that is given. NotFound if there is no such scene; DataLoss if an attribute that
        is not given is damaged; ContradictingDown if datum and down_in_world do not belong to the same world;
        DatumWithoutMetres if there would be a datum, and an arbitrary unit; WrongRadius if the policy is wrong, or the
        unit changes without it. A scene that is not within the limit, if there is one, is not there.
        """
        if isinstance(calibration, Calibration):
            calibration = replace(calibration, create_time=_now())
        given: dict[str, Any] = {"datum": datum, "down_in_world": down_in_world, "calibration": calibration}
        replaces_damaged = UNCHANGED not in given.values()
        given |= {"arbitrary_unit": arbitrary_unit, "adoption": adoption}
        changed = {name: value for name, value in given.items() if value is not UNCHANGED}
        with self.changing() as connection:
            if changed or labels is UNCHANGED:
                changes.begin_change(connection, scene_key)
            else:
                changes.lock_changes(connection, scene_key)
            stored, found = queries.find_scene(connection, scene_key, limit), NO_ATTRIBUTES
            try:
                found = rows.scene_attributes(stored)
            except DataLoss:
                if not replaces_damaged:
                    raise
            row = rows.attributes_row(scene_key, found.changed(changed))
            connection.execute(update(tables.scene).where(tables.scene.c.scene_id == scene_key).values(row))
            if labels is not UNCHANGED:
                queries.replace_labels(connection, scene_key, labels)
            return queries.read_scenes(connection, [queries.find_scene(connection, scene_key)])[0]

    @observed
    def delete_scene(self, scene_key: SceneKey) -> frozenset[str]:
        """Deletes a scene and all its references; returns the keys of those that were cached in memory.

        The scene does not exist any more after one transaction. Its rows are then deleted in portions, so that other
        calls need not wait; if that is interrupted, it is completed when the store is opened again, or by the next call
        of this method. NotFound if there is no such scene; Overloaded if the disk is full, and the scene may be deleted
        all the same, with some of its rows left until there is room.
        """
        try:
            with_room_to_delete(self.database, lambda: self._detach_scene(scene_key))
        except NotFound:
            self._pending_deletions.run()
            raise
        self._last_deletion = object()
        # The keys are never used again; their entries would only take room until they are evicted.
        gone = self.reference_cache.forget(lambda _, it: it.record.scene_key == scene_key)
        self._resolved.forget(lambda key, _: key[0] == scene_key)
        self._scenes.forget(lambda key, _: key == scene_key)
        try:
            self._pending_deletions.run()
        except Overloaded:
            self._pending_deletions.try_again()
            raise
        return frozenset(key for key, _ in gone)

    def _detach_scene(self, scene_key: SceneKey) -> None:
        # To detach so many would take as long as to delete them.
        deletion.delete_counts_where(self.database, tables.scene_count.c.scene_id == scene_key)
        with self.changing() as connection:
            changes.begin_change(connection, scene_key)
            self.database.lift_limits(connection)
            deletion.detach_scene(connection, scene_key)

    @observed
    def add_references(
        self,
        scene_key: SceneKey,
        references: Sequence[NewReference],
        admit: Callable[[Connection], None] = lambda _: None,
    ) -> list[ReferenceRecord]:
        """Adds all of the references or none, each with all its features and descriptors, as one change of the scene.

        `admit` is called in the transaction, before anything is added, and may raise.

        Returns the new references in the order given. NotFound if there is no such scene; AlreadyExists if an id is
        taken or occurs twice (field "requests[i].reference_id"); ValueError if features are not float32, a number of a
        camera, pose or descriptor is not finite, no reference is given, or one without any features.
        """
        if not references:
            raise ValueError("references must have at least one item")
        now = _now()
        # Encoding takes milliseconds per reference, so it is done before other writers have to wait.
        records = [rows.new_record(scene_key, new, now) for new in references]
        reference_rows = [rows.reference_row(record) for record in records]
        image_rows, mask_rows, depth_rows, features_rows, descriptor_rows, adopted_rows = [], [], [], [], [], []
        for record, new in zip(records, references, strict=True):
            image_rows.append({"reference_key": record.key, "data": new.image})
            features_rows += [rows.features_row(record.key, *described) for described in new.views.items()]
            if new.mask:
                mask_rows.append({"reference_key": record.key, "data": new.mask})
            if new.depth is not None:
                depth_rows.append({"reference_key": record.key, "data": encode_depth_image(new.depth)})
            descriptor_rows += [rows.descriptor_row(record.key, *named) for named in new.descriptors.items()]
            if new.provenance.source == ADOPTED:
                adopted_rows.append(rows.adopted_row(record, new))
        with self.changing() as connection:
            generation = changes.begin_change(connection, scene_key, len(records))
            admit(connection)
            queries.refuse_taken_ids(connection, scene_key, [new.reference_id for new in references])
            connection.execute(insert(tables.reference), [row | {"generation": generation} for row in reference_rows])
            connection.execute(insert(tables.image), image_rows)
            connection.execute(insert(tables.features), features_rows)
            if mask_rows:
                connection.execute(insert(tables.mask), mask_rows)
            if depth_rows:
                connection.execute(insert(tables.depth), depth_rows)
            if descriptor_rows:
                connection.execute(insert(tables.global_descriptor), descriptor_rows)
            if adopted_rows:
                connection.execute(insert(tables.adopted_reference), adopted_rows)
        return records

    @observed
    def add_features(self, key: str, extractor: str, view: View) -> None:
        """Stores another extractor's features of a reference's image; not a change of the scene, see SceneRecord.

        The key is the reference's, whose id may now be that of another image. NotFound if the reference was deleted;
        AlreadyExists if it has features of this extractor; ValueError if features are not float32, or a number of the
        camera is not finite.
        """
        row = rows.features_row(key, extractor, view)
        with self.changing() as connection:
            reference_id = queries.lock_reference(connection, key).reference_id
            is_there = queries.has_features(connection, key, extractor)
            if is_there or not queries.insert_new(connection, tables.features, row):
                raise AlreadyExists(f"reference {reference_id!r} has features of {extractor!r} already")

    @observed
    def add_descriptor(self, key: str, name: str, vector: NDArray[np.float32]) -> None:
        """Stores a global descriptor (D,) that a reference lacks, and keeps an existing one.

        It is not a change of the scene, see SceneRecord: `load_descriptors` finds it. NotFound if the reference was
        deleted; ValueError if the descriptor is not a vector, or a number is not finite as float16.
        """
        row = rows.descriptor_row(key, name, vector)
        with self.database.read() as connection:  # one that is gone waits for no writer, which may be its deletion
            queries.find_by_key(connection, key, tables.reference.c.scene_id)
        with self.changing() as connection:
            queries.lock_reference(connection, key)
            queries.insert_new(connection, tables.global_descriptor, row)

    @observed
    def delete_reference(self, scene_key: SceneKey, reference_id: str) -> str:
        """Deletes a reference with its image and features, also a damaged one, whose pages are then lost.

        Returns its key. NotFound if there is no such scene or reference; Overloaded if the disk is full.
        """

        def delete() -> str:
            try:
                return self._delete_reference(scene_key, reference_id, deletion.delete_references)
            except DamagedPages:
                return self._delete_reference(scene_key, reference_id, deletion.move_aside)

        key = with_room_to_delete(self.database, delete)
        self.forget_deleted([key])
        return key

    def forget_deleted(self, keys: Collection[str]) -> None:
        """Frees the memory of references that have been deleted."""
        self._last_deletion = object()
        self.reference_cache.forget(lambda _, it: it.record.key in keys)

    def _delete_reference(
        self, scene_key: SceneKey, reference_id: str, delete: Callable[[Connection, str], None]
    ) -> str:
        with self.changing() as connection:
            generation = changes.begin_change(connection, scene_key, -1)
            key = queries.find_key(connection, scene_key, reference_id)
            delete(connection, key)
            changes.note_removals(connection, scene_key, generation, [key])
        return key

    @observed
    def list_retirements(self, scene_key: SceneKey, reference_ids: Sequence[str]) -> dict[str, Retirement]:
        """Since when and why references of a scene are retired, by id, in the order of ids."""
        column, standing = tables.reference.c, tables.reference_standing.c
        is_wanted = column.reference_id.in_(reference_ids) & standing.retire_time_us.is_not(None)
        retired = queries.select_references().where(column.scene_id == scene_key, is_wanted)
        with self.database.read() as connection:
            found = connection.execute(retired.order_by(column.reference_id)).all()
        return {it.reference_id: why for it in found if (why := rows.retirement(it)) is not None}

    @observed
    def try_writing(self) -> None:
        """Writes without changing anything; raises as every change does if the store cannot be written."""
        with self.changing() as connection:
            connection.execute(update(it := tables.store_version).values(schema_version=it.c.schema_version))


def _now() -> datetime:
    return datetime.now(timezone.utc)
