"""The store keeps its promises: exact, atomic, ordered, checked."""

from __future__ import annotations

import logging
import math
import os
import sqlite3
import struct
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy.exc import IntegrityError

from mapless.geometry import Camera, Distortion, Fisheye, RadialTangential, RigidTransform, rotation_from_vector
from mapless_server import errors
from mapless_server.method.views import Features, View
from mapless_server.principal import DEFAULT_TENANT
from mapless_server.store import NewReference, Store, StoreError, codec, sqlite
from mapless_server.store.cache import LruCache
from mapless_server.tenancy import SceneKey

EXTRACTOR = "sift"
OFFICE, HALL, SCENE, NOWHERE = map(SceneKey, ("office", "hall", "scene", "nowhere"))


def make_reference(
    reference_id: str, seed: int = 0, count: int = 20, distortion: Distortion | None = None
) -> NewReference:
    """A reference whose every number follows from the seed and uses all bits."""
    random = np.random.default_rng(seed)
    focal_x_px, focal_y_px, principal_x_px, principal_y_px = random.uniform(300, 900, 4).tolist()
    camera = Camera(640, 480, focal_x_px, focal_y_px, principal_x_px, principal_y_px, distortion)
    pose = RigidTransform(rotation_from_vector(random.normal(size=3)), random.normal(size=3) * 1e3)
    image = random.bytes(5000)
    view = View(camera.pinhole(), make_features(random, count))
    return NewReference(reference_id, image, camera, pose, {EXTRACTOR: view})


def view_of(new: NewReference) -> View:
    return new.views[EXTRACTOR]


def make_features(random: np.random.Generator, count: int) -> Features:
    return Features(
        random.uniform(0, 640, (count, 2)).astype(np.float32),
        random.normal(size=(count, 128)).astype(np.float32),
        random.uniform(1, 30, count).astype(np.float32),
    )


def assert_same_bits(actual: np.ndarray, expected: np.ndarray) -> None:
    assert actual.dtype == expected.dtype
    assert actual.shape == expected.shape
    assert actual.tobytes() == expected.tobytes()


def assert_same_view(actual: View, expected: View) -> None:
    assert actual.camera == expected.camera
    assert_same_bits(actual.features.keypoints, expected.features.keypoints)
    assert_same_bits(actual.features.descriptors, expected.features.descriptors)
    assert_same_bits(actual.features.sizes_px, expected.features.sizes_px)


def execute(data_dir: Path, statement: str, *parameters: object) -> None:
    """Reach into the database behind the store's back."""
    connection = connect(data_dir)
    with connection:
        changed = connection.execute(statement, parameters).rowcount
    connection.close()
    assert changed != 0, "the tampering changed nothing"


def connect(data_dir: Path) -> sqlite3.Connection:
    """With the store's own library: another one in the same process would neither see nor keep its locks."""
    connection: sqlite3.Connection = sqlite.choose_library().connect(data_dir / sqlite.DATABASE_FILE, timeout=0)
    return connection


@pytest.fixture
def data_dir(tmp_path: Path) -> Path:
    return tmp_path / "data"


@pytest.fixture
def store(data_dir: Path) -> Iterator[Store]:
    with Store.open(data_dir) as store:
        yield store


class TestScenes:
    def test_created_scene_is_found(self, store: Store) -> None:
        created = store.create_scene(OFFICE)
        assert created.scene_id == "office"
        assert created.generation == 1
        assert created.reference_count == 0
        assert created.create_time.utcoffset() is not None
        assert store.get_scene(OFFICE) == created
        assert store.list_scenes(DEFAULT_TENANT, 10) == [created]

    def test_taken_id_is_refused_and_changes_nothing(self, store: Store) -> None:
        created = store.create_scene(OFFICE)
        with pytest.raises(errors.AlreadyExists):
            store.create_scene(OFFICE)
        assert store.get_scene(OFFICE) == created

    def test_everything_of_an_unknown_scene_is_not_found(self, store: Store) -> None:
        calls = (
            lambda: store.get_scene(NOWHERE),
            lambda: store.delete_scene(NOWHERE),
            lambda: store.add_references(NOWHERE, [make_reference("a")]),
            lambda: store.get_reference(NOWHERE, "a"),
            lambda: store.read_image(NOWHERE, "a"),
            lambda: store.list_references(NOWHERE, 10),
            lambda: store.delete_reference(NOWHERE, "a"),
            lambda: store.list_poses(NOWHERE),
            lambda: store.load_references(NOWHERE, None, EXTRACTOR),
            lambda: store.load_references(NOWHERE, ["a"], EXTRACTOR),
        )
        for call in calls:
            with pytest.raises(errors.NotFound, match="nowhere") as caught:
                call()
            assert caught.value.field == "scene"

    def test_deleted_scene_takes_its_references_along(self, store: Store, data_dir: Path) -> None:
        store.create_scene(OFFICE)
        store.create_scene(HALL)
        store.add_references(OFFICE, [make_reference("a")])
        store.add_references(HALL, [make_reference("a")])
        store.delete_scene(OFFICE)
        assert [scene.scene_id for scene in store.list_scenes(DEFAULT_TENANT, 10)] == ["hall"]
        connection = connect(data_dir)
        for table in ("reference", "image", "features"):
            assert connection.execute(f"SELECT count(*) FROM {table}").fetchone() == (1,), table
        connection.close()


class TestGenerations:
    def test_every_change_raises_and_nothing_else_does(self, store: Store) -> None:
        store.create_scene(OFFICE)
        changes = (
            lambda: store.add_references(OFFICE, [make_reference("a"), make_reference("b")]),
            lambda: store.add_references(OFFICE, [make_reference("c")]),
            lambda: store.delete_reference(OFFICE, "b"),
        )
        view = view_of(make_reference("a"))

        def add_features(extractor: str) -> None:
            store.add_features(store.get_reference(OFFICE, "a").key, extractor, view)

        others = (
            lambda: add_features("other"),
            lambda: store.get_reference(OFFICE, "a"),
            lambda: store.load_references(OFFICE, None, EXTRACTOR),
            lambda: store.create_scene(HALL),
        )
        refused = (
            lambda: store.create_scene(OFFICE),
            lambda: store.add_references(OFFICE, [make_reference("a")]),
            lambda: add_features(EXTRACTOR),
            lambda: store.add_features("no such key", EXTRACTOR, view),
            lambda: store.delete_reference(OFFICE, "z"),
        )
        generation = 1
        for change in changes:
            change()
            assert store.get_scene(OFFICE).generation > generation
            generation = store.get_scene(OFFICE).generation
        for read in others:
            read()
        for call in refused:
            with pytest.raises(errors.RequestError):
                call()
        assert store.get_scene(OFFICE).generation == generation

    def test_a_new_life_repeats_no_generation(self, data_dir: Path) -> None:
        seen: list[int] = []
        for _ in range(3):
            with Store.open(data_dir) as store:
                seen.append(store.create_scene(OFFICE).generation)
                store.add_references(OFFICE, [make_reference("a")])
                seen.append(store.get_scene(OFFICE).generation)
                store.delete_scene(OFFICE)
        assert seen == sorted(set(seen))

    def test_a_new_life_repeats_no_key(self, store: Store) -> None:
        store.create_scene(OFFICE)
        keys = set()
        for seed in range(3):
            keys.add(store.add_references(OFFICE, [make_reference("a", seed)])[0].key)
            snapshot = store.load_references(OFFICE, ["a"], EXTRACTOR)
            assert_same_view(snapshot.references[0].view, view_of(make_reference("a", seed)))
            store.delete_reference(OFFICE, "a")
        assert len(keys) == 3


class TestReferences:
    @pytest.mark.parametrize(
        "distortion",
        [
            None,
            RadialTangential(0.1, -1 / 3, 1e-17, -0.0, math.nextafter(0.2, 1)),
            Fisheye(0.1, 5e-324, -1 / 3, 1.7976931348623157e308),
        ],
    )
    def test_comes_back_bit_for_bit_after_reopening(self, data_dir: Path, distortion: Distortion | None) -> None:
        new = make_reference("a", seed=3, distortion=distortion)
        with Store.open(data_dir) as store:
            store.create_scene(OFFICE)
            (created,) = store.add_references(OFFICE, [new])
        with Store.open(data_dir) as store:
            read = store.get_reference(OFFICE, "a")
            image = store.read_image(OFFICE, "a")
            assert store.read_image_of(created.key) == image
            (loaded,) = store.load_references(OFFICE, ["a"], EXTRACTOR).references
            _, (pose,) = store.list_poses(OFFICE)
        assert image == new.image
        assert read.camera == new.camera
        assert repr(read.camera) == repr(new.camera)  # tells -0.0 from 0.0
        for record in (created, read, loaded.record):
            assert record.key == pose.key
            assert record.feature_count == 20
            assert record.create_time == created.create_time
            assert record.image_sha256 == created.image_sha256
        for transform in (read.world_from_camera, loaded.record.world_from_camera, pose.world_from_camera):
            assert_same_bits(transform.rotation, new.world_from_camera.rotation)
            assert_same_bits(transform.translation, new.world_from_camera.translation)
        assert (loaded.record.scene_id, loaded.record.reference_id) == ("office", "a")
        assert_same_view(loaded.view, view_of(new))

    def test_no_features_and_odd_floats_survive(self, store: Store) -> None:
        store.create_scene(OFFICE)
        bits = np.array([0x7FC00001, 0x80000000, 0x00000001, 0x7F800000], np.uint32).view(np.float32)
        odd = Features(bits.reshape(2, 2), bits.reshape(2, 2), bits[:2])
        none = Features(np.zeros((0, 2), np.float32), np.zeros((0, 128), np.float32), np.zeros(0, np.float32))
        camera = make_reference("x").camera
        for reference_id, features in (("odd", odd), ("none", none)):
            views = {EXTRACTOR: View(camera, features)}
            new = NewReference(reference_id, b"", camera, RigidTransform.identity(), views)
            store.add_references(OFFICE, [new])
            (read,) = store.load_references(OFFICE, [reference_id], EXTRACTOR).references
            assert_same_view(read.view, view_of(new))

    def test_what_cannot_be_kept_exactly_is_refused(self, store: Store) -> None:
        store.create_scene(OFFICE)
        good = make_reference("a")
        double = replace(view_of(good).features, keypoints=view_of(good).features.keypoints.astype(float))
        lost = RigidTransform(np.eye(3), np.array([0.0, np.nan, 0.0]))
        for bad in (
            NewReference("a", b"", good.camera, good.world_from_camera, {EXTRACTOR: View(good.camera, double)}),
            NewReference("a", b"", good.camera, lost, good.views),
        ):
            with pytest.raises(ValueError, match="float"):
                store.add_references(OFFICE, [make_reference("b"), bad])
        assert store.list_references(OFFICE, 10) == []

    @pytest.mark.parametrize("ids", [["new", "taken"], ["new", "other", "new"]])
    def test_a_batch_with_one_bad_id_stores_nothing(self, store: Store, ids: list[str]) -> None:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference("taken")])
        before = store.get_scene(OFFICE)
        with pytest.raises(errors.AlreadyExists, match=ids[-1]) as caught:
            store.add_references(OFFICE, [make_reference(it) for it in ids])
        assert caught.value.field == f"requests[{len(ids) - 1}].reference_id"
        assert store.get_scene(OFFICE) == before
        assert [it.reference_id for it in store.list_references(OFFICE, 10)] == ["taken"]

    def test_references_load_in_the_order_asked(self, store: Store) -> None:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference(it, seed) for seed, it in enumerate("cab")])
        for ids, expected in ((["b", "c", "a"], "bca"), (["c"], "c"), ([], ""), (None, "abc"), (["b", "a"], "ba")):
            snapshot = store.load_references(OFFICE, ids, EXTRACTOR)
            assert [it.record.reference_id for it in snapshot.references] == list(expected)
            assert snapshot.generation == store.get_scene(OFFICE).generation
        with pytest.raises(errors.NotFound, match="'z'") as caught:
            store.load_references(OFFICE, ["a", "z"], EXTRACTOR)
        assert caught.value.field == "references[1]"

    def test_features_are_kept_per_extractor(self, store: Store) -> None:
        store.create_scene(OFFICE)
        new = make_reference("a")
        other = View(view_of(new).camera.resized(320, 240), make_features(np.random.default_rng(9), 7))
        store.add_references(OFFICE, [new])
        snapshot = store.load_references(OFFICE, None, "aliked")
        (lacking,) = snapshot.undescribed
        assert (snapshot.references, lacking.reference_id, lacking.camera) == ((), "a", new.camera)
        assert not store.has_features(lacking.key, "aliked")
        store.add_features(lacking.key, "aliked", other)
        assert store.has_features(lacking.key, "aliked")
        for extractor, expected in (("aliked", other), (EXTRACTOR, view_of(new))):
            snapshot = store.load_references(OFFICE, None, extractor)
            assert_same_view(snapshot.references[0].view, expected)
            assert not snapshot.undescribed

    def test_those_without_features_are_told_apart_in_the_order_asked(self, store: Store) -> None:
        store.create_scene(OFFICE)
        both = {"cheap": view_of(make_reference("x")), "strong": view_of(make_reference("x", 1))}
        news = [replace(make_reference(it, count=1), views=both) for it in "ac"]
        store.add_references(OFFICE, [*news, replace(make_reference("b"), views={"cheap": both["cheap"]})])
        for _ in range(2):  # from the database, then from memory
            snapshot = store.load_references(OFFICE, ["c", "b", "a"], "strong")
            assert [it.record.reference_id for it in snapshot.references] == ["c", "a"]
            assert [it.reference_id for it in snapshot.undescribed] == ["b"]

    def test_features_of_all_extractors_are_stored_with_the_reference_or_not_at_all(
        self, store: Store, data_dir: Path
    ) -> None:
        store.create_scene(OFFICE)
        good, other = make_reference("a", 1), make_reference("a", 2, count=7)
        double = replace(view_of(other).features, sizes_px=np.ones(7))  # type: ignore[arg-type]
        both = replace(good, views={"cheap": view_of(good), "strong": view_of(other)})
        half = replace(good, views={"cheap": view_of(good), "strong": View(good.camera, double)})
        none = replace(good, views={})
        for bad in (half, none):
            with pytest.raises(ValueError, match=r"float32|no features"):
                store.add_references(OFFICE, [bad])
        # Even a failure in the middle of the transaction leaves nothing.
        execute(
            data_dir,
            "CREATE TRIGGER deny BEFORE INSERT ON features WHEN NEW.extractor = 'strong' "
            "BEGIN SELECT RAISE(ABORT, 'denied'); END",
        )
        with pytest.raises(IntegrityError, match="denied"):
            store.add_references(OFFICE, [both])
        execute(data_dir, "DROP TRIGGER deny")
        assert (store.get_scene(OFFICE).generation, store.list_references(OFFICE, 10)) == (1, [])
        (record,) = store.add_references(OFFICE, [both])
        assert (record.feature_count, store.get_scene(OFFICE).generation) == (20, 2)
        for name, view in both.views.items():
            (loaded,) = store.load_references(OFFICE, None, name).references
            assert_same_view(loaded.view, view)

    def test_a_key_is_for_one_image_for_ever(self, store: Store) -> None:
        store.create_scene(OFFICE)
        (old,) = store.add_references(OFFICE, [make_reference("a", 1)])
        store.delete_reference(OFFICE, "a")
        store.add_references(OFFICE, [make_reference("a", 2)])
        for call in (
            lambda: store.read_image_of(old.key),
            lambda: store.add_features(old.key, "other", view_of(make_reference("a", 1))),
        ):
            with pytest.raises(errors.NotFound, match="deleted"):
                call()
        assert not store.has_features(old.key, EXTRACTOR)
        assert len(store.load_references(OFFICE, None, "other").undescribed) == 1

    def test_more_references_than_one_statement_takes(self, store: Store) -> None:
        store.create_scene(OFFICE)
        ids = [f"{index:04}" for index in range(1100)]
        store.add_references(OFFICE, [make_reference(it, count=1) for it in ids])
        assert len(store.load_references(OFFICE, None, EXTRACTOR).references) == 1100
        assert len(store.load_references(OFFICE, ids[::-1], EXTRACTOR).references) == 1100
        assert len(store.list_poses(OFFICE)[1]) == 1100
        with pytest.raises(errors.AlreadyExists):
            store.add_references(OFFICE, [make_reference(it, count=1) for it in ["new", *ids]])

    def test_ids_are_data_not_sql(self, store: Store) -> None:
        nasty = ["'; DROP TABLE scene; --", "../../etc/passwd", '"', "%", "_", "\x00", "a b"]
        for scene_key in map(SceneKey, nasty):
            store.create_scene(scene_key)
            store.add_references(scene_key, [make_reference(it, count=1) for it in nasty])
        for scene_key in map(SceneKey, nasty):
            assert {it.reference_id for it in store.list_references(scene_key, 100)} == set(nasty)
            assert store.read_image(scene_key, "%") == make_reference("%", count=1).image


ids = st.text("ab_-.AZ09", min_size=1, max_size=3)


class TestPages:
    @settings(max_examples=15, deadline=None)
    @given(names=st.sets(ids, max_size=12), limit=st.integers(1, 5))
    def test_pages_are_a_partition_in_order(
        self, tmp_path_factory: pytest.TempPathFactory, names: set[str], limit: int
    ) -> None:
        with Store.open(tmp_path_factory.mktemp("pages")) as store:
            store.create_scene(SCENE)
            for name in names:
                store.create_scene(SceneKey("s" + name))
            if names:
                store.add_references(SCENE, [make_reference(name, count=1) for name in names])
            scene_ids, after = [], ""
            while page := store.list_scenes(DEFAULT_TENANT, limit, after):
                assert len(page) <= limit
                scene_ids += [it.scene_id for it in page]
                after = page[-1].scene_id
            reference_ids, after = [], ""
            while references := store.list_references(SCENE, limit, after):
                assert len(references) <= limit
                reference_ids += [it.reference_id for it in references]
                after = references[-1].reference_id
            poses = [it.reference_id for it in store.list_poses(SCENE)[1]]
            assert store.get_scene(SCENE).reference_count == len(names)
        assert scene_ids == sorted({"scene", *("s" + name for name in names)})
        assert reference_ids == poses == sorted(names)


class TestMemory:
    def test_repeated_load_reads_no_blob(self, store: Store, data_dir: Path) -> None:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference("a"), make_reference("b")])
        first = store.load_references(OFFICE, ["a", "b"], EXTRACTOR)
        execute(data_dir, "UPDATE features SET data = x'00'")
        store.add_references(OFFICE, [make_reference("c")])
        again = store.load_references(OFFICE, ["b", "a", "c"], EXTRACTOR)
        assert again.references[0] is first.references[1]
        assert again.references[1] is first.references[0]
        assert again.generation > first.generation

    def test_shared_arrays_cannot_be_written(self, store: Store) -> None:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference("a")])
        (loaded,) = store.load_references(OFFICE, None, EXTRACTOR).references
        for array in (
            loaded.view.features.keypoints,
            loaded.view.features.descriptors,
            loaded.record.world_from_camera.translation,
        ):
            with pytest.raises(ValueError, match="read-only"):
                array[:] = 0

    def test_poses_follow_changes(self, store: Store) -> None:
        store.create_scene(OFFICE)
        assert store.list_poses(OFFICE) == (1, ())
        store.add_references(OFFICE, [make_reference("a")])
        generation, poses = store.list_poses(OFFICE)
        assert [it.reference_id for it in poses] == ["a"]
        assert store.list_poses(OFFICE)[1] is poses
        store.delete_reference(OFFICE, "a")
        assert store.list_poses(OFFICE) == (generation + 1, ())

    @given(
        capacity=st.integers(0, 20),
        operations=st.lists(st.tuples(st.booleans(), st.integers(0, 4), st.integers(0, 12)), max_size=40),
    )
    def test_cache_behaves_as_a_list_ordered_by_use(
        self, capacity: int, operations: list[tuple[bool, int, int]]
    ) -> None:
        cache: LruCache[int] = LruCache(capacity)
        plain: list[tuple[int, int]] = []
        for is_put, key, size in operations:
            held = next((entry for entry in plain if entry[0] == key), None)
            if is_put and size <= capacity:
                cache.put(key, size, size)
                plain = [entry for entry in plain if entry[0] != key] + [(key, size)]
                while sum(entry[1] for entry in plain) > capacity:
                    plain.pop(0)
            elif is_put:
                cache.put(key, size, size)
            else:
                assert cache.get(key) == (held[1] if held else None)
                if held:
                    plain.remove(held)
                    plain.append(held)
            assert cache.used_bytes == sum(entry[1] for entry in plain) <= capacity

    def test_negative_capacity_is_refused(self) -> None:
        with pytest.raises(ValueError, match="negative"):
            LruCache(-1)


class TestThreads:
    def test_writers_and_readers_at_once(self, store: Store) -> None:
        """Four writers, four readers: nothing is lost and no snapshot is torn."""
        store.create_scene(OFFICE)
        done = threading.Event()

        def write(writer: int) -> None:
            for index in range(10):
                pair = [make_reference(f"{writer}-{index}-{side}", index, count=2) for side in "ab"]
                store.add_references(OFFICE, pair)
                if index % 3 == 2:
                    store.delete_reference(OFFICE, f"{writer}-{index}-b")
                    store.delete_reference(OFFICE, f"{writer}-{index}-a")

        def read() -> int:
            sizes: dict[int, int] = {}
            while not done.is_set():
                snapshot = store.load_references(OFFICE, None, EXTRACTOR)
                generation, poses = store.list_poses(OFFICE)
                for seen, size in ((snapshot.generation, len(snapshot.references)), (generation, len(poses))):
                    assert sizes.setdefault(seen, size) == size
            return len(sizes)

        with ThreadPoolExecutor(8) as pool:
            readers = [pool.submit(read) for _ in range(4)]
            try:
                for writer in [pool.submit(write, index) for index in range(4)]:
                    writer.result(timeout=60)
            finally:
                done.set()
            assert all(reader.result(timeout=60) >= 1 for reader in readers)
        scene = store.get_scene(OFFICE)
        assert scene.reference_count == 4 * (10 - 3) * 2
        assert scene.generation == 1 + 4 * (10 + 2 * 3)

    def test_one_of_many_gets_an_id(self, store: Store) -> None:
        store.create_scene(OFFICE)

        def add(seed: int) -> bool:
            try:
                store.add_references(OFFICE, [make_reference("a", seed)])
            except errors.AlreadyExists:
                return False
            return True

        with ThreadPoolExecutor(8) as pool:
            assert sum(pool.map(add, range(8))) == 1
        assert store.get_scene(OFFICE).generation == 2


class TestDamage:
    @pytest.mark.parametrize(
        "damage",
        [
            "UPDATE features SET data = zeroblob(100) WHERE reference_key = ?",
            "UPDATE features SET data = x'' WHERE reference_key = ?",
            "UPDATE features SET data = (SELECT data FROM features WHERE reference_key != ?1) WHERE reference_key = ?1",
            "UPDATE features SET (data, sha256) = (SELECT data, sha256 FROM features WHERE reference_key != ?1) "
            "WHERE reference_key = ?1",
            "UPDATE reference SET geometry = CAST(replace(geometry, '640', '641') AS BLOB) WHERE key = ?",
            "UPDATE reference SET geometry = CAST(geometry AS TEXT) WHERE key = ?",
            "UPDATE reference SET geometry = x'ff' WHERE key = ?",
        ],
    )
    def test_one_damaged_reference_is_named_and_the_other_served(
        self, store: Store, data_dir: Path, damage: str
    ) -> None:
        store.create_scene(OFFICE)
        bad, _ = store.add_references(OFFICE, [make_reference("bad", 1), make_reference("good", 2)])
        execute(data_dir, damage, bad.key)
        for ids in (["bad"], ["good", "bad"], None):
            with pytest.raises(errors.DataLoss, match="'bad'"):
                store.load_references(OFFICE, ids, EXTRACTOR)
        (good,) = store.load_references(OFFICE, ["good"], EXTRACTOR).references
        assert_same_view(good.view, view_of(make_reference("good", 2)))
        assert store.read_image(OFFICE, "bad") == make_reference("bad", 1).image
        store.delete_reference(OFFICE, "bad")
        assert len(store.load_references(OFFICE, None, EXTRACTOR).references) == 1

    def test_damaged_image_is_not_handed_out(self, store: Store, data_dir: Path) -> None:
        store.create_scene(OFFICE)
        bad, _ = store.add_references(OFFICE, [make_reference("bad"), make_reference("good")])
        execute(data_dir, "UPDATE image SET data = zeroblob(5000) WHERE reference_key = ?", bad.key)
        with pytest.raises(errors.DataLoss, match="'bad'"):
            store.read_image(OFFICE, "bad")
        with pytest.raises(errors.DataLoss, match="'bad'"):
            store.read_image_of(bad.key)
        assert store.read_image(OFFICE, "good") == make_reference("good").image

    def test_every_single_bit_flip_is_noticed(self) -> None:
        blob = codec.encode_view(view_of(make_reference("a", count=1)))
        sha256 = codec.sha256_for("owner", blob)
        codec.decode_view("owner", blob, sha256)
        for position in range(0, len(blob), 7):
            flipped = bytearray(blob)
            flipped[position] ^= 1 << position % 8
            with pytest.raises(codec.Damaged):
                codec.decode_view("owner", bytes(flipped), sha256)

    def test_a_later_format_is_not_misread(self) -> None:
        blob = bytearray(codec.encode_view(view_of(make_reference("a", count=1))))
        struct.pack_into("<B", blob, 0, codec.VIEW_FORMAT_VERSION + 1)
        with pytest.raises(codec.Damaged, match="format 2"):
            codec.decode_view("owner", bytes(blob), codec.sha256_for("owner", bytes(blob)))


class TestFaults:
    def test_a_full_disk_is_said_and_harms_nothing(self, store: Store) -> None:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference("a")])
        before = store.get_scene(OFFICE)
        with store._database.read() as connection:
            pages = connection.exec_driver_sql("PRAGMA page_count").scalar()
            unlimited = connection.exec_driver_sql("PRAGMA max_page_count").scalar()
            connection.exec_driver_sql(f"PRAGMA max_page_count={pages}")
        with pytest.raises(errors.Overloaded) as caught:
            store.add_references(OFFICE, [make_reference(it, count=200) for it in "bcd"])
        assert caught.value.reason == "STORE_FULL"
        assert store.get_scene(OFFICE) == before
        with store._database.read() as connection:
            connection.exec_driver_sql(f"PRAGMA max_page_count={unlimited}")
        store.add_references(OFFICE, [make_reference(it, count=200) for it in "bcd"])
        assert store.get_scene(OFFICE).reference_count == 4

    def test_a_lock_held_by_another_tool_asks_for_a_retry(
        self, data_dir: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(sqlite, "BUSY_TIMEOUT_MS", 10)
        with Store.open(data_dir) as store:
            other = connect(data_dir)
            other.execute("BEGIN IMMEDIATE")
            with pytest.raises(errors.Unavailable) as caught:
                store.create_scene(OFFICE)
            assert caught.value.retry_after_s is not None
            assert store.list_scenes(DEFAULT_TENANT, 10) == []
            other.rollback()
            other.close()
            assert store.create_scene(OFFICE).generation == 1


class TestOpening:
    @pytest.mark.parametrize(
        ("version", "affected"),
        [
            ((3, 6, 23), False),
            ((3, 7, 0), True),
            ((3, 40, 1), True),
            ((3, 44, 5), True),
            ((3, 44, 6), False),
            ((3, 45, 0), True),
            ((3, 50, 6), True),
            ((3, 50, 7), False),
            ((3, 51, 0), True),
            ((3, 51, 2), True),
            ((3, 51, 3), False),
            ((3, 53, 4), False),
        ],
    )
    def test_versions_with_the_wal_reset_bug(self, version: tuple[int, int, int], affected: bool) -> None:
        assert sqlite.has_wal_reset_bug(version) is affected

    def settings_in_use(self, store: Store) -> dict[str, object]:
        names = ("journal_mode", "synchronous", "foreign_keys", "busy_timeout", "trusted_schema", "cell_size_check")
        with store._database.read() as connection:
            return {name: connection.exec_driver_sql(f"PRAGMA {name}").scalar() for name in (*names, "mmap_size")}

    def test_settings_of_every_connection(self, store: Store) -> None:
        expected = {"journal_mode": "wal", "synchronous": 2, "foreign_keys": 1, "busy_timeout": 5000}
        expected |= {"trusted_schema": 0, "cell_size_check": 1, "mmap_size": 0}
        with ThreadPoolExecutor(3) as pool:
            barrier = threading.Barrier(3, timeout=10)

            def look(_: int) -> dict[str, object]:
                with store._database.read():
                    barrier.wait()
                    return self.settings_in_use(store)

            assert list(pool.map(look, range(3))) == [expected] * 3

    def test_transactions_really_begin(self, store: Store, data_dir: Path) -> None:
        with store._database.write() as writer:
            assert writer.connection.driver_connection.in_transaction  # type: ignore[union-attr]
            # A second write transaction, past our own queue, must be refused by SQLite itself.
            other = connect(data_dir)
            with pytest.raises(sqlite.choose_library().OperationalError, match="locked"):
                other.execute("BEGIN IMMEDIATE")
            other.close()
        with store._database.read() as reader:
            assert reader.connection.driver_connection.in_transaction  # type: ignore[union-attr]

    def test_affected_library_runs_in_safe_mode(
        self, data_dir: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
    ) -> None:
        with Store.open(data_dir) as store:
            store.create_scene(OFFICE)
            assert self.settings_in_use(store)["journal_mode"] == "wal"
        with monkeypatch.context() as patch, caplog.at_level(logging.WARNING):
            for library in (sqlite3.dbapi2, pytest.importorskip("pysqlite3.dbapi2")):
                patch.setattr(library, "sqlite_version_info", (3, 51, 2))
            with Store.open(data_dir) as store:
                in_use = self.settings_in_use(store)
                assert (in_use["journal_mode"], in_use["synchronous"]) == ("delete", 3)
                with ThreadPoolExecutor(4) as pool:
                    list(pool.map(lambda it: store.add_references(OFFICE, [make_reference(it)]), "abcd"))
                    list(pool.map(lambda it: store.delete_reference(OFFICE, it), "bcd"))
        assert "WAL-reset" in caplog.text
        with Store.open(data_dir) as store:
            assert self.settings_in_use(store)["journal_mode"] == "wal"
            assert store.get_scene(OFFICE).reference_count == 1

    def test_works_without_the_packaged_library(self, data_dir: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setitem(sys.modules, "pysqlite3", None)
        monkeypatch.setitem(sys.modules, "pysqlite3.dbapi2", None)
        with Store.open(data_dir) as store:
            store.create_scene(OFFICE)
            store.add_references(OFFICE, [make_reference("a")])
            assert store.load_references(OFFICE, None, EXTRACTOR).generation == 2

    def test_second_server_is_refused_until_the_first_has_gone(self, data_dir: Path) -> None:
        with Store.open(data_dir) as store:
            store.create_scene(OFFICE)
            with pytest.raises(StoreError, match=f"in use by another server .process {os.getpid()}."):
                Store.open(data_dir)
            assert store.get_scene(OFFICE).generation == 1
        with Store.open(data_dir) as store:
            assert store.get_scene(OFFICE).generation == 1

    def test_refused_opening_leaves_no_lock(self, data_dir: Path) -> None:
        data_dir.mkdir()
        database = data_dir / sqlite.DATABASE_FILE
        database.write_bytes(b"not a database " * 1000)
        for _ in range(2):
            with pytest.raises(StoreError, match="not a database"):
                Store.open(data_dir)
        database.unlink()
        Store.open(data_dir).close()

    def test_schema_from_the_future_is_refused(self, data_dir: Path) -> None:
        Store.open(data_dir).close()
        execute(data_dir, "UPDATE store_version SET schema_version = 2")
        with pytest.raises(StoreError, match="version 2"):
            Store.open(data_dir)

    def test_database_of_another_program_is_refused(self, data_dir: Path) -> None:
        data_dir.mkdir()
        execute(data_dir, "CREATE TABLE scene (name TEXT)")
        with pytest.raises(StoreError, match="another program"):
            Store.open(data_dir)

    def test_truncated_database_is_refused_or_reported(self, data_dir: Path) -> None:
        with Store.open(data_dir) as store:
            store.create_scene(OFFICE)
            store.add_references(OFFICE, [make_reference(str(index)) for index in range(20)])
        os.truncate(data_dir / sqlite.DATABASE_FILE, 8192)
        with pytest.raises((StoreError, errors.DataLoss)), Store.open(data_dir) as store:
            store.load_references(OFFICE, None, EXTRACTOR)

    def test_unusable_folders_are_one_sentence(self, tmp_path: Path) -> None:
        file = tmp_path / "file"
        file.touch()
        folder_for_file = tmp_path / "folder"
        (folder_for_file / sqlite.DATABASE_FILE).mkdir(parents=True)
        for data_dir in (file, file / "below", folder_for_file):
            with pytest.raises(StoreError) as caught:
                Store.open(data_dir)
            assert str(data_dir) in str(caught.value)
            assert "\n" not in str(caught.value)

    @pytest.mark.skipif(os.geteuid() == 0, reason="root may write everywhere")
    def test_unwritable_folder_is_refused(self, tmp_path: Path) -> None:
        tmp_path.chmod(0o500)
        with pytest.raises(StoreError, match="Permission denied"):
            Store.open(tmp_path)
