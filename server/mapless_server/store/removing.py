"""How a large scene is deleted: set apart, where nobody finds it, at once, and its rows a portion at a time.

Each statement runs in the caller's transaction.
"""

from __future__ import annotations

import uuid

from sqlalchemy import ColumnElement, Connection, delete, insert, select, update

from mapless_server.store.tables import reference, scene
from mapless_server.tenancy import SceneKey

_REMOVED = "-/"
"""What keys of deleted scenes begin with: no tenant's name is a hyphen."""
_END_OF_REMOVED = "-0"
"""The first text, by code point, after all of them."""


def set_apart(connection: Connection, scene_key: SceneKey) -> str:
    """Delete a scene but keep its references' rows, under a key at which nobody finds them; the caller has its lock.

    That is one short row a reference, where deleting means megabytes: `delete_portion` does that afterwards.

    Returns:
        The key.
    """
    key = f"{_REMOVED}{uuid.uuid4().hex}"
    # It gets no generation, without which no statement here takes it for a scene.
    connection.execute(insert(scene).values(scene_id=key, create_time_us=0))
    connection.execute(update(reference).where(reference.c.scene_id == scene_key).values(scene_id=key))
    connection.execute(delete(scene).where(scene.c.scene_id == scene_key))
    return key


def delete_portion(connection: Connection, count: int) -> bool:
    """Delete some of what was set apart, by whomever; whether there may be more.

    What another server is deleting at this moment is left to it.
    """
    column = reference.c
    portion = select(column.key).where(is_set_apart(column.scene_id)).limit(count)
    keys = connection.scalars(portion.with_for_update(skip_locked=True)).all()
    if keys:
        connection.execute(delete(reference).where(column.key.in_(keys)))
        return True
    is_empty = ~select(column.key).where(column.scene_id == scene.c.scene_id).exists()
    connection.execute(delete(scene).where(is_set_apart(scene.c.scene_id), is_empty))
    return False


def forget_removed(connection: Connection) -> None:
    """Delete all that was set apart, at once."""
    connection.execute(delete(scene).where(is_set_apart(scene.c.scene_id)))


def is_set_apart(scene_id: ColumnElement[str]) -> ColumnElement[bool]:
    """Whether a row's scene is one that was deleted."""
    return (scene_id >= _REMOVED) & (scene_id < _END_OF_REMOVED)
