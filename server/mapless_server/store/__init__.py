"""Persistence: scenes and references with their images and features, in one transactional database.

May import security, method and images. Begin with `Store` (store.py), whose values are in `records`; `tables` is the
schema. Rows become values in `rows` and `codec`, which check every byte. `sqlite` and `postgresql` are the databases;
`backup` and `verify` are what the `store` commands do.
"""

from .backup import back_up, restore
from .cache import LruCache
from .database import Database, StoreError
from .postgresql import PostgresqlDatabase
from .records import (
    ContradictingDown,
    DescribedReference,
    IndexedReference,
    NewReference,
    ReferenceRecord,
    SceneAttributes,
    SceneChanges,
    SceneRecord,
    SceneSnapshot,
)
from .rows import time_us
from .sqlite import DATABASE_FILE, SqliteDatabase
from .store import Store
from .tables import SCHEMA_VERSION
from .verification import Progress, Verification, verify

__all__ = [
    "DATABASE_FILE",
    "SCHEMA_VERSION",
    "ContradictingDown",
    "Database",
    "DescribedReference",
    "IndexedReference",
    "LruCache",
    "NewReference",
    "PostgresqlDatabase",
    "Progress",
    "ReferenceRecord",
    "SceneAttributes",
    "SceneChanges",
    "SceneRecord",
    "SceneSnapshot",
    "SqliteDatabase",
    "Store",
    "StoreError",
    "Verification",
    "back_up",
    "restore",
    "time_us",
    "verify",
]
