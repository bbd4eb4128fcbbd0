"""Verification: reads every row of a store and lists damaged ones."""

from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

from sqlalchemy import Connection, Row, Select, Table, func, select
from sqlalchemy.exc import DBAPIError

from mapless_server.errors import DataLoss
from mapless_server.security import SceneKey, scene_id_of, tenant_of

from . import codec, queries, rows
from .database import is_damage, unless_damaged
from .migrations import OLDEST_VERSION, read_version
from .queries import is_detached
from .tables import depth, features, global_descriptor, image, mask, reference, scene

BLOBS_AT_A_TIME = 16
"""Images are megabytes each."""

PAGE_FAULTS_LISTED = 20
"""SQLite lists each page that a damaged one refers to, and there may be thousands."""

Progress = Callable[[str, int, int], None]
"""Receives what is being done, how much of it is done, and how much there is."""

FIRST_WITH_DEPTH = 12
"""The schema that has depth."""

_DATABASE = "database"


@dataclass(frozen=True)
class Verification:
    """The result of a verification: the schema's version and the numbers of rows of scenes and their parts, by table.

    There is one line for each fault; those of the file as a whole begin with "database: ".
    """

    version: int
    counts: dict[str, int]
    faults: tuple[str, ...]

    @property
    def is_file_whole(self) -> bool:
        """Whether all damage belongs to references or scenes, which can be deleted and stored again."""
        return not any(fault.startswith(f"{_DATABASE}: ") for fault in self.faults)


def ignore_progress(what: str, done: int, total: int) -> None:
    """A `Progress` that does nothing."""


def verify(connection: Connection, on_progress: Progress = ignore_progress) -> Verification:
    """Checks the whole store, in the caller's transaction, which must see one moment.

    Remaining rows of a deleted scene are counted, but not checked. Matches of references are not checked here, but when
    they are used; damaged ones are made again. ValueError if the database is no store, or one of a newer program;
    DataLoss if the database itself is damaged, so that not even its version can be read.
    """
    version = read_version(connection)
    if version is None:
        raise ValueError("it is empty")
    tables = [scene, reference, image, features, global_descriptor]
    checks: list[_Check] = [_check_references, _check_features, _check_descriptors, _check_counts, _check_attributes]
    if version > OLDEST_VERSION:
        tables.append(mask)
        checks.append(partial(_check_files, mask, rows.file))
    if version >= FIRST_WITH_DEPTH:
        tables.append(depth)
        checks.append(partial(_check_files, depth, rows.depth_image))
    counts = {it.name: unless_damaged(connection, partial(_count, connection, it), lambda: 0) for it in tables}
    faults: list[str] = []
    for check in checks:
        all_of_them = partial(_list, check, connection, counts, on_progress)
        faults += unless_damaged(connection, all_of_them, lambda: [f"{_DATABASE}: not even its rows can be read"])
    if connection.dialect.name == "sqlite":
        # Last, because the faults that name a reference are those that can be repaired.
        faults += unless_damaged(connection, lambda: _damaged_pages(connection), lambda: [f"{_DATABASE}: its pages"])
    return Verification(version, counts, tuple(dict.fromkeys(faults)))


_Check = Callable[[Connection, dict[str, int], Progress], Iterator[str]]


def _list(check: _Check, connection: Connection, counts: dict[str, int], on_progress: Progress) -> list[str]:
    return list(check(connection, counts, on_progress))


def _count(connection: Connection, table: Table) -> int:
    return connection.scalar(select(func.count()).select_from(table)) or 0


def _damaged_pages(connection: Connection) -> list[str]:
    found = [str(row[0]) for row in connection.exec_driver_sql(f"PRAGMA integrity_check({PAGE_FAULTS_LISTED})")]
    return [f"{_DATABASE}: {line}" for text in found for line in text.splitlines() if line != "ok"]


def _check_references(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    column = reference.c
    # By name: a store of an older schema has fewer columns.
    statement: Select[Any] = select(
        column.key,
        column.scene_id,
        column.reference_id,
        column.geometry,
        column.geometry_sha256,
        column.image_sha256.label("sha256"),
        image.c.data,
        select(func.count()).where(features.c.reference_key == column.key).scalar_subquery().label("feature_sets"),
    ).outerjoin(image, image.c.reference_key == column.key)
    for name, row in _stream(connection, statement, "references", counts[reference.name], on_progress):
        if row is None:
            yield f"{name}: image, or camera and pose, on damaged pages"
            continue
        yield from _fault(name, "camera and pose", codec.decode_geometry, row.key, row.geometry, row.geometry_sha256)
        yield from _fault(name, "image", rows.file, row, "image")
        if not row.feature_sets:
            yield f"{name}: it has no features"
    yield from _orphans(connection, image)


def _check_files(
    table: Table, read: Callable[..., object], connection: Connection, counts: dict[str, int], on_progress: Progress
) -> Iterator[str]:
    """Checks the masks or depths of references, by how a row is read."""
    column, kind = reference.c, table.name
    sha256 = column[f"{kind}_sha256"]
    statement: Select[Any] = (
        select(column.key, column.scene_id, column.reference_id, sha256.label("sha256"), table.c.data)
        .outerjoin(table, table.c.reference_key == column.key)
        .where(sha256.is_not(None) | table.c.data.is_not(None))
    )
    for name, row in _stream(connection, statement, f"{kind}s", counts[kind], on_progress):
        if row is None:
            yield f"{name}: {kind}, on damaged pages"
            continue
        yield from _fault(name, kind, read, row, kind)
    yield from _orphans(connection, table)


def _check_features(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    for name, row in _stream_parts(connection, features, "features", counts, on_progress):
        if row is None:
            yield f"{name}: features, on damaged pages"
            continue
        owner = rows.features_owner(row.key, row.extractor)
        yield from _fault(name, f"features of {row.extractor}", codec.decode_view, owner, row.data, row.sha256)
    yield from _orphans(connection, features)


def _check_descriptors(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    for name, row in _stream_parts(connection, global_descriptor, "descriptors", counts, on_progress):
        if row is None:
            yield f"{name}: global descriptor, on damaged pages"
            continue
        owner, what = rows.descriptor_owner(row.key, row.name), f"global descriptor {row.name}"
        yield from _fault(name, what, codec.check, owner, row.data, row.sha256, what)
    yield from _orphans(connection, global_descriptor)


def _check_counts(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    references = select(reference.c.scene_id, reference.c.generation)
    references = references.where(~is_detached(reference.c.scene_id))
    found, latest = Counter[str](), dict[str, int]()
    for row in _rows(connection, references, "scenes", counts[reference.name], on_progress):
        found[row.scene_id] += 1
        latest[row.scene_id] = max(row.generation, latest.get(row.scene_id, 0))
    generations = queries.read_generations(connection)
    column = scene.c
    scenes: Select[Any] = select(column.scene_id, column.reference_count, column.first_generation)  # of any version
    for row in connection.execute(scenes.where(~is_detached(column.scene_id))):
        key, generation = row.scene_id, generations.get(row.scene_id)
        if row.reference_count != found.pop(key, 0):
            yield f"{_scene_name(key)}: its count of references is wrong"
        if generation is None or max(row.first_generation, latest.get(key, 0)) > generation:
            yield f"{_scene_name(key)}: its generation is wrong"
    for key in found:
        yield f"{_scene_name(key)}: there are references but no scene"


def _check_attributes(connection: Connection, counts: dict[str, int], on_progress: Progress) -> Iterator[str]:
    column = scene.c
    statement: Select[Any] = select(column.scene_id, column.attributes, column.attributes_sha256)
    for row in _rows(connection, statement, "scenes", counts[scene.name], on_progress):
        yield from _fault(_scene_name(row.scene_id), "its datum, down and calibration", rows.scene_attributes, row)


def _fault(name: str, what: str, check: Callable[..., object], *arguments: object) -> Iterator[str]:
    try:
        check(*arguments)
    except (codec.Damaged, DataLoss):
        yield f"{name}: {what}"


def _orphans(connection: Connection, table: Table) -> Iterator[str]:
    column = table.c.reference_key
    missing = select(func.count()).select_from(table).where(column.not_in(select(reference.c.key)))
    count = connection.scalar(missing)
    if count:
        yield f"{_DATABASE}: {count} rows of {table.name} belong to no reference"


def _stream_parts(
    connection: Connection, table: Table, what: str, counts: dict[str, int], on_progress: Progress
) -> Iterator[tuple[str, Row[Any] | None]]:
    """`_stream` for the rows of a table that belong to references."""
    column = reference.c
    statement: Select[Any] = select(column.scene_id, column.reference_id, column.key, table)
    statement = statement.join(reference, column.key == table.c.reference_key)
    return _stream(connection, statement, what, counts[table.name], on_progress)


def _stream(
    connection: Connection, statement: Select[Any], what: str, total: int, on_progress: Progress
) -> Iterator[tuple[str, Row[Any] | None]]:
    """Names and rows of references, read one by one if some are on damaged pages, with None for those."""
    column = reference.c
    statement = statement.where(~is_detached(column.scene_id))
    try:
        for row in _rows(connection, statement, what, total, on_progress):
            yield _reference_name(row), row
        return
    except DBAPIError as error:
        if not is_damage(error):
            raise
    listed: Select[Any] = select(column.key, column.scene_id, column.reference_id).where(~is_detached(column.scene_id))
    for done, it in enumerate(connection.execute(listed).all(), 1):
        one = statement.where(column.key == it.key)
        found = unless_damaged(connection, partial(queries.all_rows, connection, one), lambda: [None])
        yield from ((_reference_name(it), row) for row in found)
        on_progress(f"checking {what} one by one", done, total)


def _rows(
    connection: Connection, statement: Select[Any], what: str, total: int, on_progress: Progress
) -> Iterator[Row[Any]]:
    done = 0
    for portion in connection.execute(statement, execution_options={"yield_per": BLOBS_AT_A_TIME}).partitions():
        yield from portion
        done += len(portion)
        on_progress(f"checking {what}", done, total)


def _reference_name(row: Row[Any]) -> str:
    return f"{_scene_name(row.scene_id)}, reference {row.reference_id!r}"


def _scene_name(key: str) -> str:
    scene_key = SceneKey(key)
    return f"tenant {tenant_of(scene_key)!r}, scene {scene_id_of(scene_key)!r}"
