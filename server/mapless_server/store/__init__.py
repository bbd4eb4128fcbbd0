"""Keeps scenes and their references: rows, image bytes and features in one transactional database."""

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
from .store import Store

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
