"""What reading and changing the store share: the database, and what is remembered of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from sqlalchemy import Connection

from mapless_server.errors import RequestError

from .cache import LruCache
from .database import Database
from .leftovers import Leftovers
from .observed import StoreObserver, Unobserved
from .records import DescribedReference, SceneAttributes

NAME_CACHE_BYTES = 16 * 2**20
UNWRITABLE = frozenset({"STORE_READ_ONLY", "STORE_FULL", "STORE_UNAVAILABLE"})
"""Reasons of faults after which the next change would most likely fail, too."""


@dataclass(frozen=True)
class Resolved:
    """What a scene's reference ids meant while the store was in a state.

    Attributes:
        state: the store's, see `BaseStore`.
        generation: the scene's.
        keys: of the references, in the order of their ids.
    """

    state: object
    generation: int
    keys: tuple[str, ...]


@dataclass(frozen=True)
class Attributes:
    """What was known of a scene as a whole while the store was in a state, see `BaseStore`."""

    state: object
    attributes: SceneAttributes


class BaseStore:
    """A database and what is remembered of it.

    Attributes:
        write_fault: why the last change could not be written, one of `UNWRITABLE`; empty if it could.
    """

    def __init__(
        self, database: Database, described: LruCache[DescribedReference], name_cache_bytes: int = NAME_CACHE_BYTES
    ) -> None:
        self._database = database
        self._leftovers = Leftovers(database)
        self.observer: StoreObserver = Unobserved()
        # By (key, extractor): references never change and keys are never reused, so no entry is ever stale.
        self._described = described
        # What names meant, by scene and names. Where this process alone writes, it holds as long as nothing was written
        # since, and the database is not asked at all; where others write, as long as the generation is the same.
        self._resolved: LruCache[Resolved] = LruCache(name_cache_bytes)
        self._attributes: LruCache[Attributes] = LruCache(name_cache_bytes)
        self._state = object()
        self._deletion = object()
        self.write_fault = ""

    @contextmanager
    def _changing(self) -> Iterator[Connection]:
        """A transaction that writes; what is remembered of before is void when it is over, however it ends."""
        try:
            with self._database.write() as connection:
                yield connection
            self.write_fault = ""
        except RequestError as error:
            if error.reason in UNWRITABLE:
                self.write_fault = error.reason
            raise
        finally:
            self._state = object()
