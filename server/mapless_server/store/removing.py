"""How a large scene is deleted: set apart, where nobody finds it, at once, and its rows a portion at a time.

Each statement runs in the caller's transaction.
"""

from __future__ import annotations

import uuid
from collections.abc import Sequence

from sqlalchemy import ColumnElement, Connection, delete, insert, select, update

from mapless_server.store.tables import reference, scene
from mapless_server.tenancy import SceneKey

_REMOVED = "-/"
"""What keys of deleted scenes begin with: no tenant's name is a hyphen."""
_END_OF_REMOVED = "-0"
"""The first text, by code point, after all of them."""
_DAMAGED = f"{_REMOVED}damaged"
"""The key of what was deleted and whose pages cannot be freed, since the database cannot read them."""


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


def set_aside(connection: Connection, key: str) -> None:
    """Put a reference where nobody finds it, for ever, since its damaged pages keep it from being deleted."""
    if connection.scalar(select(scene.c.scene_id).where(scene.c.scene_id == _DAMAGED)) is None:
        connection.execute(insert(scene).values(scene_id=_DAMAGED, create_time_us=0))
    column = reference.c
    connection.execute(update(reference).where(column.key == key).values(scene_id=_DAMAGED, reference_id=key))


def delete_portion(connection: Connection, count: int) -> bool:
    """Delete some of what was set apart, by whomever; whether there may be more.

    What another server is deleting at this moment is left to it.
    """
    column = reference.c
    keys = _portion(connection, count)
    if keys:
        connection.execute(delete(reference).where(column.key.in_(keys)))
        return True
    is_empty = ~select(column.key).where(column.scene_id == scene.c.scene_id).exists()
    connection.execute(delete(scene).where(is_set_apart(scene.c.scene_id), is_empty))
    return False


def set_next_aside(connection: Connection) -> None:
    """Put aside what `delete_portion` would delete next if it were to delete one."""
    for key in _portion(connection, 1):
        set_aside(connection, key)


def delete_one(connection: Connection, key: str) -> None:
    """Delete one reference with everything that belongs to it."""
    connection.execute(delete(reference).where(reference.c.key == key))


def _portion(connection: Connection, count: int) -> Sequence[str]:
    column = reference.c
    portion = select(column.key).where(is_set_apart(column.scene_id), column.scene_id != _DAMAGED)
    return connection.scalars(portion.order_by(column.key).limit(count).with_for_update(skip_locked=True)).all()


def forget_removed(connection: Connection) -> None:
    """Delete all that was set apart, at once."""
    connection.execute(delete(scene).where(is_set_apart(scene.c.scene_id)))


def is_set_apart(scene_id: ColumnElement[str]) -> ColumnElement[bool]:
    """Whether a row's scene is one that was deleted."""
    return (scene_id >= _REMOVED) & (scene_id < _END_OF_REMOVED)
