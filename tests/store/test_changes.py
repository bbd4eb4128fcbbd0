"""A scene that is followed by its changes is at each moment what is read as a whole; on either database."""

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.stores import (
    EXTRACTOR,
    Place,
    assert_same_bits,
    faults_of,
    make_descriptor,
    make_reference,
    place_on,
)

from mapless_server import errors
from mapless_server.security import SceneKey
from mapless_server.store import IndexedReference, NewReference, Store

OFFICE, HALL = SceneKey("office"), SceneKey("hall")
NAME = "vlad"


class Follower:
    """Has a scene in memory, and asks for nothing but what changed."""

    def __init__(self) -> None:
        self.generation: int | None = None
        self.known: dict[str, IndexedReference] = {}
        self.wholes = 0

    def follow(self, store: Store) -> None:
        changes = store.list_changes(OFFICE, self.generation, NAME)
        if changes.is_whole:
            self.known = {}
            self.wholes += 1
        for key in changes.removed:
            self.known.pop(key, None)
        self.known |= {it.key: it for it in changes.added}
        self.generation = changes.generation


def contents(known: dict[str, IndexedReference]) -> dict[str, tuple[object, ...]]:
    return {
        it.key: (
            it.reference_id,
            it.world_from_camera.translation.tobytes(),
            None if it.descriptor is None else it.descriptor.tobytes(),
        )
        for it in known.values()
    }


def described(reference_id: str, seed: int = 0) -> NewReference:
    return make_reference(reference_id, seed, count=1, dimension=16)


def test_a_descriptor_comes_back_as_float16_keeps_it(place: Place) -> None:
    made = [described("a", 1), make_reference("b", 2, count=1), described("c", 3)]
    with place.open() as store:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, made)
    with place.open() as store:
        changes = store.list_changes(OFFICE, None, NAME)
        assert (changes.generation, changes.is_whole, changes.removed) == (2, True, frozenset())
        assert [it.reference_id for it in changes.added] == ["a", "b", "c"]
        for new, read in zip(made, changes.added, strict=True):
            assert read.key == store.get_reference(OFFICE, new.reference_id).key
            assert_same_bits(read.world_from_camera.rotation, new.world_from_camera.rotation)
            assert_same_bits(read.world_from_camera.translation, new.world_from_camera.translation)
            if new.descriptors:
                assert read.descriptor is not None
                assert_same_bits(read.descriptor, new.descriptors[NAME].astype(np.float16).astype(np.float32))
                assert abs(read.descriptor @ new.descriptors[NAME] - 1) < 1e-3
                with pytest.raises(ValueError, match="read-only"):
                    read.descriptor[:] = 0
            else:
                assert read.descriptor is None
        assert all(it.descriptor is None for it in store.list_changes(OFFICE, None, "another").added)


@pytest.mark.parametrize(
    "wrong", [np.array([1, np.nan]), np.array([1e6, 0]), np.array([np.inf]), np.zeros(0), np.zeros((2, 2))]
)
def test_what_is_no_descriptor_is_refused(store: Store, wrong: np.ndarray) -> None:
    store.create_scene(OFFICE)
    vector = wrong.astype(np.float32)
    with pytest.raises(ValueError, match="global descriptor"):
        store.add_references(OFFICE, [replace(described("a"), descriptors={NAME: vector})])
    (record,) = store.add_references(OFFICE, [make_reference("a")])
    with pytest.raises(ValueError, match="global descriptor"):
        store.add_descriptor(record.key, NAME, vector)
    assert store.get_scene(OFFICE).generation == 2


def test_a_descriptor_found_later_is_kept_and_is_no_change(store: Store) -> None:
    store.create_scene(OFFICE)
    a, b = store.add_references(OFFICE, [make_reference("a"), make_reference("b")])
    first, second = (make_descriptor(np.random.default_rng(seed), 16) for seed in (1, 2))
    store.add_descriptor(a.key, NAME, first)
    store.add_descriptor(a.key, NAME, second)
    changes = store.list_changes(OFFICE, 2, NAME)
    assert (changes.generation, store.get_scene(OFFICE).generation, changes.added) == (2, 2, ())
    assert list(store.load_descriptors([a.key, b.key], NAME)) == [a.key]
    assert_same_bits(store.load_descriptors([a.key], NAME)[a.key], first.astype(np.float16).astype(np.float32))
    (found,) = (it for it in store.list_changes(OFFICE, None, NAME).added if it.key == a.key)
    assert found.descriptor is not None
    assert_same_bits(found.descriptor, first.astype(np.float16).astype(np.float32))
    store.delete_reference(OFFICE, "a")
    with pytest.raises(errors.NotFound, match="deleted"):
        store.add_descriptor(a.key, "other", first)
    store.delete_scene(OFFICE)
    with pytest.raises(errors.NotFound):
        store.add_descriptor(a.key, "other", first)


def test_one_of_many_descriptors_wins_and_counts_once(store: Store) -> None:
    store.create_scene(OFFICE)
    (a,) = store.add_references(OFFICE, [make_reference("a")])
    vectors = [make_descriptor(np.random.default_rng(seed), 16) for seed in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda vector: store.add_descriptor(a.key, NAME, vector), vectors))
    (found,) = store.list_changes(OFFICE, None, NAME).added
    assert found.descriptor is not None
    assert found.descriptor.tobytes() in {it.astype(np.float16).astype(np.float32).tobytes() for it in vectors}


def test_a_new_life_and_a_generation_yet_to_come_are_read_whole(store: Store) -> None:
    store.create_scene(OFFICE)
    store.add_references(OFFICE, [described("a")])
    store.delete_scene(OFFICE)
    with pytest.raises(errors.NotFound, match="office"):
        store.list_changes(OFFICE, 2, NAME)
    generation = store.create_scene(OFFICE).generation
    store.add_references(OFFICE, [described("b")])
    for since in (1, 2, generation - 1, generation + 2):
        changes = store.list_changes(OFFICE, since, NAME)
        assert (changes.is_whole, [it.reference_id for it in changes.added]) == (True, ["b"])
    assert not store.list_changes(OFFICE, generation, NAME).is_whole


OF_ANOTHER = "(SELECT data, sha256 FROM global_descriptor WHERE reference_key <> ?)"


@pytest.mark.parametrize(
    "damage",
    [
        "global_descriptor SET data = ? WHERE reference_key = ?",
        "reference SET geometry = ? WHERE key = ?",
        f"global_descriptor SET (data, sha256) = {OF_ANOTHER} WHERE reference_key = ?",
    ],
)
def test_a_damaged_reference_is_named_and_left_out(place: Place, damage: str) -> None:
    with place.open() as store:
        store.create_scene(OFFICE)
        bad, _ = store.add_references(OFFICE, [described("bad", 1), described("good", 2)])
        place.execute(f"UPDATE {damage}", bad.key if "SELECT" in damage else bytes(32), bad.key)
        for _ in range(2):
            changes = store.list_changes(OFFICE, None, NAME)
            assert [it.reference_id for it in changes.added] == ["good"]
            assert changes.damaged == ("bad",)
        store.delete_reference(OFFICE, "bad")
        assert store.list_changes(OFFICE, None, NAME).damaged == ()


STEPS = st.lists(st.tuples(st.sampled_from("addfn"), st.integers(0, 4)), max_size=25)


@settings(max_examples=8, deadline=None)
@given(steps=STEPS)
def test_following_is_reading_whole(
    database: str, tmp_path_factory: pytest.TempPathFactory, steps: list[tuple[str, int]]
) -> None:
    """Random lives of a scene: add, delete, follow, a new life, a plain look."""
    follower = Follower()
    with place_on(database, lambda: tmp_path_factory.mktemp("follow")).open() as store:
        store.create_scene(OFFICE)
        do: dict[str, Callable[[str], object]] = {
            "a": lambda it: store.add_references(OFFICE, [make_reference(it, count=1)]),
            "d": lambda it: store.delete_reference(OFFICE, it),
            "f": lambda it: follower.follow(store),
            "n": lambda it: (store.delete_scene(OFFICE), store.create_scene(OFFICE)),
        }
        for step, number in steps:
            with suppress(errors.AlreadyExists, errors.NotFound):
                do[step](str(number))
        follower.follow(store)
        whole = store.list_changes(OFFICE, None, NAME)
        scene = store.get_scene(OFFICE)
        snapshot = store.load_references(OFFICE, None, EXTRACTOR)
    assert contents(follower.known) == contents({it.key: it for it in whole.added})
    assert scene.reference_count == len(whole.added) == len(snapshot.references)
    assert scene.generation == whole.generation == snapshot.generation
    assert follower.wholes <= 1 + sum(step == "n" for step, _ in steps)


def test_a_reader_behind_the_kept_deletions_reads_all(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tombstones do not pile up; whether remembered or not, following is reading whole."""
    remembered = 4
    monkeypatch.setattr("mapless_server.store.changes.GENERATIONS_REMEMBERED", remembered)
    with place.open() as store:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference(f"r{it}", it, count=1) for it in range(12)])
        followers = []
        for index in range(12):
            follower = Follower()
            follower.follow(store)
            followers.append(follower)
            store.delete_reference(OFFICE, f"r{index}")
            if index == 5:
                store.add_references(OFFICE, [make_reference("late", count=1)])
        assert place.fetch("SELECT count(*) FROM removed_reference") == [(remembered,)]
        whole = contents({it.key: it for it in store.list_changes(OFFICE, None, NAME).added})
        for follower in followers:
            follower.follow(store)
            assert contents(follower.known) == whole
        assert [it.wholes for it in followers] == [2] * 8 + [1] * 4
    assert faults_of(place) == ()


def test_where_one_process_writes_only_a_change_asks_the_database(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with Store.open(tmp_path) as store:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [described("a")])
        now = store.list_changes(OFFICE, None, "vlad").generation
        with monkeypatch.context() as patch:
            patch.setattr(store.database, "read", None)
            same = store.list_changes(OFFICE, now, "vlad")
        assert (same.generation, same.added, same.is_whole) == (now, (), False)
        store.add_references(OFFICE, [described("b")])
        assert [it.reference_id for it in store.list_changes(OFFICE, now, "vlad").added] == ["b"]
        store.delete_scene(OFFICE)
        with pytest.raises(errors.NotFound):
            store.list_changes(OFFICE, now, "vlad")
