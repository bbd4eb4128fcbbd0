"""What the faults of SQLite mean for a caller. Knows them by their texts, which have not changed in decades.

Error codes reach Python from 3.11 on only.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from sqlalchemy.exc import DBAPIError

from mapless_server.errors import FailedPrecondition, Overloaded, RequestError, Unavailable

from .damage import DamagedPages, is_damage

RETRY_AFTER_S = 1.0
_BROKEN = ("disk I/O error", "unable to open database file")


@contextmanager
def faults_translated() -> Iterator[None]:
    """Turn the faults of the database that a caller can act on into answers; the rest is INTERNAL."""
    try:
        yield
    except DBAPIError as error:
        answer = DamagedPages() if is_damage(error) else _answer_to(str(error.orig))
        if answer is None:
            raise
        raise answer from error


def _answer_to(fault: str) -> RequestError | None:
    if "is locked" in fault:
        return Unavailable("the store is busy", retry_after_s=RETRY_AFTER_S)
    if "is full" in fault:
        return Overloaded("the store's disk is full", reason="STORE_FULL")
    if "readonly database" in fault:
        return FailedPrecondition("the store can only be read", reason="STORE_READ_ONLY")
    if any(it in fault for it in _BROKEN):
        return Unavailable("the store's disk fails", reason="STORE_UNAVAILABLE", retry_after_s=RETRY_AFTER_S)
    return None
