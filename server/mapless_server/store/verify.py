"""Reads every row of a store and says what is not as it was stored."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from sqlalchemy import Connection, Row, Select, Table, func, select

from mapless_server.errors import DataLoss
from mapless_server.store import codec, queries, removing, rows
from mapless_server.store.migrations import read_version
from mapless_server.store.tables import features, global_descriptor, image, reference, scene
from mapless_server.tenancy import SceneKey, scene_id_of, tenant_of

BLOBS_AT_A_TIME = 16
"""Images are megabytes each."""

Progress = Callable[[str, int, int], None]
"""Hears what is being done, how much of it is done, and how much there is."""


@dataclass(frozen=True)
class Verification:
    """What was read.

    Attributes:
        version: of the schema.
        counts: of scenes, references and their parts, by table.
        faults: one line each; none if every byte is as it was stored.
    """

    version: int
    counts: dict[str, int]
    faults: tuple[str, ...]


def ignore_progress(what: str, done: int, total: int) -> None:
    """A Progress that nobody hears."""


def verify(connection: Connection, on_progress: Progress = ignore_progress) -> Verification:
    """Check the whole store, in the caller's transaction, which must see one moment.

    What is left of a deleted scene is counted, and not looked at.

    Raises:
        ValueError: it is no store, or one of a newer program.
        DataLoss: the database itself is damaged, so that not even its rows can be read.
    """
    version = read_version(connection)
    if version is None:
        raise ValueError("it is empty")
    faults: list[str] = []
    if connection.dialect.name == "sqlite":
        found = [row[0] for row in connection.exec_driver_sql("PRAGMA integrity_check")]
        faults += [f"database: {it}" for it in found if it != "ok"]
    tables = [scene, reference, image, features]
    checks = [_check_references, _check_features]
    if version >= 2:
        tables.append(global_descriptor)
        checks += [_check_descriptors, _check_counts]
    if version >= 3:
        checks.append(_check_attributes)
    counts = {table.name: connection.scalar(select(func.count()).select_from(table)) or 0 for table in tables}
    for check in checks:
        faults += check(connection, counts, on_progress)
    return Verification(version, counts, tuple(faults))


def _check_references(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    column = reference.c
    # By name: a store of an older schema has fewer columns.
    statement: Select[Any] = select(
        column.key,
        column.scene_id,
        column.reference_id,
        column.geometry,
        column.geometry_sha256,
        column.image_sha256,
        image.c.data,
        select(func.count()).where(features.c.reference_key == column.key).scalar_subquery().label("feature_sets"),
    ).outerjoin(image, image.c.reference_key == column.key)
    statement = statement.where(~removing.is_set_apart(column.scene_id))
    for row in _stream(connection, statement, "references", counts[reference.name], on_progress):
        yield from _fault(
            _name(row), "camera and pose", codec.decode_geometry, row.key, row.geometry, row.geometry_sha256
        )
        yield from _fault(_name(row), "image", rows.image, row)
        if not row.feature_sets:
            yield f"{_name(row)}: it has no features"
    yield from _orphans(connection, image)


def _check_features(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    statement: Select[Any] = select(reference.c.scene_id, reference.c.reference_id, reference.c.key, features).join(
        reference, reference.c.key == features.c.reference_key
    )
    statement = statement.where(~removing.is_set_apart(reference.c.scene_id))
    for row in _stream(connection, statement, "features", counts[features.name], on_progress):
        owner = rows.features_owner(row.key, row.extractor)
        yield from _fault(_name(row), f"features of {row.extractor}", codec.decode_view, owner, row.data, row.sha256)
    yield from _orphans(connection, features)


def _check_descriptors(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    statement: Select[Any] = select(
        reference.c.scene_id, reference.c.reference_id, reference.c.key, global_descriptor
    ).join(reference, reference.c.key == global_descriptor.c.reference_key)
    statement = statement.where(~removing.is_set_apart(reference.c.scene_id))
    for row in _stream(connection, statement, "descriptors", counts[global_descriptor.name], on_progress):
        owner, what = rows.descriptor_owner(row.key, row.name), f"global descriptor {row.name}"
        yield from _fault(_name(row), what, codec.check, owner, row.data, row.sha256, what)
    yield from _orphans(connection, global_descriptor)


def _check_counts(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    references = select(reference.c.scene_id, reference.c.generation)
    references = references.where(~removing.is_set_apart(reference.c.scene_id))
    found, latest = Counter[str](), dict[str, int]()
    for row in _stream(connection, references, "scenes", counts[reference.name], on_progress):
        found[row.scene_id] += 1
        latest[row.scene_id] = max(row.generation, latest.get(row.scene_id, 0))
    generations = queries.read_generations(connection)
    column = scene.c
    scenes: Select[Any] = select(
        column.scene_id, column.reference_count, column.first_generation
    )  # as older schemas have them
    for row in connection.execute(scenes.where(~removing.is_set_apart(column.scene_id))):
        key, generation = row.scene_id, generations.get(row.scene_id)
        if row.reference_count != found.pop(key, 0):
            yield f"{_scene(key)}: its count of references is wrong"
        if generation is None or max(row.first_generation, latest.get(key, 0)) > generation:
            yield f"{_scene(key)}: its generation is wrong"
    for key in found:
        yield f"{_scene(key)}: there are references but no scene"


def _check_attributes(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    column = scene.c
    statement: Select[Any] = select(column.scene_id, column.attributes, column.attributes_sha256)
    for row in _stream(connection, statement, "scenes", counts[scene.name], on_progress):
        yield from _fault(_scene(row.scene_id), "its datum, down and calibration", rows.scene_attributes, row)


def _fault(whose: str, what: str, check: Callable[..., object], *arguments: object) -> Iterator[str]:
    try:
        check(*arguments)
    except (codec.Damaged, DataLoss):
        yield f"{whose}: {what}"


def _stream(
    connection: Connection, statement: Select[Any], what: str, total: int, on_progress: Progress
) -> Iterator[Row[Any]]:
    done = 0
    for portion in connection.execute(statement, execution_options={"yield_per": BLOBS_AT_A_TIME}).partitions():
        yield from portion
        done += len(portion)
        on_progress(f"checking {what}", done, total)


def _orphans(connection: Connection, table: Table) -> Iterator[str]:
    column = table.c.reference_key
    missing = select(func.count()).select_from(table).where(column.not_in(select(reference.c.key)))
    count = connection.scalar(missing)
    if count:
        yield f"database: {count} rows of {table.name} belong to no reference"


def _name(row: Row[Any]) -> str:
    return f"{_scene(row.scene_id)}, reference {row.reference_id!r}"


def _scene(key: str) -> str:
    scene_key = SceneKey(key)
    return f"tenant {tenant_of(scene_key)!r}, scene {scene_id_of(scene_key)!r}"
