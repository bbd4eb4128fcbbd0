"""Keeps scenes and their references: rows, image bytes and features in one transactional database."""

from mapless_server.store.records import (
    DescribedReference,
    NewReference,
    ReferencePose,
    ReferenceRecord,
    SceneRecord,
    SceneSnapshot,
)
from mapless_server.store.sqlite import StoreError
from mapless_server.store.store import Store

__all__ = [
    "DescribedReference",
    "NewReference",
    "ReferencePose",
    "ReferenceRecord",
    "SceneRecord",
    "SceneSnapshot",
    "Store",
    "StoreError",
]
