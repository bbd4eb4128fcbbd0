"""Every operation of the store is heard of once, whoever uses it; failures are those that no caller can help."""

from __future__ import annotations

import inspect
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest

from mapless.geometry import Camera, RigidTransform
from mapless_server import errors
from mapless_server.method.views import Features, View
from mapless_server.security import SceneKey
from mapless_server.store import NewReference, Store, sqlite

HALL = SceneKey("hall")
CAMERA = Camera(640, 480, 500.0, 500.0, 319.5, 239.5)


@dataclass
class Heard:
    operations: list[str] = field(default_factory=list)
    failures: int = 0

    def stored(self, operation: str, seconds: float) -> None:
        assert seconds >= 0
        self.operations.append(operation)

    def store_failed(self) -> None:
        self.failures += 1


@pytest.fixture
def heard() -> Heard:
    return Heard()


@pytest.fixture
def store(tmp_path: Path, heard: Heard) -> Iterator[Store]:
    with Store.open(tmp_path / "data") as store:
        store.observer = heard
        yield store


def reference(reference_id: str, features: int = 3) -> NewReference:
    found = Features(
        np.zeros((features, 2), np.float32), np.zeros((features, 128), np.float32), np.ones(features, np.float32)
    )
    pose = RigidTransform(np.eye(3), np.zeros(3))
    return NewReference(reference_id, b"image", CAMERA, pose, {"sift": View(CAMERA, found)})


def test_no_operation_is_unheard() -> None:
    methods = {name for name, _ in inspect.getmembers(Store, inspect.isfunction) if not name.startswith("_")}
    heard_of = {name for name in methods if hasattr(getattr(Store, name), "__wrapped__")}
    assert methods - heard_of == {"open", "connect", "close", "uncached"}


def test_each_is_heard_of_once_and_misuse_is_no_failure(store: Store, heard: Heard) -> None:
    store.create_scene(HALL)
    store.add_references(HALL, [reference("a")])
    store.load_references(HALL, ["a"], "sift")
    with pytest.raises(errors.AlreadyExists):
        store.create_scene(HALL)
    with pytest.raises(errors.NotFound):
        store.get_reference(HALL, "b")
    assert heard.operations == ["create_scene", "add_references", "load_references", "create_scene", "get_reference"]
    assert heard.failures == 0


def test_a_full_disk_is_a_failure(store: Store, heard: Heard) -> None:
    store.create_scene(HALL)
    with store._database.read() as connection:
        pages = connection.exec_driver_sql("PRAGMA page_count").scalar()
        connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")
    with pytest.raises(errors.Overloaded, match="full"):
        store.add_references(HALL, [reference(it, 200) for it in "abc"])
    assert (heard.operations[-1], heard.failures) == ("add_references", 1)


def test_a_busy_database_is_a_failure(tmp_path: Path, heard: Heard, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sqlite, "BUSY_TIMEOUT_MS", 10)
    with Store.open(tmp_path / "data") as store:
        store.observer = heard
        other = sqlite.choose_library().connect(tmp_path / "data" / sqlite.DATABASE_FILE, isolation_level=None)
        try:
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(errors.Unavailable, match="busy"):
                store.create_scene(HALL)
        finally:
            other.close()
    assert (heard.operations, heard.failures) == (["create_scene"], 1)


@pytest.mark.parametrize("forgotten", [[], ["b"], ["a", "b"]])
def test_hits_and_misses_are_counted_once_for_each_reference(store: Store, forgotten: list[str]) -> None:
    store.create_scene(HALL)
    records = store.add_references(HALL, [reference(it) for it in "ab"])
    cache = store.reference_cache
    store.load_references(HALL, ["a", "b"], "sift")
    assert (cache.hits, cache.misses) == (0, 2)
    for record in records:
        if record.reference_id in forgotten:
            del cache._entries[record.key, "sift"]
    loaded = store.load_references(HALL, ["a", "b"], "sift")
    assert [it.record.reference_id for it in loaded.references] == ["a", "b"]
    assert (cache.hits, cache.misses) == (2 - len(forgotten), 2 + len(forgotten))
