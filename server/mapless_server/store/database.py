"""The common parts of the store's databases: SQLite in a folder, or a PostgreSQL that several servers share.

Faults of the databases become errors that a caller can act on; all others become INTERNAL. `sqlite` and `postgresql`
convert their own.

A damaged page fails every statement that reads it, so one damaged photograph would fail all references that are read
together with it. Where a statement about many rows fails like this, the rows are read one by one (`unless_damaged`).
"""

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from typing import Protocol, TypeVar

from sqlalchemy import Connection
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from mapless_server.errors import DataLoss, Overloaded, RequestError, Unavailable

T = TypeVar("T")

RETRY_AFTER_S = 1.0

# SQLite's faults are known by their texts, which have not changed in decades; codes reach Python from 3.11 on only.
_SQLITE_DAMAGED = ("malformed", "not a database", "Could not decode")

# PostgreSQL's by class or all of SQLSTATE: https://www.postgresql.org/docs/current/errcodes-appendix.html
_POSTGRESQL_DAMAGED = ("XX001", "XX002")


class DamagedPages(DataLoss):
    """The database cannot read some of its pages; the rows on them are not known yet."""

    def __init__(self) -> None:
        super().__init__("the store is damaged")


def is_damage(error: DBAPIError) -> bool:
    """Whether a fault of either database means that pages are damaged."""
    state = getattr(error.orig, "sqlstate", None)
    return state in _POSTGRESQL_DAMAGED if state else any(it in str(error.orig) for it in _SQLITE_DAMAGED)


def unless_damaged(connection: Connection, read: Callable[[], T], otherwise: Callable[[], T]) -> T:
    """Reads in the connection's transaction; returns the result of `otherwise` if a page is damaged."""
    try:
        with connection.begin_nested():
            return read()
    except DBAPIError as error:
        if not is_damage(error):
            raise
    return otherwise()


def disk_full() -> Overloaded:
    """The error of a disk without space."""
    return Overloaded("the store's disk is full", reason="STORE_FULL")


def unavailable(message: str) -> Unavailable:
    """The error of a database that may be available again soon."""
    return Unavailable(message, reason="STORE_UNAVAILABLE", retry_after_s=RETRY_AFTER_S)


@contextmanager
def translating(translated: Callable[[DBAPIError], RequestError | None]) -> Iterator[None]:
    """Converts a database's faults in the block to errors that a caller can act on, where there is one."""
    try:
        yield
    except PoolTimeoutError as error:
        raise unavailable("the store is busy") from error
    except DBAPIError as error:
        found = translated(error)
        if found is None:
            raise
        raise found from error


class StoreError(Exception):
    """The store cannot be opened, copied or checked; the message is one sentence for the operator."""


class Database(Protocol):
    """Transactions of one database; thread-safe. Raises RequestError for faults that a caller can act on.

    If other processes may change it, it `is_shared`, and cached rows are valid for their generation only. A database
    that `only_reads` refuses all changes. The name is for messages.
    """

    is_shared: bool
    only_reads: bool
    name: str

    def read(self) -> AbstractContextManager[Connection]:
        """A transaction that sees one moment of the database throughout."""
        ...

    def write(self) -> AbstractContextManager[Connection]:
        """A transaction that is on the disk, as a whole, at the end of the block; or not at all if the block raises.

        Where the database admits several writers, each statement sees what was committed before it began. The changes
        of a scene are ordered by its generation, which each raises before it reads anything: that row is their lock.
        """
        ...

    def check(self) -> None:
        """Raises Unavailable if the database is away: it cannot be read, or others keep it from being written."""
        ...

    def lift_limits(self, connection: Connection) -> None:
        """Lifts the time limits of a transaction that no caller waits for."""
        ...

    def free_space(self) -> None:
        """Frees disk space that the database does not need for data, as far as that is quick; outside transactions."""
        ...

    def reserve(self) -> AbstractContextManager[None]:
        """Disk space that is kept for deleting is free within the block, in which the caller only deletes."""
        ...

    def close(self) -> None:
        """Closes all connections; no transaction may be running."""
        ...


def with_room_to_delete(database: Database, delete: Callable[[], T]) -> T:
    """Deletes; where the disk is full, again with the space that the database keeps for it.

    Overloaded, which says what to do, if that is not enough either.
    """
    try:
        return delete()
    except Overloaded:
        pass
    try:
        with database.reserve():
            return delete()
    except Overloaded as error:
        message = "the store's disk is full, also for deleting: make room on it for a few megabytes, then delete again"
        raise Overloaded(message, reason=error.reason) from error
