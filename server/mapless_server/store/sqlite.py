"""Everything that is particular to SQLite: which library, how each connection is set, who may write.

The file lies on a local disk (network file systems break SQLite's locks) and belongs to one server at a time. On a disk
that can only be read any number of servers may read it.
"""

from __future__ import annotations

import errno
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

from mapless_server.errors import FailedPrecondition, RequestError

from .damage import is_damage
from .database import StoreError
from .folder_lock import FolderLock
from .migrations import migrate, read_version
from .sqlite_faults import faults_translated
from .tables import SCHEMA_VERSION

logger = logging.getLogger(__name__)

DATABASE_FILE = "mapless.sqlite3"
BUSY_TIMEOUT_MS = 5000
"""How long a connection waits for another's lock. Our writers queue before SQLite does; this is for tools beside us."""
MAKE_ROOM_TIMEOUT_MS = 100
"""For those who read what is not in the file yet; a backup reads for longer, and is not waited for."""
JOURNAL_KEPT_BYTES = 8 * 2**20
"""A journal that a large change has made longer is cut when it is begun anew. Deleting needs less."""
ROOM_TO_OPEN_BYTES = 64 * 1024
"""What SQLite needs beside the file to open it."""

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

    def __init__(self, engine: Engine, folder_lock: FolderLock | None, only_reads: bool = False) -> None:
        self.name = str(engine.url.database).removeprefix(_URI_PREFIX)
        self._engine = engine
        # BEGIN IMMEDIATE takes the write lock at once. A transaction that reads first and then wants to write would be
        # refused without waiting when another has written in between.
        self._writing_engine = engine.execution_options(**{_BEGIN_OPTION: "BEGIN IMMEDIATE"})
        # SQLite lets writers poll for its lock, in no order; here they queue.
        self._write_lock = threading.Lock()
        self._folder_lock = folder_lock
        self.only_reads = only_reads

    @staticmethod
    def open(folder: Path) -> SqliteDatabase:
        """Open the database of a data folder; both are created if missing.

        A database on a disk that can only be read is read, and every change of it is refused.

        Raises:
            StoreError: the folder or file cannot be used, is in use, or holds something else than our store.
        """
        path = folder / DATABASE_FILE
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            folder_lock = FolderLock.take(folder, DATABASE_FILE)
        except OSError as error:
            if error.errno == errno.EROFS and path.is_file():
                return SqliteDatabase._open_to_read(path)
            raise StoreError(f"data folder {folder} cannot be used: {error.strerror}") from error
        return SqliteDatabase._opened(path, folder_lock)

    @staticmethod
    def _open_to_read(path: Path) -> SqliteDatabase:
        """A database that nobody can write, not even SQLite the files beside it that it shares with other processes."""
        left = [it for it in (path.with_name(f"{path.name}-wal"), path.with_name(f"{path.name}-journal")) if _holds(it)]
        if left:
            raise StoreError(
                f"database {path} cannot be opened: it was not closed in order, and the disk can only be read, so that "
                f"what {left[0].name} holds cannot be put in its place"
            )
        try:
            folder_lock = FolderLock.share(path)
        except OSError as error:
            raise StoreError(f"database {path} cannot be read: {error.strerror}") from error
        database = SqliteDatabase(create_sqlite_engine(path, only_reads=True, never_changes=True), folder_lock, True)
        with database._faults_at_opening(), database.read() as connection:
            version = read_version(connection)
            if version != SCHEMA_VERSION:
                raise ValueError(
                    f"its schema is of version {version}, must be {SCHEMA_VERSION}, and the disk can only be read"
                )
        logger.warning("the disk of %s can only be read: queries are answered, and changes refused", path)
        return database

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
        path: Path, folder_lock: FolderLock | None, version: int = SCHEMA_VERSION, is_scratch: bool = False
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
            raise StoreError(f"database {self.name} cannot be opened: {_why(error, self.name)}") from error
        except RequestError as error:
            self.close()
            cause = _why(error.__cause__, self.name) if isinstance(error.__cause__, DBAPIError) else error
            raise StoreError(f"database {self.name} cannot be opened: {cause}") from error
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
        # Ended by rolling back, as closing does: SQLite that has met a damaged page refuses to commit even nothing.
        with faults_translated(), self._engine.connect() as connection:
            connection.begin()
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """Implements Database."""
        if self.only_reads:
            raise FailedPrecondition("the store can only be read", reason="STORE_READ_ONLY")
        with faults_translated(), self._write_lock, self._writing_engine.begin() as connection:
            yield connection

    def take_your_time(self, connection: Connection) -> None:
        """Implements Database."""

    def make_room(self) -> None:
        """Implements Database."""
        suppressed = suppress(self._engine.dialect.loaded_dbapi.Error)  # what cannot be put in place stays where it is
        with faults_translated(), self._write_lock, self._engine.connect() as connection, suppressed:
            # Who writes waits while this waits for who reads.
            _execute(connection, f"PRAGMA busy_timeout={MAKE_ROOM_TIMEOUT_MS}")
            try:
                _execute(connection, "PRAGMA wal_checkpoint(RESTART)")
            finally:
                _execute(connection, f"PRAGMA busy_timeout={BUSY_TIMEOUT_MS}")

    def close(self) -> None:
        """Close all connections and let other servers in; nothing may be reading or writing."""
        self._engine.dispose()
        if self._folder_lock is not None:
            self._folder_lock.release()
            self._folder_lock = None


def _execute(connection: Connection, statement: str) -> None:
    """Outside of any transaction."""
    driver_connection = connection.connection.driver_connection
    assert driver_connection is not None
    driver_connection.execute(statement)


def _holds(path: Path) -> bool:
    """Whether there is a file with something in it."""
    return path.is_file() and path.stat().st_size > 0


def _why(error: DBAPIError, name: str) -> str:
    """The database's text, and what an operator can do where it does not say so itself."""
    fault = str(error.orig)
    if is_damage(error):
        return f"{fault}; restore a backup into a new folder"
    with suppress(OSError):
        disk = os.statvfs(Path(name).parent)
        if "disk I/O error" in fault and disk.f_bavail * disk.f_frsize < ROOM_TO_OPEN_BYTES:
            return f"{fault}: the disk is full"
    return fault


def create_sqlite_engine(
    path: Path, only_reads: bool = False, is_scratch: bool = False, never_changes: bool = False
) -> Engine:
    """Connections to a file, each set as a store that must not lose anything needs it.

    Args:
        path: the file, created if missing.
        only_reads: the file must be there, and is left as it is.
        is_scratch: the file may be lost.
        never_changes: nobody writes it, so that no lock is taken, and nothing made beside it.
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
    if never_changes:
        url = url.update_query_dict({"mode": "ro", "immutable": "1"})
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
            f"journal_size_limit={JOURNAL_KEPT_BYTES}",
            "secure_delete=ON",  # else deleted photographs lie in the file until something else is written there
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
