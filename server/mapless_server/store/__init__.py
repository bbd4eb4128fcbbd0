"""Keeps scenes and their references: rows, image bytes and features in one transactional database."""

from mapless_server.store.database import StoreError
from mapless_server.store.records import (
    DescribedReference,
    IndexedReference,
    NewReference,
    ReferenceRecord,
    SceneChanges,
    SceneRecord,
    SceneSnapshot,
)
from mapless_server.store.store import Store

__all__ = [
    "DescribedReference",
    "IndexedReference",
    "NewReference",
    "ReferenceRecord",
    "SceneChanges",
    "SceneRecord",
    "SceneSnapshot",
    "Store",
    "StoreError",
]
