"""Reading a large scene for its index, in portions, so that it need not be in memory at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import Connection, Select, and_, func, select

from mapless_server.security import SceneKey

from . import rows, tables
from .database import Database, unless_damaged
from .queries import all_rows, find_scene, is_retired
from .records import IndexedReference


@dataclass(frozen=True, eq=False)
class IndexedPortion:
    """Some references of a scene, in the order of their ids.

    Attributes:
        references: those that are intact.
        damaged: ids of those whose pose or descriptor is damaged.
        last_id: the last id, after which the next portion begins; empty if no reference follows.
    """

    references: tuple[IndexedReference, ...]
    damaged: tuple[str, ...]
    last_id: str


@dataclass(frozen=True, eq=False)
class IndexState:
    """The state of a scene that an index is compared with, read at one moment.

    Attributes:
        create_time_us: when the scene was created, microseconds since 1970.
        generation, reference_count: of the scene at that moment, without retired references.
        last_change: key of the reference that was added or deleted last until the wanted generation; empty if none is
            known. Another history of the scene, as after its database was replaced by a backup, has another one.
    """

    create_time_us: int
    generation: int
    reference_count: int
    last_change: str


class IndexReader:
    """Reads scenes for their indexes; each method sees one moment."""

    def __init__(self, database: Database) -> None:
        self._database = database

    def read_portion(self, scene_key: SceneKey, after_id: str, count: int, descriptor_name: str) -> IndexedPortion:
        """Reads at most `count` references with ids greater than `after_id`, with the descriptors of a name.

        Without those that are retired.
        """
        with self._database.read() as connection:
            return _read_portion(connection, scene_key, after_id, count, descriptor_name)

    def count(self, scene_key: SceneKey) -> int:
        """Number of references of a scene; 0 if there is no such scene."""
        counted = select(tables.scene.c.reference_count).where(tables.scene.c.scene_id == scene_key)
        with self._database.read() as connection:
            return connection.scalar(counted) or 0

    def read_state(self, scene_key: SceneKey, until_generation: int | None = None) -> IndexState:
        """Reads the state; the last change is that until a generation, None for all. NotFound if there is no scene."""
        with self._database.read() as connection:
            return _read_state(connection, scene_key, until_generation)


def _read_portion(
    connection: Connection, scene_key: SceneKey, after_id: str, count: int, descriptor_name: str
) -> IndexedPortion:
    column, descriptor = tables.reference.c, tables.global_descriptor.c
    is_wanted = and_(column.scene_id == scene_key, column.reference_id > after_id, ~is_retired(column.key))
    chosen = select(column.reference_id, column.key).where(is_wanted)
    found = all_rows(connection, chosen.order_by(column.reference_id).limit(count))
    if not found:
        return IndexedPortion((), (), "")
    indexed: Select[Any] = select(
        column.reference_id, column.key, column.geometry, column.geometry_sha256, descriptor.data, descriptor.sha256
    ).outerjoin(
        tables.global_descriptor, and_(descriptor.reference_key == column.key, descriptor.name == descriptor_name)
    )
    of_scene = indexed.where(is_wanted, column.reference_id <= found[-1].reference_id).order_by(column.reference_id)

    def read_each() -> list[Any]:
        each = (partial(all_rows, connection, indexed.where(column.key == it.key)) for it in found)
        return [row for one in each for row in unless_damaged(connection, one, lambda: ())]

    read = unless_damaged(connection, lambda: list(all_rows(connection, of_scene)), read_each)
    references, _ = rows.indexed_references(read, descriptor_name)
    intact = {it.key for it in references}
    damaged = tuple(it.reference_id for it in found if it.key not in intact)
    return IndexedPortion(tuple(references), damaged, found[-1].reference_id)


def _read_state(connection: Connection, scene_key: SceneKey, until_generation: int | None) -> IndexState:
    scene = find_scene(connection, scene_key)
    until = scene.generation if until_generation is None else until_generation
    added, removed = tables.reference.c, tables.removed_reference.c
    last_added = (
        select(added.generation, added.key)
        .where(added.scene_id == scene_key, added.generation <= until)
        .order_by(added.generation.desc(), added.key)
    )
    last_removed = (
        select(removed.generation, removed.reference_key)
        .where(removed.scene_id == scene_key, removed.generation <= until)
        .order_by(removed.generation.desc(), removed.reference_key)
    )
    last = (connection.execute(it.limit(1)).first() for it in (last_added, last_removed))
    _, last_change = max((tuple(it) for it in last if it is not None), default=(0, ""))
    standing = tables.reference_standing
    # Not where the scene is this one: a planner would then read all its references, of which hardly any is retired.
    retired = select(func.count().filter(added.scene_id == scene_key)).select_from(
        standing.join(tables.reference, standing.c.reference_key == added.key)
    )
    retired_count = connection.scalar(retired.where(standing.c.retire_time_us.is_not(None))) or 0
    count = scene.reference_count - retired_count
    return IndexState(scene.create_time_us, scene.generation, count, last_change)
