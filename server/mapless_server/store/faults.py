"""Converts faults of the databases to errors that a caller can act on; all others become INTERNAL.

`sqlite` and `postgresql` convert their own faults.

A damaged page fails every statement that reads it, so one damaged photograph would fail all references that are read
together with it. Where a statement about many rows fails like this, the rows are read one by one (`unless_damaged`).
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

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
