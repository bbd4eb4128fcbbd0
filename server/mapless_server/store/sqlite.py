"""Everything that is particular to SQLite: which library, how each connection is set, who may write.

The file lies on a local disk (network file systems break SQLite's locks) and belongs to one server at a time.
"""

from __future__ import annotations

import fcntl
import importlib
import logging
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import quote

from sqlalchemy import URL, Connection, Engine, create_engine, event
from sqlalchemy.exc import DBAPIError

from mapless_server.errors import DataLoss, Overloaded, RequestError, Unavailable
from mapless_server.store.database import StoreError
from mapless_server.store.migrations import migrate, read_version
from mapless_server.store.tables import SCHEMA_VERSION

logger = logging.getLogger(__name__)

DATABASE_FILE = "mapless.sqlite3"
LOCK_FILE = "mapless.lock"
BUSY_TIMEOUT_MS = 5000
"""How long a connection waits for another's lock. Our writers queue before SQLite does; this is for tools beside us."""

_URI_PREFIX = "file:"
_BEGIN_OPTION = "sqlite_begin_statement"


def has_wal_reset_bug(version: tuple[int, int, int]) -> bool:
    """Whether this SQLite can corrupt a WAL database that several connections write and checkpoint.

    See https://sqlite.org/wal.html#walresetbug: fixed in 3.51.3 and, on their branches, 3.44.6 and 3.50.7.
    """
    fixed_on_branch = (3, 44, 6) <= version < (3, 45, 0) or (3, 50, 7) <= version < (3, 51, 0)
    return (3, 7, 0) <= version < (3, 51, 3) and not fixed_on_branch


class SqliteDatabase:
    """The database file of one data folder, locked against other servers; safe for many threads."""

    is_shared = False

    def __init__(self, engine: Engine, folder_lock: int | None) -> None:
        self.name = str(engine.url.database).removeprefix(_URI_PREFIX)
        self._engine = engine
        # BEGIN IMMEDIATE takes the write lock at once. A transaction that reads first and then wants to write would be
        # refused without waiting when another has written in between.
        self._writing_engine = engine.execution_options(**{_BEGIN_OPTION: "BEGIN IMMEDIATE"})
        # SQLite lets writers poll for its lock, in no order; here they queue.
        self._write_lock = threading.Lock()
        self._folder_lock: int | None = folder_lock

    @staticmethod
    def open(folder: Path) -> SqliteDatabase:
        """Open the database of a data folder; both are created if missing.

        Raises:
            StoreError: the folder or file cannot be used, is in use, or holds something else than our store.
        """
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            folder_lock = _lock_folder(folder)
        except OSError as error:
            raise StoreError(f"data folder {folder} cannot be used: {error.strerror}") from error
        return SqliteDatabase._opened(folder / DATABASE_FILE, folder_lock)

    @staticmethod
    def open_scratch(path: Path, version: int = SCHEMA_VERSION) -> SqliteDatabase:
        """A file that is worth nothing before it is finished, so that nothing is waited for; of a schema's version.

        Raises:
            StoreError: as `open`.
        """
        return SqliteDatabase._opened(path, None, version, is_scratch=True)

    @staticmethod
    def look_at(path: Path) -> SqliteDatabase:
        """Read a database as it is, whatever its schema: that of a server that is running, or a backup.

        Raises:
            StoreError: there is no such file, or it holds something else than our store.
        """
        if not path.is_file():
            raise StoreError(f"there is no database {path}")
        database = SqliteDatabase(create_sqlite_engine(path, only_reads=True), None)
        with database._faults_at_opening(), database.read() as connection:
            if read_version(connection) is None:
                raise ValueError("it is empty")
        return database

    @staticmethod
    def _opened(
        path: Path, folder_lock: int | None, version: int = SCHEMA_VERSION, is_scratch: bool = False
    ) -> SqliteDatabase:
        database = SqliteDatabase(create_sqlite_engine(path, is_scratch=is_scratch), folder_lock)
        with database._faults_at_opening():
            database._migrate(version)
        return database

    @contextmanager
    def _faults_at_opening(self) -> Iterator[None]:
        try:
            yield
        except DBAPIError as error:
            self.close()
            raise StoreError(f"database {self.name} cannot be opened: {error.orig}") from error
        except RequestError as error:
            self.close()
            raise StoreError(f"database {self.name} cannot be opened: {error}") from error
        except ValueError as error:
            self.close()
            raise StoreError(f"database {self.name} cannot be used: {error}") from error
        except BaseException:
            self.close()
            raise

    def _migrate(self, version: int) -> None:
        with self._writing_engine.connect() as connection:
            # Where SQLite cannot alter a table it is given a new one, and deleting the old must not delete what refers
            # to it. This can be said outside of a transaction only.
            _execute(connection, "PRAGMA foreign_keys=OFF")
            try:
                with connection.begin():
                    found = migrate(connection, version)
                    if found not in (None, version) and connection.exec_driver_sql("PRAGMA foreign_key_check").first():
                        raise ValueError("a part of it refers to what is not there")
            finally:
                _execute(connection, "PRAGMA foreign_keys=ON")

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Implements Database."""
        with _database_faults_translated(), self._engine.begin() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """Implements Database."""
        with _database_faults_translated(), self._write_lock, self._writing_engine.begin() as connection:
            yield connection

    def take_your_time(self, connection: Connection) -> None:
        """Implements Database."""

    def close(self) -> None:
        """Close all connections and let other servers in; nothing may be reading or writing."""
        self._engine.dispose()
        if self._folder_lock is not None:
            os.close(self._folder_lock)
            self._folder_lock = None


def _lock_folder(folder: Path) -> int:
    """A file descriptor that holds the folder's lock until it is closed, by us or by our death."""
    lock = os.open(folder / LOCK_FILE, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        os.truncate(lock, 0)
        os.write(lock, str(os.getpid()).encode())
    except BlockingIOError as error:
        holder = os.read(lock, 20).decode(errors="replace")
        os.close(lock)
        raise StoreError(f"data folder {folder} is in use by another server (process {holder})") from error
    except BaseException:
        os.close(lock)
        raise
    return lock


def _execute(connection: Connection, statement: str) -> None:
    """Outside of any transaction."""
    driver_connection = connection.connection.driver_connection
    assert driver_connection is not None
    driver_connection.execute(statement)


def create_sqlite_engine(path: Path, only_reads: bool = False, is_scratch: bool = False) -> Engine:
    """Connections to a file, each set as a store that must not lose anything needs it.

    Args:
        path: the file, created if missing.
        only_reads: the file must be there, and is left as it is.
        is_scratch: the file may be lost.
    """
    library = choose_library()
    safe_mode = has_wal_reset_bug(library.sqlite_version_info)
    if safe_mode:
        logger.warning(
            "SQLite %s has the WAL-reset bug: using a rollback journal, which is slower; install pysqlite3>=0.6.1",
            library.sqlite_version,
        )
    # WAL with FULL, and a rollback journal with EXTRA, keep every acknowledged commit through a power failure.
    journal_mode, synchronous = ("delete", "EXTRA") if safe_mode else ("wal", "FULL")
    if is_scratch:
        journal_mode, synchronous = "off", "OFF"
    url = URL.create("sqlite", database=str(path))
    if only_reads:
        # As a URI, a file that is missing is not created. It may be written all the same: readers share WAL's index.
        url = URL.create("sqlite", database=f"{_URI_PREFIX}{quote(str(path))}", query={"mode": "rw", "uri": "true"})
    engine = create_engine(
        url,
        module=library,
        max_overflow=-1,  # each worker thread holds one connection at most, so the threads are the bound
        hide_parameters=True,  # an error's text must not carry image bytes into the log
    )

    @event.listens_for(engine, "connect")
    def set_connection(connection: Any, _record: object) -> None:
        connection.isolation_level = None  # the library must not begin transactions by rules of its own
        cursor = connection.cursor()
        for setting in (
            f"busy_timeout={BUSY_TIMEOUT_MS}",
            f"synchronous={synchronous}",
            "foreign_keys=ON",
            "trusted_schema=OFF",
            "cell_size_check=ON",
            "mmap_size=0",
        ):
            cursor.execute(f"PRAGMA {setting}")
        if only_reads:
            cursor.execute("PRAGMA query_only=ON")
            return
        (mode_in_use,) = cursor.execute(f"PRAGMA journal_mode={journal_mode}").fetchone()
        if mode_in_use != journal_mode:
            raise StoreError(f"database {path} refuses journal mode {journal_mode}; is it on a local disk?")

    @event.listens_for(engine, "begin")
    def begin(connection: Connection) -> None:
        connection.exec_driver_sql(connection.get_execution_options().get(_BEGIN_OPTION, "BEGIN"))

    return engine


def choose_library() -> ModuleType:
    """The packaged SQLite if it is there, else the interpreter's; one without the WAL-reset bug if there is one.

    A process must open a database with one library only: SQLite's file locks hold between processes, and the threads of
    one process are kept apart by what a library has in memory.
    """
    libraries = [importlib.import_module("sqlite3.dbapi2")]
    with suppress(ImportError):
        libraries.insert(0, importlib.import_module("pysqlite3.dbapi2"))
    return next((it for it in libraries if not has_wal_reset_bug(it.sqlite_version_info)), libraries[0])


@contextmanager
def _database_faults_translated() -> Iterator[None]:
    """Turn the faults of the database that a caller can act on into answers; the rest is INTERNAL."""
    try:
        yield
    except DBAPIError as error:
        # Error codes reach Python only from 3.11 on; these texts have not changed in decades.
        fault = str(error.orig)
        if "is locked" in fault:
            raise Unavailable("the store is busy", retry_after_s=1.0) from error
        if "is full" in fault:
            raise Overloaded("the store's disk is full", reason="STORE_FULL") from error
        if "malformed" in fault or "not a database" in fault or "Could not decode" in fault:
            raise DataLoss("the store is damaged") from error
        raise
