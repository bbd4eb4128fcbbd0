"""The store: what the service calls. Every public method is one transaction, and safe from any thread."""

from __future__ import annotations

from pathlib import Path
from types import TracebackType

from .cache import LruCache
from .changing import ChangingStore
from .database import Database
from .postgresql import PostgresqlDatabase
from .reading import ReadingStore
from .records import DescribedReference
from .sqlite import SqliteDatabase

DEFAULT_CACHE_BYTES = 512 * 2**20
"""About 500 references with 2048 SIFT features each; 0 reads the database every time."""


class Store(ReadingStore, ChangingStore):
    """Scenes and their references, in one database: of a data folder, or one that several servers share.

    A scene's key says whose it is. Answers and messages name it by its id, which is all that its tenant knows.

    DataLoss is raised wherever stored bytes turn out not to be what was stored; other references are still served, and
    the damaged one can be deleted. Unavailable is raised while the database is not there or busy; the next call tries
    anew. A change that ends so may yet have been made: who tries again then meets AlreadyExists.

    Attributes:
        observer: hears of every operation.
    """

    @staticmethod
    def open(data_dir: Path, cache_bytes: int = DEFAULT_CACHE_BYTES) -> Store:
        """Open the store of a data folder; creates both if missing.

        Args:
            data_dir: a folder on a local disk that no other server uses.
            cache_bytes: bound of the features held in memory, 0 or more.

        Raises:
            StoreError: the folder or the database cannot be used, with one sentence that says why.
            ValueError: cache_bytes is negative.
        """
        described: LruCache[DescribedReference] = LruCache(cache_bytes)
        return Store._resumed(SqliteDatabase.open(data_dir), described)

    @staticmethod
    def connect(database_url: str, cache_bytes: int = DEFAULT_CACHE_BYTES) -> Store:
        """Open the store of a PostgreSQL database, which other servers may use, too; tables are made if missing.

        Args:
            database_url: "postgresql://user:password@host:5432/database"; libpq's options may follow after "?".
            cache_bytes: bound of the features held in memory, 0 or more.

        Raises:
            StoreError: the database cannot be reached or used, with one sentence that says why, without the password.
            ValueError: cache_bytes is negative.
        """
        described: LruCache[DescribedReference] = LruCache(cache_bytes)
        return Store._resumed(PostgresqlDatabase.open(database_url), described)

    @staticmethod
    def _resumed(database: Database, described: LruCache[DescribedReference]) -> Store:
        """A store that goes on with what the one before it has left."""
        store = Store(database, described)
        store._leftovers.resume()
        return store

    @property
    def database(self) -> Database:
        """What it is kept in."""
        return self._database

    def uncached(self) -> Store:
        """The same database for one who reads what queries do not: their memory and its counts are left alone.

        It lives as long as this store, is not closed, and is only read.
        """
        return Store(self._database, LruCache(0), name_cache_bytes=0)

    @property
    def reference_cache(self) -> LruCache[DescribedReference]:
        """The features held in memory."""
        return self._described

    def close(self) -> None:
        """Release the data folder; no call may be in progress or follow."""
        self._leftovers.close()
        self._database.close()

    def __enter__(self) -> Store:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()
