"""Scenes in memory: a damaged reference affects no other one, and memory is counted."""

import logging
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.images import encode, textured
from support.servers import CAMERA, StandInDescriptor, StandInExtractor, pose
from support.stores import damage

from mapless_server.errors import DataLoss, NotFound
from mapless_server.method.options import StageContext
from mapless_server.scenes.indexes import SceneIndexes
from mapless_server.scenes.library import ReferenceLibrary
from mapless_server.security import DEFAULT_TENANT, SceneKey
from mapless_server.store import NewReference, SceneChanges, Store

SCENE = SceneKey("s")
EXTRACTOR, DESCRIPTOR = StandInExtractor(), StandInDescriptor()
IMAGES = [textured(seed=i) for i in range(3)]


def new(i: int, is_described: bool) -> NewReference:
    descriptors = {DESCRIPTOR.name: np.eye(16, dtype=np.float32)[i]} if is_described else {}
    views = {EXTRACTOR.name: EXTRACTOR.extract(IMAGES[i], CAMERA)}
    return NewReference(f"r{i}", encode(".png", IMAGES[i]), CAMERA, pose(float(i)), views, descriptors)


@pytest.fixture
def store(tmp_path: Path) -> Iterator[Store]:
    with Store.open(tmp_path) as store:
        store.create_scene(SCENE)
        yield store


def indexes_of(store: Store, capacity_bytes: int = 2**30) -> SceneIndexes:
    return SceneIndexes(store, ReferenceLibrary(store), DESCRIPTOR, EXTRACTOR, capacity_bytes)


def test_who_does_not_wait_gets_what_any_server_has_described(store: Store) -> None:
    records = store.add_references(SCENE, [new(i, is_described=False) for i in range(3)])
    generation, other = store.get_generation(SCENE), indexes_of(store)
    indexes = indexes_of(store)
    assert len(indexes.entries(SCENE, StageContext(), waits=False).undescribed()) == 3
    context = StageContext()
    other.entries(SCENE, context, waits=False)
    other.describe(SCENE, [(it.reference_id, it.key) for it in records[:2]], context)
    assert indexes.entries(SCENE, StageContext(), waits=False).undescribed() == [("r2", records[2].key)]
    assert context.lacking == {("retrieval", DESCRIPTOR.name, it.key): True for it in records[:2]}
    late = StageContext(make_until_s=-math.inf)
    indexes.describe(SCENE, [("r2", records[2].key)], late)
    assert late.lacking == {("retrieval", DESCRIPTOR.name, records[2].key): False}
    assert store.get_generation(SCENE) == generation, "descriptors are no change of the scene"


def test_how_far_references_reach_is_known_of_the_generation_that_was_read(store: Store) -> None:
    store.add_references(SCENE, [new(i, is_described=True) for i in range(3)])
    indexes, before = indexes_of(store), store.find_scenes(DEFAULT_TENANT)
    assert indexes.extents_m(before).tolist() == [math.inf]
    indexes.entries(SCENE, StageContext())
    assert indexes.extents_m(before).tolist() == [np.linalg.norm(pose(2.0).translation)]
    store.delete_reference(SCENE, "r2")
    assert indexes.extents_m(store.find_scenes(DEFAULT_TENANT)).tolist() == [math.inf]


class TestDamage:
    def test_one_that_fails_is_tried_and_reported_once(self, store: Store, caplog: pytest.LogCaptureFixture) -> None:
        store.add_references(SCENE, [new(i, is_described=False) for i in range(3)])
        damage(store, SCENE, "r1", "features")
        indexes = indexes_of(store)
        with caplog.at_level(logging.INFO):
            entries = [indexes.entries(SCENE, StageContext()) for _ in range(3)][-1]
        assert len(entries) == 3
        assert [reference_id for reference_id, _ in entries.undescribed()] == ["r1"]
        assert [it.getMessage() for it in caplog.records if it.levelno >= logging.ERROR] == [
            "reference r1 of scene s is not used: reference 'r1' is damaged in the store (features); delete it and "
            "add it again"
        ]
        assert sum("describing" in it.getMessage() for it in caplog.records) == 1

    @pytest.mark.parametrize("what", ["descriptor", "pose"])
    def test_one_left_out_differs_from_one_that_is_absent(self, store: Store, what: str) -> None:
        store.add_references(SCENE, [new(i, is_described=True) for i in range(3)])
        damage(store, SCENE, "r1", what)
        indexes = indexes_of(store)
        entries = indexes.entries(SCENE, StageContext())
        assert [it in entries for it in ("r0", "r1", "r2")] == [True, False, True]
        assert [indexes.is_damaged(SCENE, it) for it in ("r0", "r1", "r2", "absent")] == [False, True, False, False]

    def test_a_deleted_one_is_no_longer_damaged_and_may_return(self, store: Store) -> None:
        store.add_references(SCENE, [new(i, is_described=True) for i in range(3)])
        damage(store, SCENE, "r1", "descriptor")
        indexes = indexes_of(store)
        indexes.entries(SCENE, StageContext())
        store.delete_reference(SCENE, "r1")
        assert not indexes.is_damaged(SCENE, "r1")
        store.add_references(SCENE, [new(1, is_described=True)])
        assert "r1" in indexes.entries(SCENE, StageContext())
        assert not indexes.is_damaged(SCENE, "r1")


class TestMemory:
    @pytest.mark.parametrize("is_described", [True, False])
    def test_one_that_is_deleted_while_it_is_asked_takes_none(
        self, store: Store, is_described: bool, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Neither what has been read of it by then, nor what was found out after."""
        store.add_references(SCENE, [new(i, is_described) for i in range(3)])
        indexes = indexes_of(store)
        real = store.list_changes

        def read_then_delete(*arguments: Any) -> SceneChanges:
            changes = real(*arguments)
            store.delete_scene(SCENE)
            indexes.forget(SCENE)
            return changes

        monkeypatch.setattr(store, "list_changes", read_then_delete)
        if is_described:
            assert len(indexes.entries(SCENE, StageContext())) == 3
        else:
            with pytest.raises(NotFound):
                indexes.entries(SCENE, StageContext())
        assert not indexes.is_damaged(SCENE, "r0")
        indexes.report_damaged(SCENE, "r0", DataLoss("lost"))
        assert (indexes.size_bytes, dict(indexes._cached._entries)) == (0, {})

    def test_least_recently_used_scenes_make_room_the_last_stays(self, store: Store) -> None:
        keys = [SceneKey(f"many-{i}") for i in range(4)]
        for key in keys:
            store.create_scene(key)
        one = indexes_of(store)
        one.entries(keys[0], StageContext())
        two = indexes_of(store, capacity_bytes=2 * one.size_bytes)
        for key in (*keys, keys[2]):
            two.entries(key, StageContext())
        assert list(two._cached._entries) == [keys[3], keys[2]]
        assert two.size_bytes == 2 * one.size_bytes
        none = indexes_of(store, capacity_bytes=0)
        for key in keys:
            none.entries(key, StageContext())
        assert list(none._cached._entries) == [keys[3]]
