"""Stored matches of pairs: what is read is what was stored, each reference is claimed by one server at a time."""

from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from support.stores import Place, assert_same_bits, faults_of, let_pass, make_reference

from mapless_server.method.features.matching import StoredPair
from mapless_server.security import SceneKey
from mapless_server.store import Store, pairs
from mapless_server.store.backup import back_up, restore
from mapless_server.store.pairs import KEPT_S, Claim, PairStore, Progress, delete_unused, record_use

SCENE, OTHER = SceneKey("office"), SceneKey("acme/office")
MATCHING = "sift/strict"


@pytest.fixture
def two(place: Place) -> Iterator[tuple[Store, PairStore]]:
    """A scene of the references a, b, c, in the order in which they were added."""
    with place.open() as store:
        store.create_scene(SCENE)
        for seed, name in enumerate("abc"):
            store.add_references(SCENE, [make_reference(name, seed)])
        yield store, PairStore(store.database)


def matches(count: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 2048, (count, 2), np.int32)


def pair_of(count: int) -> StoredPair:
    return StoredPair(matches(count))


def key_of(store: Store, name: str) -> str:
    return store.find_keys(SCENE, [name])[name]


def claim_all(stored: PairStore, progress: Progress | None = None) -> list[Claim]:
    progress, found = progress or Progress(), []
    while claim := stored.claim(MATCHING, progress):
        found.append(claim)
    return found


def complete(store: Store, stored: PairStore, matching: str = MATCHING) -> dict[tuple[str, str], np.ndarray]:
    """Makes every pair of the scene that is missing; what was stored."""
    everything: dict[tuple[str, str], np.ndarray] = {}
    progress = Progress()
    while claim := stored.claim(matching, progress):
        others = stored.list_missing(matching, claim, [key_of(store, name) for name in "abc"], 20)
        made = {(other, claim.key): matches(5, seed) for seed, other in enumerate(others)}
        stored.add(matching, claim, {pair: StoredPair(it, 1.5) for pair, it in made.items()}, is_complete=True)
        everything |= made
    return everything


class TestMatches:
    @pytest.mark.parametrize("count", [0, 1, 300])
    def test_are_read_as_they_were_stored(self, two: tuple[Store, PairStore], count: int) -> None:
        store, stored = two
        claim = claim_all(stored)[0]
        pair = key_of(store, "b"), key_of(store, "a")
        stored.add(MATCHING, claim, {pair: StoredPair(matches(count), 0.1)}, is_complete=True)
        found = stored.load(MATCHING, [pair, pair[::-1], (key_of(store, "c"), key_of(store, "a"))])
        assert list(found) == [pair]
        it = found[pair]
        assert it is not None
        assert it.error_px == 0.1
        assert_same_bits(it.matches, matches(count))

    @pytest.mark.parametrize("which", ["first_key", "second_key"])
    def test_are_deleted_with_either_reference(self, two: tuple[Store, PairStore], place: Place, which: str) -> None:
        store, stored = two
        made = complete(store, stored)
        assert len(made) == 3
        gone = store.delete_reference(SCENE, "b")
        left = place.fetch("SELECT first_key, second_key FROM reference_pair")
        assert set(left) == {pair for pair in made if gone not in pair}
        assert not place.fetch(f"SELECT 1 FROM reference_pair WHERE {which} = ?", gone)
        # Another photograph under the old name is another reference.
        store.add_references(SCENE, [make_reference("b", 7)])
        assert key_of(store, "b") != gone
        assert stored.load(MATCHING, [(key_of(store, "a"), key_of(store, "b"))]) == {}

    @pytest.mark.parametrize(
        "damage",
        [
            "data = ?",
            "sha256 = 'no'",
            "error_px = 9",
            "error_px = NULL",
            "first_key = second_key, second_key = first_key",
            "matching = 'sift/wide'",
        ],
    )
    def test_damaged_ones_are_found_out_and_claimed_again(
        self, two: tuple[Store, PairStore], place: Place, damage: str
    ) -> None:
        store, stored = two
        pair = next(iter(complete(store, stored)))
        parameters = [b"\1\2\3"] if "?" in damage else []
        place.execute(f"UPDATE reference_pair SET {damage} WHERE first_key = ? AND second_key = ?", *parameters, *pair)
        matching, at = ("sift/wide" if "wide" in damage else MATCHING), (pair[::-1] if "first" in damage else pair)
        assert stored.load(matching, [at]) == {at: None}
        assert faults_of(place) == ()
        stored.discard(matching, [at])
        assert stored.load(matching, [at]) == {}
        if matching == MATCHING:
            assert {it.key for it in claim_all(stored)} == set(pair)

    def test_of_references_deleted_meanwhile_are_ignored(self, two: tuple[Store, PairStore], place: Place) -> None:
        store, stored = two
        claim = next(it for it in claim_all(stored) if it.reference_id == "c")
        gone, left = key_of(store, "a"), key_of(store, "b")
        store.delete_reference(SCENE, "a")
        stored.add(MATCHING, claim, {(gone, claim.key): pair_of(3), (left, claim.key): pair_of(4)}, is_complete=True)
        assert place.fetch("SELECT first_key FROM reference_pair") == [(left,)]
        store.delete_reference(SCENE, "c")
        stored.add(MATCHING, claim, {(left, claim.key): pair_of(4)}, is_complete=True)
        stored.postpone(MATCHING, claim)
        assert place.fetch("SELECT count(*) FROM reference_pair") == [(0,)]

    def test_are_in_a_backup_and_in_what_is_restored(self, two: tuple[Store, PairStore], tmp_path: Path) -> None:
        store, stored = two
        made = complete(store, stored)
        assert back_up(store.database, tmp_path / "backup").faults == ()
        with Store.open(tmp_path / "other") as other:
            restore(tmp_path / "backup", other.database)
            found = PairStore(other.database)
            for pair, loaded in found.load(MATCHING, made).items():
                assert loaded is not None
                assert_same_bits(loaded.matches, made[pair])
            assert found.count_waiting(MATCHING) == 0


class TestClaims:
    def test_each_pair_belongs_to_the_later_reference(self, two: tuple[Store, PairStore]) -> None:
        store, stored = two
        keys = {name: key_of(store, name) for name in "abc"}
        others = {
            it.reference_id: stored.list_missing(MATCHING, it, [keys["c"], keys["b"], keys["a"]], 20)
            for it in claim_all(stored)
        }
        assert others == {"a": [], "b": [keys["a"]], "c": [keys["b"], keys["a"]]}

    def test_what_a_killed_server_claimed_is_free_after_the_claim(
        self, two: tuple[Store, PairStore], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        _, stored = two
        progress = Progress()
        assert len(claim_all(stored, progress)) == 3
        let_pass(monkeypatch, pairs.CLAIM_S - 5)
        assert claim_all(stored, progress) == []
        let_pass(monkeypatch, 5)
        assert len(claim_all(stored, progress)) == 3

    def test_what_is_left_unfinished_may_be_claimed_at_once(self, two: tuple[Store, PairStore]) -> None:
        store, stored = two
        claim = next(it for it in claim_all(stored) if it.reference_id == "c")
        keys = [key_of(store, name) for name in "ab"]
        stored.add(MATCHING, claim, {(keys[0], claim.key): pair_of(2)}, is_complete=False)
        assert claim_all(stored) == [claim]
        assert stored.list_missing(MATCHING, claim, keys, 20) == [keys[1]]
        assert stored.list_missing(MATCHING, claim, keys, 1) == []

    def test_the_wait_after_failures_grows(self, two: tuple[Store, PairStore], monkeypatch: pytest.MonkeyPatch) -> None:
        _, stored = two
        (claim, *_) = claim_all(stored)
        waits_s = []
        for _ in range(10):
            waits_s.append(stored.postpone(MATCHING, claim))
            let_pass(monkeypatch, waits_s[-1] - 5)
            assert claim not in claim_all(stored)
            let_pass(monkeypatch, 5)
            assert claim in claim_all(stored)
        assert waits_s == [min(pairs.LONGEST_RETRY_S, pairs.FIRST_RETRY_S * 2**i) for i in range(10)]
        stored.add(MATCHING, claim, {}, is_complete=False)
        assert claim in claim_all(stored)
        assert stored.postpone(MATCHING, claim) == pairs.FIRST_RETRY_S

    def test_scenes_of_all_tenants_are_served(self, two: tuple[Store, PairStore]) -> None:
        store, stored = two
        progress = Progress()
        claim_all(stored, progress)
        store.create_scene(OTHER)
        store.add_references(OTHER, [make_reference("a", 4)])
        (claim,) = claim_all(stored, progress)
        assert (claim.scene_key, claim.reference_id) == (OTHER, "a")
        # A pair lies within one scene.
        assert stored.list_missing(MATCHING, claim, [key_of(store, name) for name in "abc"], 20) == []
        store.delete_scene(OTHER)
        store.create_scene(OTHER)
        store.add_references(OTHER, [make_reference("a", 5)])
        assert [it.scene_key for it in claim_all(stored, progress)] == [OTHER]

    def test_a_deleted_reference_is_not_claimed(self, two: tuple[Store, PairStore]) -> None:
        store, stored = two
        key = store.delete_reference(SCENE, "a")  # between listing and claiming
        assert not stored._claim(MATCHING, key)


OURS, THEIRS = "aliked/strict", "sift/strict"


@pytest.fixture
def used(two: tuple[Store, PairStore], monkeypatch: pytest.MonkeyPatch) -> Store:
    """Every pair of the three references, matched in two ways, both used now."""
    monkeypatch.setattr(pairs, "_REFERENCES_AT_A_TIME", 2)
    store, stored = two
    for name in (OURS, THEIRS):
        complete(store, stored, name)
    record_use(store.database, [OURS, THEIRS])
    return store


def count_pairs(place: Place) -> Counter[str]:
    return Counter(name for (name,) in place.fetch("SELECT matching FROM reference_pair"))


def nothing() -> None:
    pass


def test_what_is_used_by_any_server_is_kept(used: Store, place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    let_pass(monkeypatch, KEPT_S - 1)
    delete_unused(used.database, nothing)
    assert count_pairs(place) == {OURS: 3, THEIRS: 3}
    record_use(used.database, [OURS])
    let_pass(monkeypatch, 2)
    delete_unused(used.database, nothing)
    assert count_pairs(place) == {OURS: 3}
    assert place.fetch("SELECT matching FROM matching_use") == [(OURS,)]


@pytest.fixture
def unused(used: Store, monkeypatch: pytest.MonkeyPatch) -> Store:
    """The store when only one of the two ways has been used of late."""
    let_pass(monkeypatch, KEPT_S + 1)
    record_use(used.database, [OURS])
    return used


def test_deleted_pairs_are_made_again(unused: Store, place: Place) -> None:
    delete_unused(unused.database, nothing)
    record_use(unused.database, [THEIRS])
    assert complete(unused, PairStore(unused.database), OURS) == {}
    assert len(complete(unused, PairStore(unused.database), THEIRS)) == 3
    assert count_pairs(place) == {OURS: 3, THEIRS: 3}


def test_a_server_that_comes_back_meanwhile_stops_it(unused: Store, place: Place) -> None:
    calls = list[None]()

    def second_portion() -> None:
        calls.append(None)
        if len(calls) == 2:
            record_use(unused.database, [THEIRS])

    delete_unused(unused.database, second_portion)
    assert len(calls) == 2
    assert place.fetch("SELECT count(*) FROM reference_matching WHERE matching = ?", THEIRS) == [(1,)]
    assert complete(unused, PairStore(unused.database), THEIRS)


def test_a_deletion_that_was_interrupted_is_completed(unused: Store, place: Place) -> None:
    calls = list[None]()

    def end() -> None:
        calls.append(None)
        if len(calls) == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        delete_unused(unused.database, end)
    assert place.fetch("SELECT count(*) FROM reference_matching WHERE matching = ?", THEIRS) == [(1,)]
    delete_unused(unused.database, nothing)
    assert place.fetch("SELECT count(*) FROM reference_matching WHERE matching = ?", THEIRS) == [(0,)]
    assert count_pairs(place) == {OURS: 3}
