"""The interface of the store's databases: SQLite in a folder, or a PostgreSQL that several servers share."""

from contextlib import AbstractContextManager
from typing import Protocol

from sqlalchemy import Connection


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

    def lift_limits(self, connection: Connection) -> None:
        """Lifts the time limits of a transaction that no caller waits for."""
        ...

    def free_space(self) -> None:
        """Frees disk space that the database does not need for data, as far as that is quick; outside transactions."""
        ...

    def close(self) -> None:
        """Closes all connections; no transaction may be running."""
        ...
