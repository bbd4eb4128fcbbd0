"""What became of a scene since a generation: how whoever has it in memory keeps up without reading it again."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from sqlalchemy import Connection, Row, Select, and_, select

from mapless_server.security.tenancy import SceneKey

from . import queries, rows
from .damage import unless_damaged
from .records import IndexedReference, SceneChanges
from .tables import global_descriptor, reference, removed_reference

_ROWS_AT_A_TIME = 2000
"""A few megabytes, so that a scene that is read whole is not in memory twice."""

_Found = tuple[tuple[IndexedReference, ...], tuple[str, ...]]


def read_changes(
    connection: Connection, scene_key: SceneKey, since_generation: int | None, descriptor_name: str
) -> SceneChanges:
    """See ``Store.list_changes``; in the caller's transaction, which must see one moment."""
    row = queries.find_scene(connection, scene_key)
    generation: int = row.generation
    # A generation yet to come is one of a database that a backup has taken the place of since.
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
    """References that changed, by id, and the ids of those that are damaged."""
    return unless_damaged(
        connection,
        lambda: _read_together(connection, scene_key, after_generation, descriptor_name),
        lambda: _read_each(connection, scene_key, after_generation, descriptor_name),
    )


def _read_together(connection: Connection, scene_key: SceneKey, after_generation: int, descriptor_name: str) -> _Found:
    statement = _select_indexed(descriptor_name).where(
        reference.c.scene_id == scene_key, reference.c.generation > after_generation
    )
    result = connection.execute(statement, execution_options={"yield_per": _ROWS_AT_A_TIME})
    found: list[IndexedReference] = []
    damaged: list[str] = []
    for portion in result.partitions():
        references, damaged_ids = rows.indexed_references(portion, descriptor_name)
        found += references
        damaged += damaged_ids
    return tuple(sorted(found, key=lambda it: it.reference_id)), tuple(sorted(damaged))


def _read_each(connection: Connection, scene_key: SceneKey, after_generation: int, descriptor_name: str) -> _Found:
    """The same one by one, where some lie on pages that cannot be read."""
    column = reference.c
    changed = select(column.reference_id, column.key).where(
        column.scene_id == scene_key, column.generation > after_generation
    )
    found: list[IndexedReference] = []
    damaged: list[str] = []
    for row in connection.execute(changed.order_by(column.reference_id)).all():
        statement = _select_indexed(descriptor_name).where(column.key == row.key)
        read = unless_damaged(connection, partial(_all_of, connection, statement), lambda: None)
        if read is None:
            damaged.append(row.reference_id)
            continue
        references, damaged_ids = rows.indexed_references(read, descriptor_name)
        found += references
        damaged += damaged_ids
    return tuple(found), tuple(damaged)


def _all_of(connection: Connection, statement: Select[Any]) -> Sequence[Row[Any]]:
    return connection.execute(statement).all()


def _select_indexed(descriptor_name: str) -> Select[Any]:
    column, descriptor = reference.c, global_descriptor.c
    return select(
        column.reference_id, column.key, column.geometry, column.geometry_sha256, descriptor.data, descriptor.sha256
    ).outerjoin(global_descriptor, and_(descriptor.reference_key == column.key, descriptor.name == descriptor_name))
