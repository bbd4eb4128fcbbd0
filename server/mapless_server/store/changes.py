"""Changes of a scene, each of which raises its generation, and what has changed since one.

`read_changes` finds the latter, so that indexes in memory are updated without reading the whole scene. All of it runs
in the caller's transaction.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any

from sqlalchemy import Connection, Select, and_, delete, insert, select, update

from mapless_server.security import SceneKey

from . import rows
from .database import unless_damaged
from .queries import all_rows, find_scene, is_retired, scene_not_found, upsert
from .records import IndexedReference, SceneChanges
from .tables import global_descriptor, reference, removed_reference, scene, scene_generation

GENERATIONS_REMEMBERED = 100_000
"""How far back `read_changes` knows what was deleted, some 10 MB per scene; older callers read the whole scene."""

_ROWS_AT_A_TIME = 2000
"""A few megabytes, so that a scene that is read whole is not in memory twice."""
_Found = tuple[tuple[IndexedReference, ...], tuple[str, ...]]
"""References, and the ids of damaged ones; both ordered by id."""


def raise_generation(connection: Connection, scene_key: SceneKey) -> int:
    """Counts a change of a scene, which need not exist; returns the new generation.

    Every change does this before it reads anything: where the database admits several writers, the counter's row is the
    lock that orders the changes of a scene.
    """
    column = scene_generation.c
    first = upsert(connection, scene_generation).values(scene_id=scene_key, generation=1)
    change = first.on_conflict_do_update(index_elements=[column.scene_id], set_={"generation": column.generation + 1})
    connection.execute(change)
    generation: int = connection.execute(select(column.generation).where(column.scene_id == scene_key)).scalar_one()
    return generation


def begin_change(connection: Connection, scene_key: SceneKey, added_count: int = 0) -> int:
    """Counts a change of a scene and the references that it adds; returns the new generation. Raises NotFound."""
    generation = raise_generation(connection, scene_key)
    count = scene.c.reference_count + added_count
    change = update(scene).where(scene.c.scene_id == scene_key).values(reference_count=count)
    if connection.execute(change).rowcount != 1:
        raise scene_not_found(scene_key)
    return generation


def lock_changes(connection: Connection, scene_key: SceneKey) -> None:
    """Changes of a scene, which need not exist, wait for the end of the transaction; none is counted."""
    column = scene_generation.c
    connection.execute(select(column.generation).where(column.scene_id == scene_key).with_for_update())


def note_removals(connection: Connection, scene_key: SceneKey, generation: int, keys: Sequence[str]) -> None:
    """Notes for `read_changes` which references are not chosen any more since a generation, and forgets the oldest."""
    if keys:
        tombstones = [{"scene_id": scene_key, "generation": generation, "reference_key": key} for key in keys]
        connection.execute(insert(removed_reference), tombstones)
    forget_removals(connection, scene_key, generation - GENERATIONS_REMEMBERED)


def forget_removals(connection: Connection, scene_key: SceneKey, until_generation: int) -> None:
    """Deletes the tombstones up to a generation; callers that know an earlier one then read the whole scene."""
    removed = removed_reference.c
    old = delete(removed_reference).where(removed.scene_id == scene_key, removed.generation <= until_generation)
    if connection.execute(old).rowcount:
        known = update(scene).where(scene.c.scene_id == scene_key)
        connection.execute(known.values(first_generation=until_generation))


def read_changes(
    connection: Connection, scene_key: SceneKey, since_generation: int | None, descriptor_name: str
) -> SceneChanges:
    """See `Store.list_changes`; runs in the caller's transaction, which must see one moment."""
    row = find_scene(connection, scene_key)
    generation: int = row.generation
    # A later generation than the scene's is that of a database which has been replaced by a backup.
    if since_generation is None or not row.first_generation <= since_generation <= generation:
        added, damaged = _read(connection, scene_key, -1, descriptor_name)
        return SceneChanges(generation, added, frozenset(), True, damaged)
    if since_generation == generation:
        return SceneChanges(generation, (), frozenset(), False)
    removed = removed_reference.c
    gone = select(removed.reference_key).where(removed.scene_id == scene_key, removed.generation > since_generation)
    added, damaged = _read(connection, scene_key, since_generation, descriptor_name)
    return SceneChanges(generation, added, frozenset(connection.scalars(gone)), False, damaged)


def _read(connection: Connection, scene_key: SceneKey, after_generation: int, descriptor_name: str) -> _Found:
    """The references that were added or described after a generation."""
    column, descriptor = reference.c, global_descriptor.c
    is_changed = and_(column.scene_id == scene_key, column.generation > after_generation, ~is_retired(column.key))
    indexed: Select[Any] = select(
        column.reference_id, column.key, column.geometry, column.geometry_sha256, descriptor.data, descriptor.sha256
    ).outerjoin(global_descriptor, and_(descriptor.reference_key == column.key, descriptor.name == descriptor_name))

    def read_together() -> _Found:
        result = connection.execute(indexed.where(is_changed), execution_options={"yield_per": _ROWS_AT_A_TIME})
        references: list[IndexedReference] = []
        damaged: list[str] = []
        for portion in result.partitions():
            some, damaged_ids = rows.indexed_references(portion, descriptor_name)
            references += some
            damaged += damaged_ids
        return tuple(sorted(references, key=lambda it: it.reference_id)), tuple(sorted(damaged))

    def read_each() -> _Found:
        changed = select(column.reference_id, column.key).where(is_changed).order_by(column.reference_id)
        references: list[IndexedReference] = []
        damaged: list[str] = []
        for row in connection.execute(changed).all():
            one = indexed.where(column.key == row.key)
            found = unless_damaged(connection, partial(all_rows, connection, one), lambda: None)
            if found is None:
                damaged.append(row.reference_id)
                continue
            some, damaged_ids = rows.indexed_references(found, descriptor_name)
            references += some
            damaged += damaged_ids
        return tuple(references), tuple(damaged)

    return unless_damaged(connection, read_together, read_each)
