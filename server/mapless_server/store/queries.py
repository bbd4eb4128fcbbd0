"""Statements that several operations of the store share; each runs in the caller's transaction."""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from typing import Any

from sqlalchemy import ColumnElement, Connection, Row, Select, Table, and_, delete, func, insert, or_, select
from sqlalchemy.dialects import sqlite

from mapless.names import reference_name, scene_name
from mapless_server.errors import AlreadyExists, NotFound
from mapless_server.security import (
    DEFAULT_TENANT,
    KEY_SEPARATOR,
    SceneKey,
    SceneLimit,
    end_of_keys,
    key_of,
    scene_id_of,
    tenant_of,
)

from . import rows
from .records import SceneRecord
from .tables import (
    adopted_reference,
    features,
    global_descriptor,
    reference,
    reference_standing,
    scene,
    scene_calibration,
    scene_generation,
    scene_label,
)

DETACHED = "-/"
"""Prefix of the keys of detached scenes: no tenant's name is a hyphen."""
_DETACHED_END = "-0"
"""The first text, by code point, after all of them."""
_IDS_PER_STATEMENT = 500
"""Databases bound the number of parameters of a statement."""


def select_scenes() -> Select[Any]:
    """Columns of `scene` and `generation`."""
    return (
        select(scene, scene_generation.c.generation)
        .select_from(scene)
        .join(scene_generation, scene_generation.c.scene_id == scene.c.scene_id)
    )


def select_scenes_of(
    tenant: str, after: str, labels: Mapping[str, str], limit: SceneLimit | None = None
) -> Select[Any]:
    """The same columns for the scenes of a tenant with all these labels and ids greater than `after`, ordered by id.

    Only of those within the limit, if there is one.
    """
    key = scene.c.scene_id
    # Not LIKE: to SQLite, "acme/%" is "ACME/%".
    is_theirs = ~key.contains(KEY_SEPARATOR) if tenant == DEFAULT_TENANT else key < end_of_keys(tenant)
    found = select_scenes().where(key > key_of(tenant, after), is_theirs, *have_labels(labels.items()))
    return (found if limit is None else found.where(is_within(limit, tenant))).order_by(key)


def select_labelled(keys: Sequence[SceneKey], labels: Collection[tuple[str, str]]) -> Select[Any]:
    """Those of some keys whose scenes have all these labels; reads labels alone."""
    column = scene_label.c
    is_one = or_(*(and_(column.name == name, column.value == value) for name, value in sorted(labels)))
    found: Select[Any] = select(column.scene_id).where(column.scene_id.in_(keys), is_one)
    return found.group_by(column.scene_id).having(func.count() == len(labels))


def have_labels(labels: Iterable[tuple[str, str]]) -> list[ColumnElement[bool]]:
    """Conditions that rows of `scene` have each of these labels."""
    label = scene_label.c
    return [
        scene.c.scene_id.in_(select(label.scene_id).where(label.name == name, label.value == value))
        for name, value in sorted(labels)
    ]


def is_within(limit: SceneLimit, tenant: str) -> ColumnElement[bool]:
    """Whether rows of `scene`, which are a tenant's, are within a limit."""
    is_named = scene.c.scene_id.in_([key_of(tenant, it) for it in sorted(limit.scene_ids)])
    return or_(is_named, and_(*have_labels(limit.labels))) if limit.labels else is_named


def read_scenes(connection: Connection, found: Sequence[Row[Any]]) -> list[SceneRecord]:
    """Makes the records of rows of `select_scenes`; raises DataLoss if the attributes of one are damaged."""
    column, labels = scene_label.c, defaultdict[str, dict[str, str]](dict)
    for some in portions([row.scene_id for row in found]):
        for label in connection.execute(select(scene_label).where(column.scene_id.in_(some)).order_by(column.name)):
            labels[label.scene_id][label.name] = label.value
    return [rows.scene_record(row, labels[row.scene_id]) for row in found]


def replace_labels(connection: Connection, scene_key: SceneKey, labels: Mapping[str, str]) -> None:
    """Replaces the labels of a scene."""
    connection.execute(delete(scene_label).where(scene_label.c.scene_id == scene_key))
    if labels:
        added = [{"scene_id": scene_key, "name": name, "value": value} for name, value in labels.items()]
        connection.execute(insert(scene_label), added)


def find_scene(connection: Connection, scene_key: SceneKey, limit: SceneLimit | None = None) -> Row[Any]:
    """The row of `select_scenes` for one scene; raises NotFound, also for one that is not within the limit."""
    found = select_scenes().where(scene.c.scene_id == scene_key)
    if limit is not None:
        found = found.where(is_within(limit, tenant_of(scene_key)))
    return _one(connection, found, lambda: scene_not_found(scene_key))


def find_calibrations(connection: Connection, scene_key: SceneKey) -> Sequence[Row[Any]]:
    """Columns of `scene_calibration` of a scene; empty if it has not been calibrated."""
    column = scene_calibration.c
    stored: Select[Any] = select(column.scene_id, column.kind, column.data, column.sha256)
    return connection.execute(stored.where(column.scene_id == scene_key, column.data.is_not(None))).all()


def read_generation(connection: Connection, scene_key: SceneKey) -> int:
    """Generation of a scene. Raises NotFound."""
    statement: Select[Any] = select(scene_generation.c.generation).join(
        scene, scene.c.scene_id == scene_generation.c.scene_id
    )
    row = _one(connection, statement.where(scene.c.scene_id == scene_key), lambda: scene_not_found(scene_key))
    generation: int = row.generation
    return generation


def read_generations(connection: Connection) -> dict[str, int]:
    """Generations by scene key, of all scenes that ever existed."""
    column = scene_generation.c
    return {row.scene_id: row.generation for row in connection.execute(select(column.scene_id, column.generation))}


def find_keys(connection: Connection, scene_key: SceneKey, reference_ids: Sequence[str] | None) -> dict[str, str]:
    """Maps ids of existing references to keys. None: all references of the scene, ordered by id."""
    column = reference.c
    statement = select(column.reference_id, column.key).where(column.scene_id == scene_key)
    parts = [statement.order_by(column.reference_id)]
    if reference_ids is not None:
        parts = [statement.where(column.reference_id.in_(ids)) for ids in portions(reference_ids)]
    return {row.reference_id: row.key for part in parts for row in connection.execute(part)}


def select_references() -> Select[Any]:
    """Columns of `reference` and of `reference_standing`, null where nothing was said of a reference.

    Those about a place are of an adopted reference's place; `place_id` is the id of the surveyed one that it is of.
    """
    key, own, adopted = reference.c.key, reference_standing.c, adopted_reference.c
    place, of_place = reference.alias(), reference_standing.alias()
    is_of_place = of_place.c.reference_key == func.coalesce(adopted.place_key, key)
    retired = {"retire_time_us", "retire_reason"}
    said = [it for it in of_place.c if it.name not in {"reference_key", *retired}]
    return (
        select(reference, own.retire_time_us, own.retire_reason, *said, place.c.reference_id.label("place_id"))
        .outerjoin(reference_standing, own.reference_key == key)
        .outerjoin(adopted_reference, adopted.reference_key == key)
        .outerjoin(place, place.c.key == adopted.place_key)
        .outerjoin(of_place, is_of_place)
    )


def find_key(connection: Connection, scene_key: SceneKey, reference_id: str, field: str = "name") -> str:
    """Key of one reference, which a request has in this field. Raises NotFound for the scene or the reference."""
    read_generation(connection, scene_key)
    keys = find_keys(connection, scene_key, [reference_id])
    if reference_id not in keys:
        raise reference_not_found(scene_key, reference_id, field=field)
    return keys[reference_id]


def refuse_taken_ids(connection: Connection, scene_key: SceneKey, reference_ids: Sequence[str]) -> None:
    """Raises AlreadyExists for the first id that is stored already or occurs twice."""
    taken = set(find_keys(connection, scene_key, reference_ids))
    for index, reference_id in enumerate(reference_ids):
        if reference_id in taken:
            raise AlreadyExists(
                f"reference {reference_id!r} exists already in scene {scene_id_of(scene_key)!r}",
                field=f"requests[{index}].reference_id",
                resource=reference_name(scene_id_of(scene_key), reference_id),
            )
        taken.add(reference_id)


def rows_by_key(connection: Connection, keys: Sequence[str]) -> dict[str, Row[Any]]:
    """Rows of `reference`, by key."""
    return _by_key(connection, select(reference), keys)


def features_by_key(connection: Connection, keys: Sequence[str], extractor: str) -> dict[str, Row[Any]]:
    """Rows of `reference` joined with `features`, by key, of those that have features of this extractor."""
    found: dict[str, Row[Any]] = {}
    for name in rows.feature_names(extractor):
        lacking = [key for key in keys if key not in found]
        statement: Select[Any] = (
            select(reference, features.c.extractor, features.c.data, features.c.sha256)
            .join(features, features.c.reference_key == reference.c.key)
            .where(features.c.extractor == name)
        )
        found |= _by_key(connection, statement, lacking)
    return found


def descriptors_by_key(connection: Connection, keys: Sequence[str], name: str) -> dict[str, Row[Any]]:
    """Rows of `global_descriptor` with this name, by the keys of their references."""
    column, found = global_descriptor.c, dict[str, Row[Any]]()
    for portion in portions(keys):
        is_wanted = column.reference_key.in_(portion) & (column.name == name)
        stored: Select[Any] = select(column.reference_key, column.data, column.sha256).where(is_wanted)
        found |= {row.reference_key: row for row in connection.execute(stored)}
    return found


def find_by_key(connection: Connection, key: str, *columns: ColumnElement[Any]) -> Row[Any]:
    """Columns of the reference with this key; raises NotFound if it was deleted."""
    return _one(connection, select(*columns).where(_exists(key)), _reference_deleted)


def lock_reference(connection: Connection, key: str) -> Row[Any]:
    """Columns `scene_id` and `reference_id` of a reference, which is not deleted before the transaction ends.

    Raises NotFound if it was deleted before.
    """
    statement: Select[Any] = select(reference.c.scene_id, reference.c.reference_id).where(_exists(key))
    return _one(connection, statement.with_for_update(read=True, key_share=True), _reference_deleted)


def find_file(connection: Connection, key: str, table: Table) -> Row[Any]:
    """Columns `reference_id`, `sha256` and `data` of a reference's image or mask; NotFound if it was deleted."""
    statement: Select[Any] = (
        select(reference.c.reference_id, reference.c[f"{table.name}_sha256"].label("sha256"), table.c.data)
        .outerjoin(table, table.c.reference_key == reference.c.key)
        .where(_exists(key))
    )
    return _one(connection, statement, _reference_deleted)


def has_features(connection: Connection, key: str, extractor: str) -> bool:
    """Whether a reference that was not deleted has features of this extractor."""
    column = features.c
    statement = select(column.extractor).join(reference, reference.c.key == column.reference_key)
    return (
        connection.scalar(statement.where(_exists(key), column.extractor.in_(rows.feature_names(extractor))))
        is not None
    )


def is_detached(scene_id: ColumnElement[str]) -> ColumnElement[bool]:
    """Whether a row belongs to a detached scene."""
    return (scene_id >= DETACHED) & (scene_id < _DETACHED_END)


def is_retired(key: ColumnElement[str]) -> ColumnElement[bool]:
    """Whether the reference of a key is retired."""
    standing = reference_standing.c
    return (
        select(standing.reference_key)
        .where(standing.reference_key == key, standing.retire_time_us.is_not(None))
        .correlate(reference)
        .exists()
    )


def insert_new(connection: Connection, table: Table, row: Mapping[str, Any]) -> bool:
    """Inserts a row unless one with its primary key exists; returns whether it was inserted."""
    addition = upsert(connection, table).values(row).on_conflict_do_nothing()
    return connection.execute(addition, execution_options={"preserve_rowcount": True}).rowcount == 1


def add_to(connection: Connection, table: Table, row: Mapping[str, Any], summed: Collection[str]) -> None:
    """Adds a row's values of the `summed` columns to the row with its primary key, or inserts it if there is none."""
    addition = upsert(connection, table).values(row)
    sums = {name: table.c[name] + addition.excluded[name] for name in summed}
    connection.execute(addition.on_conflict_do_update(index_elements=list(table.primary_key), set_=sums))


def reference_not_found(scene_key: SceneKey, reference_id: str, field: str) -> NotFound:
    """The error for a reference that does not exist."""
    scene_id = scene_id_of(scene_key)
    message = f"there is no reference {reference_id!r} in scene {scene_id!r}"
    return NotFound(message, field=field, resource=reference_name(scene_id, reference_id))


def _reference_deleted() -> NotFound:
    return NotFound("a reference was deleted while it was used")


def scene_not_found(scene_key: SceneKey) -> NotFound:
    """The error for a scene that does not exist."""
    scene_id = scene_id_of(scene_key)
    return NotFound(f"there is no scene {scene_id!r}", field="scene", resource=scene_name(scene_id))


def _one(connection: Connection, statement: Select[Any], missing: Callable[[], NotFound]) -> Row[Any]:
    row = connection.execute(statement).one_or_none()
    if row is None:
        raise missing()
    return row


def _by_key(connection: Connection, statement: Select[Any], keys: Sequence[str]) -> dict[str, Row[Any]]:
    return {
        row.key: row
        for portion in portions(keys)
        for row in connection.execute(statement.where(reference.c.key.in_(portion)))
    }


def _exists(key: str) -> ColumnElement[bool]:
    """The row of `reference` with a key, unless its scene was deleted."""
    return (reference.c.key == key) & ~is_detached(reference.c.scene_id)


def upsert(connection: Connection, table: Table) -> Any:
    """An INSERT that supports ON CONFLICT; each of the two dialects has its own class for it."""
    if connection.dialect.name == "sqlite":
        return sqlite.insert(table)
    from sqlalchemy.dialects import postgresql  # loads three drivers

    return postgresql.insert(table)


def portions(ids: Sequence[str]) -> Iterator[Sequence[str]]:
    """The ids, in portions of so many as one statement may name."""
    for start in range(0, len(ids), _IDS_PER_STATEMENT):
        yield ids[start : start + _IDS_PER_STATEMENT]


def all_rows(connection: Connection, statement: Select[Any]) -> Sequence[Row[Any]]:
    """The rows of a statement."""
    return connection.execute(statement).all()
