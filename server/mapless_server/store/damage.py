"""Pages of the database that are not what was written: how that is told, and how the one row that lies there is found.

A damaged page fails every statement that comes to it, so that one damaged photograph would take along all that were
asked for together with it. So where a statement about many fails, they are asked for one by one.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

from sqlalchemy import Connection
from sqlalchemy.exc import DBAPIError

from mapless_server.errors import DataLoss

T = TypeVar("T")

_SQLITE = ("malformed", "not a database", "Could not decode")
"""Its texts, which have not changed in decades; error codes reach Python from 3.11 on only."""
_POSTGRESQL = ("XX001", "XX002")
"""Data corrupted, index corrupted."""


class DamagedPages(DataLoss):
    """The database cannot read its own pages; whose they are is not known yet."""

    def __init__(self) -> None:
        super().__init__("the store is damaged")


def is_damage(error: DBAPIError) -> bool:
    """Whether a fault of either database says that pages are damaged."""
    state = getattr(error.orig, "sqlstate", None)
    return state in _POSTGRESQL if state else any(it in str(error.orig) for it in _SQLITE)


def unless_damaged(connection: Connection, work: Callable[[], T], otherwise: Callable[[], T]) -> T:
    """Does work of the connection's transaction, and, where that comes to a damaged page, does something else."""
    try:
        with connection.begin_nested():
            return work()
    except DBAPIError as error:
        if not is_damage(error):
            raise
    return otherwise()
