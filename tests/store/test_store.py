"""The store keeps its promises on either database: exact, atomic, ordered, checked."""

import math
import threading
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from sqlalchemy.exc import IntegrityError
from support.stores import (
    EXTRACTOR,
    CountingStoreObserver,
    Place,
    assert_same_bits,
    assert_same_view,
    make_features,
    make_reference,
    place_on,
    read_image,
    view_of,
)

from mapless.geometry import RigidTransform
from mapless.lenses import Distortion, Fisheye, RadialTangential
from mapless_server import errors
from mapless_server.method.features.views import Features, View
from mapless_server.security import DEFAULT_TENANT, SceneKey
from mapless_server.store import LruCache, NewReference, Store

DENIALS = {
    "sqlite": (
        "CREATE TRIGGER deny BEFORE INSERT ON features WHEN NEW.extractor = 'strong' "
        "BEGIN SELECT RAISE(ABORT, 'denied'); END",
        "DROP TRIGGER deny",
    ),
    "postgresql": (
        "ALTER TABLE features ADD CONSTRAINT denied CHECK (extractor <> 'strong')",
        "ALTER TABLE features DROP CONSTRAINT denied",
    ),
}
"""Makes a transaction fail in its middle, and ends that."""

OFFICE, HALL, SCENE, NOWHERE = map(SceneKey, ("office", "hall", "scene", "nowhere"))


class TestScenes:
    def test_everything_of_an_unknown_scene_is_not_found(self, store: Store) -> None:
        calls = (
            lambda: store.get_scene(NOWHERE),
            lambda: store.get_attributes(NOWHERE),
            lambda: store.get_generation(NOWHERE),
            lambda: store.update_scene(NOWHERE, datum=None),
            lambda: store.delete_scene(NOWHERE),
            lambda: store.add_references(NOWHERE, [make_reference("a")]),
            lambda: store.get_reference(NOWHERE, "a"),
            lambda: store.list_references(NOWHERE, 10),
            lambda: store.delete_reference(NOWHERE, "a"),
            lambda: store.list_changes(NOWHERE, None, "vlad"),
            lambda: store.load_references(NOWHERE, None, EXTRACTOR),
            lambda: store.load_references(NOWHERE, ["a"], EXTRACTOR),
        )
        for call in calls:
            with pytest.raises(errors.NotFound, match="nowhere") as caught:
                call()
            assert caught.value.field == "scene"


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

    def test_a_new_life_repeats_no_generation(self, place: Place) -> None:
        seen: list[int] = []
        for _ in range(3):
            with place.open() as store:
                seen.append(store.create_scene(OFFICE).generation)
                store.add_references(OFFICE, [make_reference("a")])
                seen.append(store.get_scene(OFFICE).generation)
                store.delete_scene(OFFICE)
        assert seen == sorted(set(seen))


class TestReferences:
    @pytest.mark.parametrize(
        "distortion",
        [
            None,
            RadialTangential(0.1, -1 / 3, 1e-17, -0.0, math.nextafter(0.2, 1)),
            Fisheye(0.1, 5e-324, -1 / 3, 1.7976931348623157e308),
        ],
    )
    def test_comes_back_bit_for_bit_after_reopening(self, place: Place, distortion: Distortion | None) -> None:
        new = make_reference("a", seed=3, distortion=distortion)
        with place.open() as store:
            store.create_scene(OFFICE)
            (created,) = store.add_references(OFFICE, [new])
        with place.open() as store:
            read = store.get_reference(OFFICE, "a")
            image = store.read_image_of(created.key)
            (loaded,) = store.load_references(OFFICE, ["a"], EXTRACTOR).references
            (pose,) = store.list_changes(OFFICE, None, "vlad").added
        assert image == new.image
        assert read.camera == new.camera
        assert repr(read.camera) == repr(new.camera)  # distinguishes -0.0 from 0.0
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

    def test_features_of_all_extractors_are_stored_or_none(self, store: Store, place: Place, database: str) -> None:
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
        deny, permit = DENIALS[database]
        place.execute(deny)
        with pytest.raises(IntegrityError, match="denied"):
            store.add_references(OFFICE, [both])
        place.execute(permit)
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
        assert len(store.list_changes(OFFICE, None, "vlad").added) == 1100
        with pytest.raises(errors.AlreadyExists):
            store.add_references(OFFICE, [make_reference(it, count=1) for it in ["new", *ids]])

    def test_ids_are_data_not_sql(self, store: Store, database: str) -> None:
        nasty = ["'; DROP TABLE scene; --", "../../etc/passwd", '"', "%", "_", "a b"]
        if database == "sqlite":
            nasty.append("\x00")  # no text to PostgreSQL
        for scene_key in map(SceneKey, nasty):
            store.create_scene(scene_key)
            store.add_references(scene_key, [make_reference(it, count=1) for it in nasty])
        for scene_key in map(SceneKey, nasty):
            assert {it.reference_id for it in store.list_references(scene_key, 100)} == set(nasty)
            assert read_image(store, scene_key, "%") == make_reference("%", count=1).image


IDS = st.text("ab_-.AZ09", min_size=1, max_size=3)


class TestPages:
    @settings(max_examples=10, deadline=None)
    @given(names=st.sets(IDS, max_size=12), limit=st.integers(1, 5))
    def test_pages_are_a_partition_in_order(
        self, database: str, tmp_path_factory: pytest.TempPathFactory, names: set[str], limit: int
    ) -> None:
        with place_on(database, lambda: tmp_path_factory.mktemp("pages")).open() as store:
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
            poses = [it.reference_id for it in store.list_changes(SCENE, None, "vlad").added]
            assert store.get_scene(SCENE).reference_count == len(names)
        assert scene_ids == sorted({"scene", *("s" + name for name in names)})
        assert reference_ids == poses == sorted(names)


class TestMemory:
    def test_repeated_load_reads_no_blob(self, store: Store, place: Place) -> None:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference("a"), make_reference("b")])
        first = store.load_references(OFFICE, ["a", "b"], EXTRACTOR)
        place.execute("UPDATE features SET data = ?", b"\0")
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
            assert cache.used == sum(entry[1] for entry in plain) <= capacity

    def test_what_is_deleted_takes_no_memory(self, store: Store) -> None:
        for scene in ("kept", "gone"):
            store.create_scene(SceneKey(scene))
            store.add_references(SceneKey(scene), [make_reference(it) for it in "abc"])
            store.load_references(SceneKey(scene), None, EXTRACTOR)
        full = store.reference_cache.used
        store.delete_scene(SceneKey("gone"))
        assert store.reference_cache.used == full / 2
        store.delete_reference(SceneKey("kept"), "b")
        assert store.reference_cache.used == full / 3
        assert len(store.load_references(SceneKey("kept"), None, EXTRACTOR).references) == 2
        assert store.reference_cache.evictions == 0


class TestObserver:
    """Faults: see test_sqlite."""

    def test_each_operation_is_reported_once_and_misuse_is_no_fault(self, store: Store) -> None:
        store.observer = observer = CountingStoreObserver()
        store.create_scene(HALL)
        store.add_references(HALL, [make_reference("a")])
        store.load_references(HALL, ["a"], EXTRACTOR)
        with pytest.raises(errors.AlreadyExists):
            store.create_scene(HALL)
        with pytest.raises(errors.NotFound):
            store.get_reference(HALL, "b")
        expected = ["create_scene", "add_references", "load_references", "create_scene", "get_reference"]
        assert (observer.operations, observer.failures) == (expected, 0)


class TestThreads:
    def test_writers_and_readers_at_once(self, store: Store) -> None:
        """Four writers, four readers: nothing is lost and no snapshot is torn."""
        store.create_scene(OFFICE)
        done = threading.Event()

        def write(writer: int) -> None:
            for index in range(6):
                pair = [make_reference(f"{writer}-{index}-{side}", index, count=2) for side in "ab"]
                store.add_references(OFFICE, pair)
                if index % 3 == 2:
                    store.delete_reference(OFFICE, f"{writer}-{index}-b")
                    store.delete_reference(OFFICE, f"{writer}-{index}-a")

        def read() -> int:
            sizes: dict[int, int] = {}
            while not done.is_set():
                snapshot = store.load_references(OFFICE, None, EXTRACTOR)
                whole = store.list_changes(OFFICE, None, "vlad")
                for seen, size in (
                    (snapshot.generation, len(snapshot.references)),
                    (whole.generation, len(whole.added)),
                ):
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
        assert scene.reference_count == 4 * (6 - 2) * 2
        assert scene.generation == 1 + 4 * (6 + 2 * 2)
