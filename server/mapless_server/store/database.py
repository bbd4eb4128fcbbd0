"""The seam between the store and what keeps it: SQLite in a folder, or a PostgreSQL that several servers share."""

from __future__ import annotations

from contextlib import AbstractContextManager
from typing import Protocol

from sqlalchemy import Connection


class StoreError(Exception):
    """The store cannot be opened, copied or checked; the message is one sentence for the operator."""


class Database(Protocol):
    """Transactions of one database; safe for many threads. Its faults are those of `errors` that a caller can act on.

    Attributes:
        is_shared: whether other processes may change it. If so, nothing remembered is believed without its generation.
        only_reads: whether every change is refused.
        name: for messages.
    """

    @property
    def is_shared(self) -> bool:
        """See the class."""
        ...

    @property
    def only_reads(self) -> bool:
        """See the class."""
        ...

    @property
    def name(self) -> str:
        """See the class."""
        ...

    def read(self) -> AbstractContextManager[Connection]:
        """A transaction that sees one moment of the database throughout."""
        ...

    def write(self) -> AbstractContextManager[Connection]:
        """A transaction that is on the disk, whole, when the block is left, or not at all if it raises.

        Where the database lets several writers in, each statement sees what was committed before it began. The changes
        of a scene are ordered by its generation, which each raises before it looks at anything: that row is their lock.
        """
        ...

    def take_your_time(self, connection: Connection) -> None:
        """Lift the limits of a transaction, which is no call that somebody waits for."""
        ...

    def make_room(self) -> None:
        """Free what the database takes of the disk beside its data, as far as that can be done soon.

        The caller has no transaction.
        """
        ...

    def close(self) -> None:
        """Close all connections; nothing may be reading or writing."""
        ...
