"""Backups: a store is copied to a file while it is served, and from a file into an empty store of either database.

A backup is one SQLite file, from either database, so it also moves a store from one to the other. It shows one moment,
and gets its name only after every row of it has been read again and verified.
"""

import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from sqlalchemy import Connection, MetaData, Table, delete, func, insert, select, update
from sqlalchemy.exc import DBAPIError

from mapless_server.errors import RequestError

from . import deletion, queries
from .database import Database, StoreError
from .migrations import read_version
from .sqlite import SqliteDatabase, choose_library
from .tables import SCHEMA_VERSION, alembic_version, removed_reference, scene, scene_generation, store_version
from .verification import BLOBS_AT_A_TIME, Progress, Verification, ignore_progress, verify

GENERATIONS_SKIPPED = 1_000_000
"""A restored scene continues after what it may have reached since the backup, so that generations stay unique."""

_BYTES_AT_A_TIME = 8 * 2**20
_ROWS_AT_A_TIME = 1000
_PAGES_AT_A_TIME = 250
_NOT_RESTORED = (store_version, alembic_version, scene_generation, removed_reference)
"""Tables that the new store has of its own, and tombstones, which no reader of a restored scene needs."""


def back_up(database: Database, path: Path, on_progress: Progress = ignore_progress) -> Verification:
    """Copies a store to a file, as of one moment; servers may go on reading and writing it.

    Data that are damaged in the store are damaged in the copy, too, and listed in the result. StoreError if the file
    exists or cannot be written, or differs from the store.
    """
    if path.exists():
        raise StoreError(f"{path} exists already")
    unfinished = path.with_name(f".{path.name}.{os.getpid()}.unfinished")
    try:
        with _faults_as_store_errors(f"backup {path} cannot be made"):
            unfinished.touch(mode=0o600)  # it contains photographs, which other users must not read
            with database.read() as source:
                database.lift_limits(source)
                version = read_version(source)  # from here on, the transaction sees one moment
                assert version is not None
                if version != SCHEMA_VERSION and source.dialect.name != "sqlite":
                    raise ValueError(
                        f"its schema has version {version}, this release writes {SCHEMA_VERSION}; make the backup with "
                        "the release that uses the database, or run `mapless-server store migrate` first"
                    )
                if source.dialect.name == "sqlite":
                    _copy_pages(source, unfinished, on_progress)
                else:
                    _copy_rows_to_file(source, unfinished, on_progress)
                found = _verify_copy(source, unfinished, on_progress)
            _sync(unfinished)
            unfinished.rename(path)
            _sync(path.parent)
    finally:
        for ending in ("", "-journal", "-wal", "-shm"):  # on a full disk SQLite leaves what it needs beside the file
            unfinished.with_name(unfinished.name + ending).unlink(missing_ok=True)
    return found


def restore(path: Path, database: Database, on_progress: Progress = ignore_progress) -> Verification:
    """Copies a backup into a store without scenes, either completely or not at all.

    StoreError if the file is damaged, of a newer program or no backup; or the store has scenes or cannot be written.
    """
    with (
        _faults_as_store_errors(f"backup {path} cannot be restored"),
        closing(SqliteDatabase.open_as_is(path)) as backup,
    ):
        with backup.read() as source:
            found = verify(source, on_progress)
        if found.faults:
            raise StoreError(f"backup {path} is damaged ({len(found.faults)} faults), first: {found.faults[0]}")
        with (
            _in_current_schema(backup, path, found.version) as current,
            current.read() as source,
            database.write() as target,
        ):
            database.lift_limits(target)
            deletion.delete_detached(target)
            if target.scalar(select(func.count()).select_from(scene)):
                raise StoreError(f"database {database.name} has scenes; a backup needs an empty store")
            _copy_rows(source, target, _tables_of(source, _NOT_RESTORED), on_progress)
            _skip_generations(source, target)
            written = verify(target, on_progress)
            if written.faults or not found.counts.items() <= written.counts.items():
                raise StoreError(f"database {database.name} does not keep what is written to it")
            deletion.delete_detached(target)
    return written


@contextmanager
def reading_backup(path: Path) -> Iterator[Database]:
    """A backup, in this program's schema, until the end of the block; StoreError if it cannot be read."""
    with closing(SqliteDatabase.open_as_is(path)) as backup:
        with backup.read() as connection:
            version = read_version(connection)
        assert version is not None
        with _in_current_schema(backup, path, version) as current:
            yield current


def _copy_pages(source: Connection, path: Path, on_progress: Progress) -> None:
    """Copies with SQLite's backup API; `source` has begun to read, so the copy has no later changes."""
    raw = source.connection.driver_connection
    assert raw is not None

    def progress(_status: int, remaining: int, total: int) -> None:
        on_progress("copying pages", total - remaining, total)

    with closing(choose_library().connect(path)) as target:
        raw.backup(target, pages=_PAGES_AT_A_TIME, progress=progress)
        target.execute("PRAGMA journal_mode=DELETE")  # one file, which can be read where nothing can be written


def _copy_rows_to_file(source: Connection, path: Path, on_progress: Progress) -> None:
    with closing(SqliteDatabase.open_scratch(path)) as database, database.write() as target:
        _copy_rows(source, target, _tables_of(target, (store_version, alembic_version)), on_progress)


def _copy_rows(source: Connection, target: Connection, tables: list[Table], on_progress: Progress) -> None:
    for table in tables:
        total, done = source.execute(select(func.count()).select_from(table)).scalar_one(), 0
        for rows in _portions(source, table):
            target.execute(insert(table), rows)
            done += len(rows)
            on_progress(f"copying {table.name}", done, total)


def _tables_of(copy: Connection, omitted: Sequence[Table] = ()) -> list[Table]:
    """The tables of a file, of whatever schema version, in the order in which they must be filled."""
    schema = MetaData()
    schema.reflect(copy, only=lambda name, _: name not in {it.name for it in omitted})
    return schema.sorted_tables


def _portions(source: Connection, table: Table) -> Iterator[list[dict[str, Any]]]:
    """Yields rows, some megabytes at a time."""
    portion: list[dict[str, Any]] = []
    size_bytes = 0
    for row in source.execute(select(table), execution_options={"yield_per": BLOBS_AT_A_TIME}).mappings():
        portion.append(dict(row))
        size_bytes += sum(len(value) for value in row.values() if isinstance(value, bytes))
        if size_bytes >= _BYTES_AT_A_TIME or len(portion) == _ROWS_AT_A_TIME:
            yield portion
            portion, size_bytes = [], 0
    if portion:
        yield portion


def _skip_generations(source: Connection, target: Connection) -> None:
    """Raises the generations above those of both databases, so that callers read the whole scene again."""
    column = scene_generation.c
    former, saved = queries.read_generations(target), queries.read_generations(source)
    target.execute(delete(scene_generation).where(column.scene_id.in_(saved.keys() & former.keys())))
    if saved:
        raised = {key: max(saved[key], former.get(key, 0)) + GENERATIONS_SKIPPED for key in saved}
        target.execute(insert(scene_generation), [{"scene_id": key, "generation": it} for key, it in raised.items()])
    latest = select(column.generation).where(column.scene_id == scene.c.scene_id).scalar_subquery()
    target.execute(update(scene).where(~queries.is_detached(scene.c.scene_id)).values(first_generation=latest))


def _verify_copy(source: Connection, path: Path, on_progress: Progress) -> Verification:
    """Verifies a copy; raises StoreError if it differs from the store."""
    with closing(SqliteDatabase.open_as_is(path)) as database, database.read() as copy:
        found = verify(copy, on_progress)
        counts = [select(func.count()).select_from(table) for table in _tables_of(copy)]
        if any(copy.scalar(count) != source.scalar(count) for count in counts):
            raise StoreError("the copy lacks rows of the store")
    # Rare, so it may take as long again: was the store damaged before, or only the copy?
    if found.faults and verify(source, on_progress).faults != found.faults:
        raise StoreError(f"the copy is damaged: {found.faults[0]}")
    return found


@contextmanager
def _in_current_schema(backup: SqliteDatabase, path: Path, version: int) -> Iterator[Database]:
    """The backup itself or, if it is from an older program, a migrated copy."""
    if version == SCHEMA_VERSION:
        yield backup
        return
    with TemporaryDirectory(prefix="mapless-restore-") as folder:
        copy = Path(folder) / path.name
        shutil.copyfile(path, copy)
        with closing(SqliteDatabase.open_scratch(copy)) as database:
            yield database


@contextmanager
def _faults_as_store_errors(what: str) -> Iterator[None]:
    try:
        yield
    except StoreError:
        raise
    except (DBAPIError, RequestError, OSError, ValueError, choose_library().Error) as error:
        cause = str(error.orig if isinstance(error, DBAPIError) else error).partition("\n")[0]
        raise StoreError(f"{what}: {cause}") from error


def _sync(path: Path) -> None:
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
