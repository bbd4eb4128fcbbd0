"""Retires references of a scene and restores them, within a change of the scene."""

from collections.abc import Sequence

from sqlalchemy import Connection, delete, select, update

from mapless_server.security import SceneKey

from . import queries, rows
from .records import RetirementReason
from .tables import reference, reference_standing, removed_reference, scene


def retire(
    connection: Connection, scene_key: SceneKey, generation: int, keys: Sequence[str], reason: RetirementReason
) -> None:
    """Has references of a scene, which are not retired, not chosen any more."""
    values = {"retire_time_us": rows.now_us(), "retire_reason": reason.value}
    for key in keys:
        queries.insert_new(connection, reference_standing, {"reference_key": key})
        row = update(reference_standing).where(reference_standing.c.reference_key == key)
        connection.execute(row.values(values))
    queries.note_removals(connection, scene_key, generation, keys)


def retired_among(connection: Connection, keys: Sequence[str]) -> list[str]:
    """Those of the keys whose references are retired, ordered."""
    column = reference.c.key
    found = [
        connection.scalars(select(column).where(column.in_(some), queries.is_retired(column)))
        for some in queries.portions(sorted(keys))
    ]
    return sorted(key for some in found for key in some)


def restore(connection: Connection, scene_key: SceneKey, generation: int, keys: Sequence[str]) -> None:
    """Has retired references of a scene chosen again, and forgets what was held against them."""
    if not keys:
        return
    for some in queries.portions(list(keys)):
        connection.execute(delete(reference_standing).where(reference_standing.c.reference_key.in_(some)))
        again = update(reference).where(reference.c.key.in_(some))  # for work in the background
        connection.execute(again.values(generation=generation))
    # Indexes never add a key again that they removed; so all of them read the whole scene.
    connection.execute(delete(removed_reference).where(removed_reference.c.scene_id == scene_key))
    connection.execute(update(scene).where(scene.c.scene_id == scene_key).values(first_generation=generation))
