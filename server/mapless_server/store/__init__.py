"""Persistence: scenes and references with their images and features, in one transactional database.

May import security, method and images. Begin with `Store` (store.py), whose values are in `records`; `tables` is the
schema. Rows become values in `rows` and `codec`, which check every byte. `sqlite` and `postgresql` are the databases;
`backup` and `verify` are what the `store` commands do.
"""

from .cache import LruCache
from .database import StoreError
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
from .store import Store

__all__ = [
    "ContradictingDown",
    "DescribedReference",
    "IndexedReference",
    "LruCache",
    "NewReference",
    "ReferenceRecord",
    "SceneAttributes",
    "SceneChanges",
    "SceneRecord",
    "SceneSnapshot",
    "Store",
    "StoreError",
    "time_us",
]
