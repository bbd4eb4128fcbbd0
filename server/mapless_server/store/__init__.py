"""Persistence: scenes and references with their images and features, in one transactional database.

May import security, method and images. Begin with `Store` (store.py), whose values are in `records`, and with
`PairStore` (pairs.py) for the matches of pairs of references; `tables` is the schema. Rows become values in `rows` and
`codec`, which check every byte. `sqlite` and `postgresql` are the databases; `backup` and `verify` are what the `store`
commands do.
"""

from .cache import LruCache
from .database import StoreError
from .pairs import Claim, Pair, PairStore, Progress
from .records import (
    ContradictingDown,
    DatumWithoutMetres,
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
    "Claim",
    "ContradictingDown",
    "DatumWithoutMetres",
    "DescribedReference",
    "IndexedReference",
    "LruCache",
    "NewReference",
    "Pair",
    "PairStore",
    "Progress",
    "ReferenceRecord",
    "SceneAttributes",
    "SceneChanges",
    "SceneRecord",
    "SceneSnapshot",
    "Store",
    "StoreError",
    "time_us",
]
