"""The store's database on PostgreSQL: connections, transactions, time limits.

Reading is REPEATABLE READ and read-only, so that a call sees one moment. Writing is READ COMMITTED: everything that
changes a scene first locks the row of its generation (see `changes.begin_change`), so the conflicts that SERIALIZABLE
would detect at the end cannot occur.

A commit is acknowledged when it is on the disk. A commit whose acknowledgement is lost is reported as Unavailable,
though it may have happened: trying again then raises AlreadyExists, or NotFound when deleting. When the database goes
away, calls fail and its connections are dropped; when it is back, the next call gets a new one.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from sqlalchemy import URL, Connection, Engine, create_engine, event, make_url, select
from sqlalchemy.exc import ArgumentError, DBAPIError

from mapless_command.installation import how_to_install
from mapless_server.errors import RequestError

from .database import DamagedPages, StoreError, disk_full, is_damage, translating, unavailable
from .migrations import migrate, read_version
from .tables import SCHEMA_VERSION, store_version

DRIVER = "postgresql+psycopg"
CONNECTIONS_KEPT = 4
CONNECTIONS_AT_MOST = 16
"""Connections of one server: by default PostgreSQL accepts 100, which are six servers."""
CONNECTION_WAIT_S = 5.0
"""For a free connection of this server's own; less than callers wait."""

_CONNECT_OPTIONS: dict[str, Any] = {
    "application_name": "mapless-server",
    "connect_timeout": 5,
    "client_encoding": "utf8",
    # A host that disappears is given up after 10 + 3 * 5 s of silence, or 15 s after data was sent to it.
    "keepalives_idle": 10,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 15_000,
}
_SESSION_OPTIONS = {
    # "on", or a stricter one of the URL's own, keeps every acknowledged commit through a power failure.
    "synchronous_commit": "on",
    "statement_timeout": "60s",
    "lock_timeout": "5s",
    # A server that hangs in the middle of a change must release the scene's lock.
    "idle_in_transaction_session_timeout": "60s",
}
_MIGRATION_LOCK = 0x6D61706C657373
"""Any number that other programs on the same database do not use: "mapless"."""
_UNLIMITED = ("statement_timeout", "lock_timeout", "idle_in_transaction_session_timeout")

# Faults, by class or all of SQLSTATE: https://www.postgresql.org/docs/current/errcodes-appendix.html
_FULL = "53100"
_BUSY = ("40001", "40P01", "55P03", "57014")
_AWAY = ("08", "25006", "25P03", "53", "57P")


class PostgresqlDatabase:
    """Implements Database with a PostgreSQL database that other servers may share."""

    is_shared = True
    only_reads = False

    def __init__(self, engine: Engine, name: str) -> None:
        self.name = name
        self._writing_engine = engine
        self._engine = engine.execution_options(isolation_level="REPEATABLE READ", postgresql_readonly=True)

    @staticmethod
    def open(database_url: str, migrates: bool = True) -> "PostgresqlDatabase":
        """Connects, and migrates an empty or older database to this program's schema, unless it is taken as it is.

        The URL is "postgresql://user:password@host:5432/database"; libpq's options may follow after "?". StoreError if
        it is invalid, the database cannot be reached, or it contains something else; or is empty and not migrated.
        """
        url = parse_url(database_url)
        database = PostgresqlDatabase(_create_engine(url), f"{url.host or 'local'}:{url.port or 5432}/{url.database}")
        try:
            database._prepare(migrates)
        except (DBAPIError, RequestError, ValueError) as error:
            database.close()
            fault = error if isinstance(error, DBAPIError) else error.__cause__
            cause = str(fault.orig if isinstance(fault, DBAPIError) else fault or error).partition("\n")[0].strip()
            raise StoreError(f"database {database.name} cannot be used: {cause}") from None
        except BaseException:
            database.close()
            raise
        return database

    @contextmanager
    def read(self) -> Iterator[Connection]:
        """Implements Database."""
        with translating(_translated), self._engine.begin() as connection:
            yield connection

    @contextmanager
    def write(self) -> Iterator[Connection]:
        """Implements Database."""
        with translating(_translated), self._writing_engine.begin() as connection:
            yield connection

    def check(self) -> None:
        """Implements Database."""
        with self.read() as connection:
            connection.scalar(select(store_version.c.schema_version))

    def lift_limits(self, connection: Connection) -> None:
        """Implements Database."""
        for setting in _UNLIMITED:
            connection.exec_driver_sql(f"SET LOCAL {setting} = 0")

    def free_space(self) -> None:
        """Implements Database."""

    @contextmanager
    def reserve(self) -> Iterator[None]:
        """Implements Database; there is none, since PostgreSQL deletes without overwriting."""
        yield

    def close(self) -> None:
        """Implements Database."""
        self._writing_engine.dispose()

    def _prepare(self, migrates: bool) -> None:
        with self.read() as connection:
            encoding = connection.exec_driver_sql("SHOW server_encoding").scalar()
            if encoding != "UTF8":
                raise ValueError(f"its encoding is {encoding}, must be UTF8")
            found = read_version(connection)
            if found is None and not migrates:
                raise ValueError("it is empty")
            if found == SCHEMA_VERSION or not migrates:
                return
        with self.write() as connection:
            self.lift_limits(connection)
            # Of several servers that start at once, one migrates; the others wait and find it done.
            connection.exec_driver_sql(f"SELECT pg_advisory_xact_lock({_MIGRATION_LOCK})")
            migrate(connection)


def parse_url(database_url: str) -> URL:
    """The URL with this program's driver; raises StoreError, without the URL's text, if it is invalid."""
    try:
        url = make_url(database_url)
    except (ArgumentError, ValueError):
        url = None
    # The text is never repeated: it may be invalid because its password is taken for something else.
    if url is None or url.drivername not in ("postgresql", "postgres", DRIVER) or not url.database:
        raise StoreError("database_url must be like postgresql://user:password@host:5432/database")
    # Hosts are looked up and named in messages, and part of the password would be taken for one.
    if "@" in f"{url.host}{url.database}":
        raise StoreError("database_url has an @ too many: one in the user's name or password must be written %40")
    return url.set(drivername=DRIVER)


def _create_engine(url: URL, cursors_are_binary: bool = True) -> Engine:
    try:
        import psycopg
        from psycopg.pq import Format
    except ImportError:
        raise StoreError(f"PostgreSQL needs psycopg: {how_to_install('postgres')}") from None

    # In text format, bytes would be sent as hexadecimal digits, twice as long and slow to parse.
    wire_format = Format.BINARY if cursors_are_binary else Format.TEXT

    def cursor(*args: Any, **kwargs: Any) -> psycopg.Cursor[Any]:
        made: psycopg.Cursor[Any] = psycopg.Cursor(*args, **kwargs)
        made.format = wire_format
        return made

    def server_cursor(*args: Any, **kwargs: Any) -> psycopg.ServerCursor[Any]:
        made: psycopg.ServerCursor[Any] = psycopg.ServerCursor(*args, **kwargs)
        made.format = wire_format
        return made

    options = {name: value for name, value in _CONNECT_OPTIONS.items() if name not in url.query}
    session = [f"-c {name}={value}" for name, value in _SESSION_OPTIONS.items()]
    given = url.query.get("options", ())
    options["options"] = " ".join([*session, *([given] if isinstance(given, str) else given)])
    engine = create_engine(
        url.difference_update_query(["options"]),
        connect_args=options | {"cursor_factory": cursor},
        pool_size=CONNECTIONS_KEPT,
        max_overflow=CONNECTIONS_AT_MOST - CONNECTIONS_KEPT,
        pool_timeout=CONNECTION_WAIT_S,
        pool_pre_ping=True,
        isolation_level="READ COMMITTED",
        hide_parameters=True,  # an error's text must not carry image bytes into the log
    )

    @event.listens_for(engine, "connect")
    def set_connection(connection: Any, _record: object) -> None:
        connection.server_cursor_factory = server_cursor

    return engine


def _translated(error: DBAPIError) -> RequestError | None:
    state: str = getattr(error.orig, "sqlstate", None) or ""
    if state.startswith(_FULL):
        return disk_full()
    if is_damage(error):
        return DamagedPages()
    if state.startswith(_BUSY):
        return unavailable("the store is busy")
    # The library's own faults have no state: it cannot connect, or the connection broke.
    is_away = error.connection_invalidated or type(error.orig).__name__ == "OperationalError"
    if state.startswith(_AWAY) or (not state and is_away):
        return unavailable("the store is not there")
    return None
