"""What has changed in a scene since a generation, so that indexes in memory are updated without reading it again."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Any

from sqlalchemy import Connection, Row, Select, and_, select

from mapless_server.security import SceneKey

from . import queries, rows
from .faults import unless_damaged
from .records import IndexedReference, SceneChanges
from .tables import global_descriptor, reference, removed_reference

_ROWS_AT_A_TIME = 2000
"""A few megabytes, so that a scene that is read whole is not in memory twice."""

_Found = tuple[tuple[IndexedReference, ...], tuple[str, ...]]
"""References, and the ids of damaged ones; both ordered by id."""


def read_changes(
    connection: Connection, scene_key: SceneKey, since_generation: int | None, descriptor_name: str
) -> SceneChanges:
    """See `Store.list_changes`; in the caller's transaction, which must see one moment."""
    row = queries.find_scene(connection, scene_key)
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
    is_changed = and_(column.scene_id == scene_key, column.generation > after_generation)
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
            found = unless_damaged(connection, partial(_all, connection, one), lambda: None)
            if found is None:
                damaged.append(row.reference_id)
                continue
            some, damaged_ids = rows.indexed_references(found, descriptor_name)
            references += some
            damaged += damaged_ids
        return tuple(references), tuple(damaged)

    return unless_damaged(connection, read_together, read_each)


def _all(connection: Connection, statement: Select[Any]) -> Sequence[Row[Any]]:
    return connection.execute(statement).all()
