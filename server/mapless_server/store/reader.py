"""The reading half of the store, and what it caches."""

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import partial, wraps
from types import MappingProxyType
from typing import Any, Concatenate, NamedTuple, NoReturn, ParamSpec, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from sqlalchemy import Connection, Row, Select, Table, select

from mapless.depth import DepthImage
from mapless.geometry import Camera, RigidTransform
from mapless_server.cache import LruCache
from mapless_server.errors import AlreadyExists, NotFound, RequestError
from mapless_server.security import SceneKey

from . import codec, queries, rows, tables
from .alike import find_alike
from .attributes import SceneAttributes
from .changes import read_changes
from .database import DamagedPages, Database, unavailable, unless_damaged
from .records import DescribedReference, ReferenceRecord, SceneChanges, SceneRecord, SceneSnapshot, SceneState

P = ParamSpec("P")
T = TypeVar("T")

NO_LABELS: Mapping[str, str] = MappingProxyType({})
NAME_CACHE_BYTES = 16 * 2**20
NAME_BYTES = 300
"""About the size of a reference's id and key in memory."""
RECORD_BYTES = 700
"""About the size of a ReferenceRecord in memory, arrays and strings included."""
ATTRIBUTES_BYTES = 2000
"""About the size of SceneAttributes in memory."""

ALIKE_MOST = 10
"""References that are read of those with one image, or with one camera and pose: a sentence names fewer. All of them
would be the whole scene where a tracker gave every photograph its start. In a scene of 10,000 a search costs 0.6 ms of
processor time for one reference, and 0.3 for each of a hundred (`research.equal_references`)."""


UNWRITABLE = frozenset({"STORE_READ_ONLY", "STORE_FULL", "STORE_UNAVAILABLE"})
"""Reasons of faults after which the next change would most likely fail, too."""


class StoreObserver(Protocol):
    """Receives the store's events, in any thread that uses it; must return at once and never raise."""

    def stored(self, operation: str, seconds: float) -> None:
        """An operation ended, successfully or not."""

    def store_failed(self) -> None:
        """An operation failed by a fault that is not the caller's: damage, a full disk, a busy database."""


def observed(operation: Callable[Concatenate[Any, P], T]) -> Callable[Concatenate[Any, P], T]:
    """Decorator that reports a method of the store to its observer, under the method's name."""

    @wraps(operation)
    def wrapper(self: "StoreReader", /, *args: P.args, **kwargs: P.kwargs) -> T:
        start_s = time.monotonic()
        try:
            return operation(self, *args, **kwargs)
        except Exception as error:
            if self.observer is not None and not isinstance(error, NotFound | AlreadyExists):
                self.observer.store_failed()
            raise
        finally:
            if self.observer is not None:
                self.observer.stored(operation.__name__, time.monotonic() - start_s)

    return wrapper


class _Resolved(NamedTuple):
    """Keys of a scene's reference ids in a state of the store, with the scene in that state."""

    state: object
    scene: SceneState
    keys: tuple[str, ...]


class StoreReader:
    """Reads scenes and references; each method sees one moment of the database.

    The observer, if there is one, receives an event for every operation. `write_fault` says why the last change could
    not be written, one of `UNWRITABLE`; it is empty if it could. `reference_cache` is the cache of features.
    """

    def __init__(
        self, database: Database, described: LruCache[DescribedReference], name_cache_bytes: int = NAME_CACHE_BYTES
    ) -> None:
        self.database = database
        self.observer: StoreObserver | None = None
        self.write_fault = ""
        # By (key, extractor): references never change and keys are never reused, so no entry is ever stale.
        self.reference_cache = described
        # By scene key and ids. Where this process alone writes, an entry is valid until anything is written (`_state`),
        # and the database is not asked at all; where others write too, as long as the generation is the same.
        self._resolved: LruCache[_Resolved] = LruCache(name_cache_bytes)
        self._scenes: LruCache[tuple[object, SceneState]] = LruCache(name_cache_bytes)
        self._state = object()
        self._last_deletion = object()

    @contextmanager
    def changing(self) -> Iterator[Connection]:
        """A transaction that writes; invalidates the cached `_state`, however it ends."""
        try:
            with self.database.write() as connection:
                yield connection
            self.write_fault = ""
        except RequestError as error:
            if error.reason in UNWRITABLE:
                self.write_fault = error.reason
            raise
        finally:
            self._state = object()

    def check(self) -> None:
        """Raises RequestError while the store is away: calls that touch a scene would fail."""
        self.database.check()
        if self.write_fault == "STORE_UNAVAILABLE" and not self.database.is_shared:
            raise unavailable("the store's disk fails")

    @observed
    def get_scene(self, scene_key: SceneKey) -> SceneRecord:
        """Returns a scene; NotFound if there is no such scene; DataLoss if its attributes are damaged."""
        with self.database.read() as connection:
            return queries.read_scenes(connection, [queries.find_scene(connection, scene_key)])[0]

    @observed
    def get_generation(self, scene_key: SceneKey) -> int:
        """Generation of a scene, also if its attributes are damaged; raises NotFound."""
        with self.database.read() as connection:
            return queries.read_generation(connection, scene_key)

    @observed
    def get_attributes(self, scene_key: SceneKey) -> SceneAttributes:
        """Attributes of a scene, with its self-calibrations.

        They are cached if only this process writes, since every query needs them. NotFound if there is no such scene;
        DataLoss if the attributes are damaged.
        """
        state = self._state
        scene = self._known(scene_key, state)
        if scene is None:
            with self.database.read() as connection:
                scene = self._scene_state(connection, scene_key, state)
        return scene.attributes

    def _known(self, scene_key: SceneKey, state: object) -> SceneState | None:
        """The scene in this state from memory; None where it is not there, or others write, too."""
        cached = None if self.database.is_shared else self._scenes.get(scene_key)
        return cached[1] if cached is not None and cached[0] is state else None

    def _scene_state(self, connection: Connection, scene_key: SceneKey, state: object) -> SceneState:
        """The scene as the connection's transaction sees it, begun in a state; from memory if nothing has changed."""
        row, cached = queries.find_scene(connection, scene_key), self._scenes.get(scene_key)
        if cached is not None and cached[0] is state and cached[1].generation == row.generation:
            return cached[1]
        found = queries.find_calibrations(connection, scene_key)
        scene = SceneState(row.generation, row.create_time_us, partial(rows.answered_attributes, row, found))
        if not self.database.is_shared:
            self._scenes.put(scene_key, (state, scene), ATTRIBUTES_BYTES)
        return scene

    @observed
    def has_features(self, key: str, extractor: str) -> bool:
        """Whether a reference has features of this extractor; False if it was deleted."""
        with self.database.read() as connection:
            return queries.has_features(connection, key, extractor)

    @observed
    def get_reference(self, scene_key: SceneKey, reference_id: str) -> ReferenceRecord:
        """Returns a reference without its image.

        NotFound if there is no such scene or reference; DataLoss if its camera and pose are damaged.
        """
        with self.database.read() as connection:
            key = queries.find_key(connection, scene_key, reference_id)
            row = connection.execute(queries.select_references().where(tables.reference.c.key == key)).one()
        return rows.reference_record(row)

    @observed
    def read_image_of(self, key: str) -> bytes:
        """Reads the image's bytes as they were added, by the reference's key.

        NotFound if the reference was deleted; DataLoss if the bytes are damaged.
        """
        return self._read_file(key, tables.image)

    @observed
    def read_mask_of(self, key: str) -> bytes:
        """Reads the mask's bytes, empty if the reference has none; errors as of `read_image_of`."""
        return self._read_file(key, tables.mask)

    @observed
    def read_depth_of(self, key: str) -> DepthImage:
        """Reads the depth that was measured with a reference that has one; errors as of `read_image_of`."""
        return self._read_part(key, tables.depth, rows.depth_image)

    def _read_file(self, key: str, table: Table) -> bytes:
        return self._read_part(key, table, rows.file)

    def _read_part(self, key: str, table: Table, read: Callable[[Row[Any], str], T]) -> T:
        with self.database.read() as connection:
            row = unless_damaged(connection, lambda: queries.find_file(connection, key, table), lambda: None)
            if row is None:
                reference_id = queries.find_by_key(connection, key, tables.reference.c.reference_id).reference_id
                raise rows.data_loss(reference_id, table.name)
            return read(row, table.name)

    @observed
    def list_references(
        self,
        scene_key: SceneKey,
        limit: int,
        after: str = "",
        *,
        only_adopted: bool = False,
        only_retired: bool = False,
    ) -> list[ReferenceRecord]:
        """At most `limit` references of a scene, or of those, ordered by id, with ids greater than `after`.

        NotFound if there is no such scene; DataLoss if camera and pose of one of them are damaged.
        """
        statement, key = queries.select_references(), tables.reference.c.key
        if only_adopted:
            statement = statement.where(key.in_(select(tables.adopted_reference.c.reference_key)))
        if only_retired:
            statement = statement.where(queries.is_retired(key))
        found = self._read_page(statement, scene_key, limit, after)
        return [rows.reference_record(row) for row in found]

    @observed
    def list_alike(
        self, scene_key: SceneKey, images_sha256: Collection[str], posed: Sequence[tuple[Camera, RigidTransform]]
    ) -> list[ReferenceRecord]:
        """References with one of these images, or one of these cameras and poses; any `ALIKE_MOST` of each.

        Ordered by id. DataLoss if camera and pose of one of them are damaged.
        """
        geometries = {codec.encode_geometry(*it) for it in posed}
        found: dict[str, Row[Any]] = {}
        with self.database.read() as connection:
            for column, values in (("image_sha256", images_sha256), ("geometry", geometries)):
                alike = find_alike(connection, scene_key, column, list(values), ALIKE_MOST)
                found |= {row.reference_id: row for row in alike}
        return [rows.reference_record(found[it]) for it in sorted(found)]

    @observed
    def list_reference_ids(self, scene_key: SceneKey, limit: int, after: str = "") -> list[str]:
        """Ids of at most `limit` references, including damaged ones; NotFound if there is no such scene."""
        found = self._read_page(select(tables.reference.c.reference_id), scene_key, limit, after)
        return [row.reference_id for row in found]

    def list_with_depth(self, scene_key: SceneKey) -> list[str]:
        """Ids of the references with a measured depth, in the order of ids; empty if there is no such scene."""
        column = tables.reference.c
        statement = select(column.reference_id).where(column.scene_id == scene_key, column.depth_sha256.is_not(None))
        with self.database.read() as connection:
            return list(connection.execute(statement.order_by(column.reference_id)).scalars())

    def _read_page(self, statement: Select[Any], scene_key: SceneKey, limit: int, after: str) -> Sequence[Row[Any]]:
        column = tables.reference.c
        page = statement.where(column.scene_id == scene_key, column.reference_id > after)
        with self.database.read() as connection:
            queries.read_generation(connection, scene_key)
            return connection.execute(page.order_by(column.reference_id).limit(limit)).all()

    @observed
    def find_keys(self, scene_key: SceneKey, reference_ids: Sequence[str]) -> dict[str, str]:
        """Maps ids of existing references to keys, including those of damaged ones.

        NotFound if there is no such scene.
        """
        with self.database.read() as connection:
            queries.read_generation(connection, scene_key)
            return queries.find_keys(connection, scene_key, reference_ids)

    @observed
    def load_references(
        self, scene_key: SceneKey, reference_ids: Sequence[str] | None, extractor: str
    ) -> SceneSnapshot:
        """Loads references with their features, those without features, and the scene, all read at one moment.

        They are in the order of their ids' list; all, ordered by id, for None. References that were loaded before come
        from memory. NotFound if there is no such scene (field "scene") or reference (field "references[i]"); DataLoss
        if features, camera or pose of one of them are damaged.
        """
        state, last_deletion = self._state, self._last_deletion
        names = None if reference_ids is None else tuple(reference_ids)
        resolved = None if names is None else self._resolved.get((scene_key, names))
        cached: dict[str, DescribedReference | None] = {}  # each is looked up once: hits and misses are counted
        if resolved is not None and resolved.state is state and not self.database.is_shared:
            cached, snapshot = self._cached(resolved.keys, resolved.scene, extractor)
            if snapshot is not None:
                return snapshot
        with self.database.read() as connection:
            scene = self._scene_state(connection, scene_key, state)
            if resolved is not None and resolved.scene.generation == scene.generation and self.database.is_shared:
                cached, snapshot = self._cached(resolved.keys, scene, extractor)
                if snapshot is not None:
                    return snapshot
            key_of = queries.find_keys(connection, scene_key, reference_ids)
            reference_ids = list(key_of) if reference_ids is None else reference_ids
            for index, reference_id in enumerate(reference_ids):
                if reference_id not in key_of:
                    raise queries.reference_not_found(scene_key, reference_id, field=f"references[{index}]")
            wanted = [key_of[reference_id] for reference_id in reference_ids]
            cached |= {key: self.reference_cache.get((key, extractor)) for key in wanted if key not in cached}
            described = {key: it for key, it in cached.items() if it is not None}
            id_of = {key_of[it]: it for it in reference_ids}
            read = _read_features(connection, {key: id_of[key] for key in wanted if key not in described}, extractor)
            lacking = [key for key in wanted if key not in described and key not in read]
            undescribed = queries.rows_by_key(connection, lacking)
        if names is not None:
            size_bytes = NAME_BYTES * (1 + len(names))
            self._resolved.put((scene_key, names), _Resolved(state, scene, tuple(wanted)), size_bytes)
        for key, row in read.items():
            described[key] = rows.described_reference(row)
            self.reference_cache.put(
                (key, extractor), described[key], described[key].view.features.size_bytes + RECORD_BYTES
            )
        if self._last_deletion is not last_deletion:  # these may have been deleted, and dropped from the caches before
            self.reference_cache.forget(lambda key, _: key[0] in read)
            self._resolved.forget(lambda key, _: key == (scene_key, names))
            self._scenes.forget(lambda key, _: key == scene_key)
        return SceneSnapshot(
            scene,
            tuple(described[key] for key in wanted if key in described),
            tuple(rows.reference_record(undescribed[key]) for key in lacking),
        )

    @observed
    def load_descriptors(self, keys: Sequence[str], name: str) -> dict[str, NDArray[np.float32]]:
        """Loads the global descriptors (D,) that these references have under a name, undamaged ones, by their keys."""
        with self.database.read() as connection:
            found = unless_damaged(
                connection, partial(queries.descriptors_by_key, connection, keys, name), dict[str, Row[Any]]
            )
        return rows.descriptors(found, name)

    @observed
    def list_changes(self, scene_key: SceneKey, since_generation: int | None, descriptor_name: str) -> SceneChanges:
        """Reads what has changed in a scene since a generation, None for the whole scene, at one moment.

        Where only this process writes, the database is asked only after a change. NotFound if there is no such scene.
        """
        state = self._state
        scene = self._known(scene_key, state)
        if scene is not None and scene.generation == since_generation:
            return SceneChanges(since_generation, (), frozenset(), False)
        with self.database.read() as connection:
            self._scene_state(connection, scene_key, state)
            return read_changes(connection, scene_key, since_generation, descriptor_name)

    def _cached(
        self, keys: Sequence[str], scene: SceneState, extractor: str
    ) -> tuple[dict[str, DescribedReference | None], SceneSnapshot | None]:
        """The cached features of references, by key; also as a snapshot, if all of them are cached."""
        cached = {key: self.reference_cache.get((key, extractor)) for key in keys}
        found = tuple(it for it in map(cached.get, keys) if it is not None)
        return cached, SceneSnapshot(scene, found) if len(found) == len(keys) else None


def _read_features(connection: Connection, id_of: Mapping[str, str], extractor: str) -> dict[str, Row[Any]]:
    """Rows of `queries.features_by_key`, by key; raises DataLoss that names the first reference that cannot be read."""

    def read(keys: Sequence[str]) -> dict[str, Row[Any]]:
        return queries.features_by_key(connection, keys, extractor)

    def read_each() -> dict[str, Row[Any]]:
        found: dict[str, Row[Any]] = {}
        for key, reference_id in id_of.items():
            row = unless_damaged(connection, partial(read, [key]), lambda: None)
            if row is None:
                unless_damaged(connection, partial(queries.rows_by_key, connection, [key]), _raise_damaged)
                raise rows.data_loss(reference_id, "features")
            found |= row
        return found

    return unless_damaged(connection, lambda: read(list(id_of)), read_each) if id_of else {}


def _raise_damaged() -> NoReturn:
    """Raises DataLoss for a damaged table or index, where no single reference is damaged."""
    raise DamagedPages
