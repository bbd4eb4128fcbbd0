"""Keeps scenes and their references: rows, image bytes and features in one transactional database."""

from mapless_server.store.database import StoreError
from mapless_server.store.records import (
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
from mapless_server.store.store import Store

__all__ = [
    "ContradictingDown",
    "DescribedReference",
    "IndexedReference",
    "NewReference",
    "ReferenceRecord",
    "SceneAttributes",
    "SceneChanges",
    "SceneRecord",
    "SceneSnapshot",
    "Store",
    "StoreError",
]
