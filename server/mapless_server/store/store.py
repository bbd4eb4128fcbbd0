"""The store: what the service calls. Every public method is one transaction, and safe from any thread."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from pathlib import Path
from types import TracebackType

from sqlalchemy import Connection, delete, insert, select

from mapless_server.errors import AlreadyExists
from mapless_server.method.views import View
from mapless_server.store import queries, rows, tables
from mapless_server.store.cache import LruCache
from mapless_server.store.observed import StoreObserver, Unobserved, observed
from mapless_server.store.records import (
    DescribedReference,
    NewReference,
    ReferencePose,
    ReferenceRecord,
    SceneRecord,
    SceneSnapshot,
)
from mapless_server.store.sqlite import SqliteDatabase
from mapless_server.tenancy import SceneKey, scene_id_of

DEFAULT_CACHE_BYTES = 512 * 2**20
"""About 500 references with 2048 SIFT features each; 0 reads the database every time."""

POSE_CACHE_BYTES = 32 * 2**20
NAME_CACHE_BYTES = 16 * 2**20
NAME_BYTES = 300
"""About the size of a reference's id and key in memory."""
POSE_BYTES = 700
"""About the size of a ReferencePose in memory, arrays and strings included."""


class Store:
    """Scenes and their references, in one database of a data folder.

    A scene's key says whose it is. Answers and messages name it by its id, which is all that its tenant knows.

    DataLoss is raised wherever stored bytes turn out not to be what was stored; other references are still served, and
    the damaged one can be deleted.

    Attributes:
        observer: hears of every operation.
    """

    def __init__(self, database: SqliteDatabase, described: LruCache[DescribedReference]) -> None:
        self._database = database
        self.observer: StoreObserver = Unobserved()
        # By (key, extractor): references never change and keys are never reused, so no entry is ever stale.
        self._described = described
        # By (scene_key, generation), which are never reused either.
        self._poses: LruCache[tuple[ReferencePose, ...]] = LruCache(POSE_CACHE_BYTES)
        # What names meant, by scene and names, as long as nothing was written since: this process alone writes.
        self._resolved: LruCache[_Resolved] = LruCache(NAME_CACHE_BYTES)
        self._state = object()

    @staticmethod
    def open(data_dir: Path, cache_bytes: int = DEFAULT_CACHE_BYTES) -> Store:
        """Open the store of a data folder; creates both if missing.

        Args:
            data_dir: a folder on a local disk that no other server uses.
            cache_bytes: bound of the features held in memory, 0 or more.

        Raises:
            StoreError: the folder or the database cannot be used, with one sentence that says why.
            ValueError: cache_bytes is negative.
        """
        described: LruCache[DescribedReference] = LruCache(cache_bytes)
        return Store(SqliteDatabase.open(data_dir), described)

    @property
    def reference_cache(self) -> LruCache[DescribedReference]:
        """The features held in memory."""
        return self._described

    def close(self) -> None:
        """Release the data folder; no call may be in progress or follow."""
        self._database.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    @contextmanager
    def _changing(self) -> Iterator[Connection]:
        """A transaction that writes; what is remembered of before is void when it is over, however it ends."""
        try:
            with self._database.write() as connection:
                yield connection
        finally:
            self._state = object()

    @observed
    def create_scene(self, scene_key: SceneKey) -> SceneRecord:
        """Create an empty scene.

        Raises:
            AlreadyExists: the id is taken.
        """
        scene, generation = tables.scene, tables.scene_generation
        with self._changing() as connection:
            if not queries.raise_generation(connection, scene_key):
                connection.execute(insert(generation).values(scene_id=scene_key, generation=1))
            if connection.scalar(select(scene.c.scene_id).where(scene.c.scene_id == scene_key)) is not None:
                raise AlreadyExists(f"scene {scene_id_of(scene_key)!r} exists already", field="scene_id")
            connection.execute(insert(scene).values(scene_id=scene_key, create_time_us=rows.time_us(_now())))
            return rows.scene_record(queries.find_scene(connection, scene_key))

    @observed
    def get_scene(self, scene_key: SceneKey) -> SceneRecord:
        """A scene.

        Raises:
            NotFound: there is no such scene.
        """
        with self._database.read() as connection:
            return rows.scene_record(queries.find_scene(connection, scene_key))

    @observed
    def list_scenes(self, tenant: str, limit: int, after: str = "") -> list[SceneRecord]:
        """At most ``limit`` scenes of a tenant, by id, of those whose id is greater than ``after``."""
        page = queries.select_scenes_of(tenant, after).limit(limit)
        with self._database.read() as connection:
            return [rows.scene_record(row) for row in connection.execute(page)]

    @observed
    def delete_scene(self, scene_key: SceneKey) -> None:
        """Delete a scene and all its references.

        Raises:
            NotFound: there is no such scene.
        """
        with self._changing() as connection:
            queries.begin_change(connection, scene_key)
            connection.execute(delete(tables.scene).where(tables.scene.c.scene_id == scene_key))

    @observed
    def add_references(self, scene_key: SceneKey, references: Sequence[NewReference]) -> list[ReferenceRecord]:
        """Add references, all or none, each with the features of all its extractors; one change of the scene.

        Returns:
            The new references in the order given.

        Raises:
            NotFound: there is no such scene.
            AlreadyExists: an id is taken or stands twice; the field is "requests[i].reference_id".
            ValueError: features are not float32, a number of a camera or pose is not finite, no reference is given, or
                one without any features.
        """
        if not references:
            raise ValueError("no reference to add")
        now = _now()
        # Encoding takes milliseconds a reference, so it is done before the others who want to write have to wait.
        records = [rows.new_record(scene_key, new, now) for new in references]
        reference_rows = [rows.reference_row(record) for record in records]
        image_rows, features_rows = [], []
        for record, new in zip(records, references, strict=True):
            image_rows.append({"reference_key": record.key, "data": new.image})
            features_rows += [rows.features_row(record.key, *described) for described in new.views.items()]
        with self._changing() as connection:
            queries.begin_change(connection, scene_key)
            queries.refuse_taken_ids(connection, scene_key, [new.reference_id for new in references])
            connection.execute(insert(tables.reference), reference_rows)
            connection.execute(insert(tables.image), image_rows)
            connection.execute(insert(tables.features), features_rows)
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
            reference_id = queries.find_id(connection, key)
            if queries.has_features(connection, key, extractor):
                raise AlreadyExists(f"reference {reference_id!r} has features of {extractor!r} already")
            connection.execute(insert(tables.features).values(row))

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
            row = queries.find_image(connection, queries.find_key(connection, scene_key, reference_id))
        return rows.image(row)

    @observed
    def read_image_of(self, key: str) -> bytes:
        """The image's bytes as they came, by the reference's key: the very image that a snapshot spoke of.

        Raises:
            NotFound: the reference was deleted.
            DataLoss: the bytes are damaged.
        """
        with self._database.read() as connection:
            row = queries.find_image(connection, key)
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
    def delete_reference(self, scene_key: SceneKey, reference_id: str) -> None:
        """Delete a reference with its image and features; works on a damaged one, too.

        Raises:
            NotFound: there is no such scene or reference.
        """
        with self._changing() as connection:
            queries.begin_change(connection, scene_key)
            key = queries.find_key(connection, scene_key, reference_id)
            connection.execute(delete(tables.reference).where(tables.reference.c.key == key))

    @observed
    def list_poses(self, scene_key: SceneKey) -> tuple[int, tuple[ReferencePose, ...]]:
        """The scene's generation and the poses of all its references, by id; from memory when nothing has changed.

        Raises:
            NotFound: there is no such scene.
            DataLoss: camera and pose of a reference are damaged.
        """
        column = tables.reference.c
        with self._database.read() as connection:
            generation = queries.read_generation(connection, scene_key)
            poses = self._poses.get((scene_key, generation))
            if poses is not None:
                return generation, poses
            statement = select(tables.reference).where(column.scene_id == scene_key).order_by(column.reference_id)
            found = connection.execute(statement).all()
        records = [rows.reference_record(row) for row in found]
        poses = tuple(ReferencePose(it.reference_id, it.key, it.world_from_camera) for it in records)
        self._poses.put((scene_key, generation), poses, POSE_BYTES * len(poses))
        return generation, poses

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
        state = self._state
        resolved = None if reference_ids is None else self._resolved.get((scene_key, tuple(reference_ids)))
        remembered: dict[str, DescribedReference | None] = {}  # each is asked for once: hits and misses are counted
        if resolved is not None and resolved.state is state:
            remembered = {key: self._described.get((key, extractor)) for key in resolved.keys}
            in_memory = tuple(it for it in map(remembered.get, resolved.keys) if it is not None)
            if len(in_memory) == len(resolved.keys):
                return SceneSnapshot(resolved.generation, in_memory, ())
        with self._database.read() as connection:
            generation = queries.read_generation(connection, scene_key)
            names = None if reference_ids is None else tuple(reference_ids)
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
            found = queries.features_by_key(connection, [key for key in wanted if key not in described], extractor)
            lacking = [key for key in wanted if key not in described and key not in found]
            undescribed = queries.rows_by_key(connection, lacking)
        if names is not None:
            size_bytes = NAME_BYTES * (1 + len(names))
            self._resolved.put((scene_key, names), _Resolved(state, generation, tuple(wanted)), size_bytes)
        for key, row in found.items():
            described[key] = rows.described_reference(row)
            self._described.put((key, extractor), described[key], len(row.data) + POSE_BYTES)
        return SceneSnapshot(
            generation,
            tuple(described[key] for key in wanted if key in described),
            tuple(rows.reference_record(undescribed[key]) for key in lacking),
        )


@dataclass(frozen=True)
class _Resolved:
    """What a scene's reference ids meant while the store was in a state."""

    state: object
    generation: int
    keys: tuple[str, ...]


def _now() -> datetime:
    return datetime.now(timezone.utc)
