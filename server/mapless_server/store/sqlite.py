"""The store's database on SQLite: choice of the library, and configuration of connections.

The file must be on a local disk (network file systems break SQLite's locks) and is used by one server at a time. From a
read-only disk, any number of servers may read it.
"""

from __future__ import annotations

import errno
import importlib
import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum, auto
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import quote

from sqlalchemy import URL, Connection, Engine, create_engine, event, select
from sqlalchemy.exc import DBAPIError

from mapless_server.errors import FailedPrecondition, RequestError, Unavailable

from .database import RETRY_AFTER_S, DamagedPages, StoreError, disk_full, is_damage, translating, unavailable
from .folder_lock import FolderLock
from .migrations import migrate, read_version
from .reserve import Reserve
from .tables import SCHEMA_VERSION, store_version

logger = logging.getLogger(__name__)

DATABASE_FILE = "mapless.sqlite3"
BUSY_TIMEOUT_MS = 5000
"""How long a connection waits for another's lock. The server's own writers queue before; this is for other programs."""
CHECK_TIMEOUT_MS = 2000
"""How long a check waits for another program's lock: less than who asks waits for the check."""
FREE_SPACE_TIMEOUT_MS = 100
"""Waiting for readers of the journal; a backup reads for longer, and is not waited for."""
JOURNAL_KEPT_BYTES = 8 * 2**20
"""A journal that a large change has made longer is truncated when it is restarted. Deleting needs less."""
CLOSING_S = 10.0
"""How long closing waits for threads that read or write; one that takes longer closes its connection at its end."""
SPACE_TO_OPEN_BYTES = 64 * 1024
"""Free space that SQLite needs beside the file to open it."""

_URI_PREFIX = "file:"
_BEGIN_OPTION = "sqlite_begin_statement"

# Its faults are known by their texts, which have not changed in decades; codes reach Python from 3.11 on only.
_BROKEN = ("disk I/O error", "unable to open database file")


def has_wal_reset_bug(version: tuple[int, int, int]) -> bool:
    """Whether this version can corrupt a WAL database that several connections write and checkpoint.

    See https://sqlite.org/wal.html#walresetbug: fixed in 3.51.3 and, on their branches, 3.44.6 and 3.50.7.
    """
    fixed_on_branch = (3, 44, 6) <= version < (3, 45, 0) or (3, 50, 7) <= version < (3, 51, 0)
    return (3, 7, 0) <= version < (3, 51, 3) and not fixed_on_branch


class Use(Enum):
    """Purpose for which a file is opened; it is created if missing, unless it is only read."""

    WRITE = auto()
    SCRATCH = auto()
    """To be written; it may be lost."""
    READ = auto()
    """To be read while others may write it."""
    UNCHANGING = auto()
    """To be read while no process writes it: no lock is taken, and no file created beside it."""

    @property
    def only_reads(self) -> bool:
        """Whether the file is not written."""
        return self in (Use.READ, Use.UNCHANGING)


class SqliteDatabase:
    """Implements Database with the file of a data folder, locked against other servers."""

    is_shared = False

    def __init__(self, engine: Engine, folder_lock: FolderLock | None, only_reads: bool = False) -> None:
        self.name = str(engine.url.database).removeprefix(_URI_PREFIX)
        self._engine = engine
        # BEGIN IMMEDIATE takes the write lock at once. A transaction that first reads and then writes would fail
        # without waiting if another has written in between.
        self._writing_engine = engine.execution_options(**{_BEGIN_OPTION: "BEGIN IMMEDIATE"})
        # SQLite's writers poll for its lock, in no order; here they queue.
        self._write_lock = threading.Lock()
        self._use, self._use_count, self._closed = threading.Condition(), 0, threading.Event()
        self._folder_lock = folder_lock
        self._reserve: Reserve | None = None
        self.only_reads = only_reads

    @staticmethod
    def open(folder: Path) -> SqliteDatabase:
        """Opens the database of a data folder, migrated to this program's schema; creates both if missing.

        A database on a read-only disk can be read; changes are refused. StoreError if the folder or file cannot be
        used, is in use, or contains something else.
        """
        path = folder / DATABASE_FILE
        if folder.is_file():
            raise StoreError(f"data folder {folder} is a file, not a folder")
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            folder_lock = FolderLock.take(folder, DATABASE_FILE)
        except OSError as error:
            if error.errno == errno.EROFS and path.is_file():
                return SqliteDatabase._open_read_only(path)
            raise StoreError(f"data folder {folder} cannot be used: {error.strerror}") from error
        reserve = Reserve(folder)
        with reserve.used():
            database = SqliteDatabase._opened(path, folder_lock)
        reserve.keep()
        database._reserve = reserve
        return database

    @staticmethod
    def _open_read_only(path: Path) -> SqliteDatabase:
        """Opens a database on a read-only disk, where SQLite cannot write the files beside it either."""
        beside = (path.with_name(f"{path.name}-wal"), path.with_name(f"{path.name}-journal"))
        left = [it for it in beside if it.is_file() and it.stat().st_size]
        if left:
            raise StoreError(
                f"database {path} cannot be opened: it was not closed in order, and the disk can only be read, so that "
                f"what {left[0].name} holds cannot be put in its place"
            )
        try:
            folder_lock = FolderLock.share(path)
        except OSError as error:
            raise StoreError(f"database {path} cannot be read: {error.strerror}") from error
        database = SqliteDatabase(create_sqlite_engine(path, Use.UNCHANGING), folder_lock, True)
        with database._faults_as_store_errors(), database.read() as connection:
            version = read_version(connection)
            if version != SCHEMA_VERSION:
                raise ValueError(
                    f"its schema is of version {version}, must be {SCHEMA_VERSION}, and the disk can only be read"
                )
        logger.warning("the disk of %s can only be read: queries are answered, and changes refused", path)
        return database

    @staticmethod
    def open_scratch(path: Path) -> SqliteDatabase:
        """Opens a file that may be lost until it is complete, without waiting for the disk; creates it if missing.

        StoreError as in `open`.
        """
        return SqliteDatabase._opened(path, None, Use.SCRATCH)

    @staticmethod
    def open_as_is(path: Path) -> SqliteDatabase:
        """Opens a database for reading without migrating it: a running server's, or a backup.

        StoreError if there is no such file, or it contains something else.
        """
        if not path.is_file():
            raise StoreError(f"there is no database {path}")
        database = SqliteDatabase(create_sqlite_engine(path, Use.READ), None)
        with database._faults_as_store_errors(), database.read() as connection:
            if read_version(connection) is None:
                raise ValueError("it is empty")
        return database

    @staticmethod
    def _opened(path: Path, folder_lock: FolderLock | None, use: Use = Use.WRITE) -> SqliteDatabase:
        database = SqliteDatabase(create_sqlite_engine(path, use), folder_lock)
        with database._faults_as_store_errors():
            database._migrate()
        return database

    @contextmanager
    def _faults_as_store_errors(self) -> Iterator[None]:
        try:
            yield
        except DBAPIError as error:
            self.close()
            raise StoreError(f"database {self.name} cannot be opened: {_explain(error, self.name)}") from error
        except RequestError as error:
            self.close()
            cause = _explain(error.__cause__, self.name) if isinstance(error.__cause__, DBAPIError) else error
            raise StoreError(f"database {self.name} cannot be opened: {cause}") from error
        except ValueError as error:
            self.close()
            raise StoreError(f"database {self.name} cannot be used: {error}") from error
        except BaseException:
            self.close()
            raise

    def _migrate(self) -> None:
        with self._writing_engine.connect() as connection:
            # Where SQLite cannot alter a table, the table is replaced, and dropping the old one must not delete what
            # refers to it. The setting has an effect outside of transactions only.
            _execute(connection, "PRAGMA foreign_keys=OFF")
            try:
                with connection.begin():
                    found = migrate(connection)
                    is_changed = found not in (None, SCHEMA_VERSION)
                    if is_changed and connection.exec_driver_sql("PRAGMA foreign_key_check").first():
                        raise ValueError("a part of it refers to what is not there")
            finally:
                _execute(connection, "PRAGMA foreign_keys=ON")

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Implements Database."""
        # Rolled back, as closing does: after a damaged page SQLite refuses to commit even an empty transaction.
        with translating(_translated), self._connected(self._engine) as connection:
            connection.begin()
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """Implements Database."""
        if self.only_reads:
            raise FailedPrecondition("the store can only be read", reason="STORE_READ_ONLY")
        with translating(_translated), self._write_lock, self._connected(self._writing_engine) as it, it.begin():
            yield it

    @contextmanager
    def _connected(self, engine: Engine) -> Iterator[Connection]:
        """A connection, which closing waits for; Unavailable once the database is being closed."""
        with self._use:
            if self._closed.is_set():
                raise unavailable("the store is closed")
            self._use_count += 1
        try:
            with engine.connect() as connection:
                yield connection
        finally:
            with self._use:
                self._use_count -= 1
                self._use.notify_all()
                if self._closed.is_set():
                    engine.pool.dispose()

    def check(self) -> None:
        """Implements Database; a file that was removed is away, too, although SQLite goes on reading what it held."""
        with self.read() as connection:
            connection.scalar(select(store_version.c.schema_version))
        if self.only_reads:
            return
        if not Path(self.name).is_file():
            raise unavailable("the store's file is gone")
        if not self._write_lock.acquire(blocking=False):
            return  # a change of our own is being written
        try:
            with translating(_translated), self._connected(self._writing_engine) as connection:
                _execute(connection, f"PRAGMA busy_timeout={CHECK_TIMEOUT_MS}")
                try:
                    connection.begin().rollback()
                finally:
                    _execute(connection, f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")
        finally:
            self._write_lock.release()

    def lift_limits(self, connection: Connection) -> None:
        """Implements Database."""

    def free_space(self) -> None:
        """Implements Database."""
        suppressed = suppress(self._engine.dialect.loaded_dbapi.Error)  # the journal then stays as it is
        with translating(_translated), self._write_lock, self._connected(self._engine) as connection, suppressed:
            # Writers wait while this waits for readers.
            _execute(connection, f"PRAGMA busy_timeout={FREE_SPACE_TIMEOUT_MS}")
            try:
                _execute(connection, "PRAGMA wal_checkpoint(RESTART)")
            finally:
                _execute(connection, f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")

    @contextmanager
    def reserve(self) -> Iterator[None]:
        """Implements Database."""
        if self._reserve is None:
            yield
            return
        with self._reserve.used():
            self.free_space()  # now that what is in the journal has room in the file
            yield
            self.free_space()

    def close(self) -> None:
        """Refuses further transactions, closes all connections once they are not used, and unlocks the folder.

        A task of the server that is cancelled leaves its thread to end by itself. If its connection is closed after
        the others, SQLite's journal vanishes beneath whatever opens the folder next: it is waited for `CLOSING_S`.
        """
        with self._use:
            self._closed.set()
            self._use.wait_for(lambda: not self._use_count, CLOSING_S)
            self._engine.pool.dispose()
        if self._folder_lock is not None:
            self._folder_lock.release()


def _execute(connection: Connection, statement: str) -> None:
    """Executes outside of any transaction."""
    connection.connection.cursor().execute(statement)


def _explain(error: DBAPIError, name: str) -> str:
    """The database's text, and what an operator can do about the fault."""
    fault = str(error.orig)
    if is_damage(error):
        return f"{fault}; restore a backup into a new folder"
    with suppress(OSError):
        disk = os.statvfs(Path(name).parent)
        if "disk I/O error" in fault and disk.f_bavail * disk.f_frsize < SPACE_TO_OPEN_BYTES:
            return f"{fault}: the disk is full"
    return fault


def create_sqlite_engine(path: Path, use: Use = Use.WRITE) -> Engine:
    """Makes connections to a file, each configured for a store that must not lose anything."""
    library = choose_library()
    safe_mode = has_wal_reset_bug(library.sqlite_version_info)
    if safe_mode:
        logger.warning(
            "SQLite %s has the WAL-reset bug: using a rollback journal, which is slower; install pysqlite3>=0.6.1",
            library.sqlite_version,
        )
    # WAL with FULL, and a rollback journal with EXTRA, keep every acknowledged commit through a power failure.
    journal_mode, synchronous = ("delete", "EXTRA") if safe_mode else ("wal", "FULL")
    if use is Use.SCRATCH:
        journal_mode, synchronous = "off", "OFF"
    engine = create_engine(
        _url_of(path, use),
        module=library,
        max_overflow=-1,  # bounded by the number of threads, which use one connection each
        hide_parameters=True,  # an error's text must not carry image bytes into the log
    )

    @event.listens_for(engine, "connect")
    def set_connection(connection: Any, _record: object) -> None:
        connection.isolation_level = None  # the library must not begin transactions by itself
        cursor = connection.cursor()
        for setting in (
            f"busy_timeout={BUSY_TIMEOUT_MS}",
            f"synchronous={synchronous}",
            "foreign_keys=ON",
            "trusted_schema=OFF",
            "cell_size_check=ON",
            "mmap_size=0",
            f"journal_size_limit={JOURNAL_KEPT_BYTES}",
            "secure_delete=ON",  # otherwise deleted photographs stay in the file until they are overwritten
        ):
            cursor.execute(f"PRAGMA {setting}")
        if use.only_reads:
            cursor.execute("PRAGMA query_only=ON")
            return
        (mode_in_use,) = cursor.execute(f"PRAGMA journal_mode={journal_mode}").fetchone()
        if mode_in_use != journal_mode:
            raise StoreError(f"database {path} refuses journal mode {journal_mode}; is it on a local disk?")

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        connection.exec_driver_sql(connection.get_execution_options().get(_BEGIN_OPTION, "BEGIN"))

    return engine


def _url_of(path: Path, use: Use) -> URL:
    if not use.only_reads:
        return URL.create("sqlite", database=str(path))
    # With a URI a missing file is not created. The mode is not read-only, because readers share WAL's index.
    mode = {"mode": "rw"} if use is Use.READ else {"mode": "ro", "immutable": "1"}
    return URL.create("sqlite", database=f"{_URI_PREFIX}{quote(str(path))}", query={**mode, "uri": "true"})


def choose_library() -> ModuleType:
    """The packaged SQLite if it is installed, otherwise the interpreter's; preferably one without the WAL-reset bug.

    A process must open a database with one library only: SQLite's file locks work between processes; the threads of one
    process are synchronized by the library's memory.
    """
    libraries = [importlib.import_module("sqlite3.dbapi2")]
    with suppress(ImportError):
        libraries.insert(0, importlib.import_module("pysqlite3.dbapi2"))
    return next((it for it in libraries if not has_wal_reset_bug(it.sqlite_version_info)), libraries[0])


def _translated(error: DBAPIError) -> RequestError | None:
    text = str(error.orig)
    if is_damage(error):
        return DamagedPages()
    if "is locked" in text:
        return Unavailable("the store is busy", retry_after_s=RETRY_AFTER_S)
    if "is full" in text:
        return disk_full()
    if "readonly database" in text:
        return FailedPrecondition("the store can only be read", reason="STORE_READ_ONLY")
    if any(it in text for it in _BROKEN):
        return unavailable("the store's disk fails")
    return None
