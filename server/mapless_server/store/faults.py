"""Faults of the databases, as errors that a caller can act on; all others become INTERNAL.

A damaged page fails every statement that reads it, so one damaged photograph would fail all references that are read
together with it. Where a statement about many rows fails like this, the rows are read one by one (`unless_damaged`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from sqlalchemy import Connection
from sqlalchemy.exc import DBAPIError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError

from mapless_server.errors import DataLoss, FailedPrecondition, Overloaded, RequestError, Unavailable

T = TypeVar("T")

RETRY_AFTER_S = 1.0

# SQLite's faults are known by their texts, which have not changed in decades; codes reach Python from 3.11 on only.
_SQLITE_DAMAGED = ("malformed", "not a database", "Could not decode")
_SQLITE_BROKEN = ("disk I/O error", "unable to open database file")

# PostgreSQL's by class or all of SQLSTATE: https://www.postgresql.org/docs/current/errcodes-appendix.html
_POSTGRESQL_DAMAGED = ("XX001", "XX002")
_POSTGRESQL_FULL = "53100"
_POSTGRESQL_BUSY = ("40001", "40P01", "55P03", "57014")
_POSTGRESQL_AWAY = ("08", "25006", "25P03", "53", "57P")


class DamagedPages(DataLoss):
    """The database cannot read some of its pages; which rows they hold is not known yet."""

    def __init__(self) -> None:
        super().__init__("the store is damaged")


def is_damage(error: DBAPIError) -> bool:
    """Whether a fault of either database means that pages are damaged."""
    state = getattr(error.orig, "sqlstate", None)
    return state in _POSTGRESQL_DAMAGED if state else any(it in str(error.orig) for it in _SQLITE_DAMAGED)


def unless_damaged(connection: Connection, read: Callable[[], T], otherwise: Callable[[], T]) -> T:
    """Reads in the connection's transaction; the result of `otherwise` if that meets a damaged page."""
    try:
        with connection.begin_nested():
            return read()
    except DBAPIError as error:
        if not is_damage(error):
            raise
    return otherwise()


@contextmanager
def sqlite_faults_translated() -> Iterator[None]:
    """Raises faults of SQLite as RequestError where a caller can act on them."""
    try:
        yield
    except DBAPIError as error:
        translated = _translate_sqlite(error)
        if translated is None:
            raise
        raise translated from error


@contextmanager
def postgresql_faults_translated() -> Iterator[None]:
    """Raises faults of PostgreSQL as RequestError where a caller can act on them."""
    try:
        yield
    except PoolTimeoutError as error:
        raise _unavailable("the store is busy") from error
    except DBAPIError as error:
        translated = _translate_postgresql(error)
        if translated is None:
            raise
        raise translated from error.orig


def _translate_sqlite(error: DBAPIError) -> RequestError | None:
    text = str(error.orig)
    if is_damage(error):
        return DamagedPages()
    if "is locked" in text:
        return Unavailable("the store is busy", retry_after_s=RETRY_AFTER_S)
    if "is full" in text:
        return _full()
    if "readonly database" in text:
        return FailedPrecondition("the store can only be read", reason="STORE_READ_ONLY")
    if any(it in text for it in _SQLITE_BROKEN):
        return _unavailable("the store's disk fails")
    return None


def _translate_postgresql(error: DBAPIError) -> RequestError | None:
    state: str = getattr(error.orig, "sqlstate", None) or ""
    if state.startswith(_POSTGRESQL_FULL):
        return _full()
    if is_damage(error):
        return DamagedPages()
    if state.startswith(_POSTGRESQL_BUSY):
        return _unavailable("the store is busy")
    # The library's own faults have no state: it cannot connect, or the connection broke.
    is_away = error.connection_invalidated or type(error.orig).__name__ == "OperationalError"
    if state.startswith(_POSTGRESQL_AWAY) or (not state and is_away):
        return _unavailable("the store is not there")
    return None


def _full() -> Overloaded:
    return Overloaded("the store's disk is full", reason="STORE_FULL")


def _unavailable(message: str) -> Unavailable:
    return Unavailable(message, reason="STORE_UNAVAILABLE", retry_after_s=RETRY_AFTER_S)
