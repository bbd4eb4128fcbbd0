"""The half of the store that changes it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from datetime import datetime, timezone
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, insert, select, update

from mapless.geodesy import Datum
from mapless.scenes import UNCHANGED, Calibration, UnchangedType, Vector
from mapless_server.errors import AlreadyExists, NotFound
from mapless_server.method.views import View
from mapless_server.security.tenancy import SceneKey, scene_id_of

from . import queries, removing, rows, tables
from .base import BaseStore
from .damage import DamagedPages
from .observed import observed
from .records import NewReference, ReferenceRecord, SceneAttributes, SceneRecord

GENERATIONS_REMEMBERED = 100_000
"""How far back `list_changes` knows what was deleted: some 10 MB a scene; who asks less often may read it all."""

NOTHING_KNOWN = SceneAttributes()


class ChangingStore(BaseStore):
    """Each method is one transaction, in others' eyes at least: all of it happens or nothing."""

    @observed
    def create_scene(self, scene_key: SceneKey, attributes: SceneAttributes = NOTHING_KNOWN) -> SceneRecord:
        """Create a scene without references.

        Raises:
            AlreadyExists: the id is taken.
        """
        now, scene = _now(), tables.scene
        with self._changing() as connection:
            generation = queries.raise_generation(connection, scene_key)
            if connection.scalar(select(scene.c.scene_id).where(scene.c.scene_id == scene_key)) is not None:
                raise AlreadyExists(f"scene {scene_id_of(scene_key)!r} exists already", field="scene_id")
            row = {"scene_id": scene_key, "create_time_us": rows.time_us(now), "first_generation": generation}
            connection.execute(insert(scene).values(row | rows.attributes_row(scene_key, attributes)))
            return rows.scene_record(queries.find_scene(connection, scene_key))

    @observed
    def update_scene(
        self,
        scene_key: SceneKey,
        *,
        datum: Datum | UnchangedType | None = UNCHANGED,
        down_in_world: Vector | UnchangedType | None = UNCHANGED,
        calibration: Calibration | UnchangedType | None = UNCHANGED,
    ) -> SceneRecord:
        """Change what is known of a scene as a whole; None forgets.

        If all three are given it works on what is damaged, too.

        Raises:
            NotFound: there is no such scene.
            DataLoss: what is to stay as it is is damaged.
            ContradictingDown: datum and down_in_world do not belong to the same world.
        """
        if isinstance(calibration, Calibration):
            calibration = replace(calibration, create_time=_now())
        given: dict[str, Any] = {"datum": datum, "down_in_world": down_in_world, "calibration": calibration}
        changes = {name: value for name, value in given.items() if value is not UNCHANGED}
        with self._changing() as connection:
            queries.begin_change(connection, scene_key)
            is_new = len(changes) == len(given)
            found = NOTHING_KNOWN if is_new else rows.scene_attributes(queries.find_attributes(connection, scene_key))
            row = rows.attributes_row(scene_key, replace(found, **changes))
            connection.execute(update(tables.scene).where(tables.scene.c.scene_id == scene_key).values(row))
            return rows.scene_record(queries.find_scene(connection, scene_key))

    @observed
    def delete_scene(self, scene_key: SceneKey) -> frozenset[str]:
        """Delete a scene and all its references.

        It is first gone, in one transaction, and then deleted, a portion at a time, so that nobody has to wait for it.
        What is left when we are cut off in between is deleted when the store is opened again, or by the next call of
        this method, for whichever scene.

        Returns:
            Keys of those of its references that were in memory.

        Raises:
            NotFound: there is no such scene, and nothing left of a deleted one.
            Overloaded: the disk is full. If the scene is gone all the same, something of it is left.
        """
        try:
            self._set_apart(scene_key)
        except NotFound:
            self._leftovers.delete()
            raise
        self._deletion = object()
        # Their keys are never used again, so that they would only keep room from others until they were forgotten.
        gone = self._described.forget(lambda _, it: it.record.scene_key == scene_key)
        self._resolved.forget(lambda key, _: key[0] == scene_key)
        self._attributes.forget(lambda key, _: key == scene_key)
        self._leftovers.delete()
        return frozenset(key for key, _ in gone)

    def _set_apart(self, scene_key: SceneKey) -> None:
        with self._changing() as connection:
            queries.begin_change(connection, scene_key)
            self._database.take_your_time(connection)
            removing.set_apart(connection, scene_key)

    @observed
    def add_references(self, scene_key: SceneKey, references: Sequence[NewReference]) -> list[ReferenceRecord]:
        """Add references, all or none, each with all its features and descriptors; one change of the scene.

        Returns:
            The new references in the order given.

        Raises:
            NotFound: there is no such scene.
            AlreadyExists: an id is taken or stands twice; the field is "requests[i].reference_id".
            ValueError: features are not float32, a number of a camera, pose or descriptor is not finite, no reference
                is given, or one without any features.
        """
        if not references:
            raise ValueError("no reference to add")
        now = _now()
        # Encoding takes milliseconds a reference, so it is done before the others who want to write have to wait.
        records = [rows.new_record(scene_key, new, now) for new in references]
        reference_rows = [rows.reference_row(record) for record in records]
        image_rows, features_rows, descriptor_rows = [], [], []
        for record, new in zip(records, references, strict=True):
            image_rows.append({"reference_key": record.key, "data": new.image})
            features_rows += [rows.features_row(record.key, *described) for described in new.views.items()]
            descriptor_rows += [rows.descriptor_row(record.key, *named) for named in new.descriptors.items()]
        with self._changing() as connection:
            generation = queries.begin_change(connection, scene_key, len(records))
            queries.refuse_taken_ids(connection, scene_key, [new.reference_id for new in references])
            connection.execute(insert(tables.reference), [row | {"generation": generation} for row in reference_rows])
            connection.execute(insert(tables.image), image_rows)
            connection.execute(insert(tables.features), features_rows)
            if descriptor_rows:
                connection.execute(insert(tables.global_descriptor), descriptor_rows)
        return records

    @observed
    def add_features(self, key: str, extractor: str, view: View) -> None:
        """Store what another extractor found in a reference's image; no change of the scene, see SceneRecord.

        Args:
            key: of the reference. An id would not do: by now it may be that of another image.
            extractor: whose features.
            view: processed camera and features.

        Raises:
            NotFound: the reference was deleted.
            AlreadyExists: the reference has features of this extractor.
            ValueError: features are not float32, or a number of the camera is not finite.
        """
        row = rows.features_row(key, extractor, view)
        with self._changing() as connection:
            reference_id = queries.hold_reference(connection, key).reference_id
            if not queries.insert_new(connection, tables.features, row):
                raise AlreadyExists(f"reference {reference_id!r} has features of {extractor!r} already")

    @observed
    def add_descriptor(self, key: str, name: str, vector: NDArray[np.float32]) -> None:
        """Store a global descriptor that a reference lacks; a change of its scene. One that is there already stays.

        Whoever has the scene in memory hears of it as of a reference that was added, see `list_changes`.

        Args:
            key: of the reference.
            name: of the global descriptor.
            vector: (D,), finite.

        Raises:
            NotFound: the reference was deleted.
            ValueError: it is no vector, or a number is not finite as float16.
        """
        row = rows.descriptor_row(key, name, vector)
        reference = tables.reference
        with self._database.read() as connection:
            scene_key = queries.find_scene_key(connection, key)
            if queries.has_descriptor(connection, key, name):
                return
        with self._changing() as connection:
            generation = queries.begin_change(connection, scene_key)
            queries.hold_reference(connection, key)
            if queries.insert_new(connection, tables.global_descriptor, row):
                connection.execute(update(reference).where(reference.c.key == key).values(generation=generation))

    @observed
    def delete_reference(self, scene_key: SceneKey, reference_id: str) -> str:
        """Delete a reference with its image and features; works on a damaged one, too, whose pages then stay lost.

        Returns:
            Its key.

        Raises:
            NotFound: there is no such scene or reference.
        """
        try:
            key = self._delete_reference(scene_key, reference_id, removing.remove)
        except DamagedPages:
            key = self._delete_reference(scene_key, reference_id, removing.set_aside)
        self._deletion = object()
        self._described.forget(lambda _, it: it.record.key == key)
        return key

    def _delete_reference(
        self, scene_key: SceneKey, reference_id: str, remove: Callable[[Connection, str], None]
    ) -> str:
        with self._changing() as connection:
            generation = queries.begin_change(connection, scene_key, -1)
            key = queries.find_key(connection, scene_key, reference_id)
            remove(connection, key)
            tombstone = {"scene_id": scene_key, "generation": generation, "reference_key": key}
            connection.execute(insert(tables.removed_reference).values(tombstone))
            queries.forget_removals(connection, scene_key, generation - GENERATIONS_REMEMBERED)
        return key

    @observed
    def try_writing(self) -> None:
        """Write what changes nothing, to see whether it can be written; raises as every change does if not."""
        version = tables.store_version
        with self._changing() as connection:
            connection.execute(update(version).values(schema_version=version.c.schema_version))


def _now() -> datetime:
    return datetime.now(timezone.utc)
