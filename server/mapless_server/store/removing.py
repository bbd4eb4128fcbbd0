"""How a large scene is deleted: set apart, where nobody finds it, at once, and its rows a portion at a time.

Each statement runs in the caller's transaction.
"""

from __future__ import annotations

import uuid
from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate

from sqlalchemy import ColumnElement, Connection, ScalarSelect, Table, delete, func, insert, select, update

from mapless_server.security.tenancy import SceneKey

from .tables import features, global_descriptor, image, reference, scene

PORTION_BYTES = 4 * 2**20
"""Of photographs, features and descriptors that are deleted in one transaction, unless one reference alone has more.

SQLite overwrites what it deletes, so that it writes as much to its journal, which needs the room on the disk until the
transaction is over. That is as much as it collects there before it puts it in place anyway: the journal stays as small
as it always is, and others wait for a fraction of a second.
"""

_REMOVED = "-/"
"""What keys of deleted scenes begin with: no tenant's name is a hyphen."""
_END_OF_REMOVED = "-0"
"""The first text, by code point, after all of them."""
_DAMAGED = f"{_REMOVED}damaged"
"""The key of what was deleted and whose pages cannot be freed, since the database cannot read them."""


def set_apart(connection: Connection, scene_key: SceneKey) -> str:
    """Delete a scene but keep its references' rows, under a key at which nobody finds them; the caller has its lock.

    That is one short row a reference, where deleting means megabytes: `Leftovers` does that afterwards.

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


def is_left(connection: Connection) -> bool:
    """Whether anything that was set apart is still to be deleted."""
    column = scene.c.scene_id
    return connection.scalar(select(column).where(is_set_apart(column), column != _DAMAGED).limit(1)) is not None


def next_portion(connection: Connection, at_most: int) -> Sequence[str]:
    """Keys of what to delete next of what was set apart: so many, or so few that they are not too large together.

    What another server is deleting at this moment is left to it.
    """
    column = reference.c
    left = select(column.key).where(is_set_apart(column.scene_id), column.scene_id != _DAMAGED).order_by(column.key)
    keys = connection.scalars(left.limit(at_most).with_for_update(skip_locked=True)).all()
    if len(keys) <= 1:  # where pages are damaged even the size may not be readable
        return keys
    size_bytes = _size_bytes(image) + _size_bytes(features) + _size_bytes(global_descriptor)
    sizes = connection.scalars(select(size_bytes).where(column.key.in_(keys)).order_by(column.key))
    return keys[: max(1, bisect_right(list(accumulate(sizes)), PORTION_BYTES))]


def _size_bytes(table: Table) -> ScalarSelect[int]:
    """What a reference has in a table; the bytes themselves are not read for it."""
    total = select(func.coalesce(func.sum(func.length(table.c.data)), 0))
    return total.where(table.c.reference_key == reference.c.key).scalar_subquery()


def remove(connection: Connection, *keys: str) -> None:
    """Delete references with everything that belongs to them."""
    connection.execute(delete(reference).where(reference.c.key.in_(keys)))


def forget_empty(connection: Connection) -> None:
    """Delete what scenes were set apart under, where nothing is left of them."""
    is_empty = ~select(reference.c.key).where(reference.c.scene_id == scene.c.scene_id).exists()
    connection.execute(delete(scene).where(is_set_apart(scene.c.scene_id), is_empty))


def forget_removed(connection: Connection) -> None:
    """Delete all that was set apart, at once."""
    connection.execute(delete(scene).where(is_set_apart(scene.c.scene_id)))


def is_set_apart(scene_id: ColumnElement[str]) -> ColumnElement[bool]:
    """Whether a row's scene is one that was deleted."""
    return (scene_id >= _REMOVED) & (scene_id < _END_OF_REMOVED)
