"""Retires references of a scene, within a change of the scene."""

from collections.abc import Sequence

from sqlalchemy import Connection, select, update

from mapless_server.security import SceneKey

from . import changes, queries, rows
from .records import RetirementReason
from .tables import reference, reference_standing


def retire(
    connection: Connection, scene_key: SceneKey, generation: int, keys: Sequence[str], reason: RetirementReason
) -> None:
    """Has references of a scene, which are not retired, not chosen any more."""
    values = {"retire_time_us": rows.now_us(), "retire_reason": reason.value}
    for key in keys:
        queries.insert_new(connection, reference_standing, {"reference_key": key})
        row = update(reference_standing).where(reference_standing.c.reference_key == key)
        connection.execute(row.values(values))
    changes.note_removals(connection, scene_key, generation, keys)


def retired_among(connection: Connection, keys: Sequence[str]) -> list[str]:
    """Those of the keys whose references are retired, ordered."""
    column = reference.c.key
    found = [
        connection.scalars(select(column).where(column.in_(some), queries.is_retired(column)))
        for some in queries.portions(sorted(keys))
    ]
    return sorted(key for some in found for key in some)
