"""Self-calibrations in the store: each scene is claimed by one server, and what is stored holds for its kind alone."""

from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
from support.stores import Place, let_pass, make_reference

from mapless_server.security import SceneKey
from mapless_server.store import SceneAttributes, SelfCalibration, Store, calibration_kind
from mapless_server.store.calibrations import (
    CLAIM_S,
    CalibrationClaim,
    add,
    claim_scene,
    count_waiting,
    discard_damaged,
    list_newest,
    postpone,
    release,
    renew,
)
from mapless_server.store.pairs import delete_unused, record_use

OFFICE = SceneKey("office")
KIND, OTHER = calibration_kind("sift", "geometric", "1"), calibration_kind("aliked", "geometric", "1")


@pytest.fixture
def store(place: Place) -> Iterator[Store]:
    with place.open() as store:
        store.create_scene(OFFICE)
        store.add_references(OFFICE, [make_reference("a", 1), make_reference("b", 2)])
        yield store


def of(store: Store, factor: float = 2.0, kind: str = KIND) -> SelfCalibration:
    generation = store.get_generation(OFFICE)
    return SelfCalibration(kind, generation, 12, factor, 0.5, 0.01, 0.1, (0.0, 1 / 3, 1.0))


def claimed(store: Store, kind: str = KIND) -> CalibrationClaim:
    claim = claim_scene(store.database, kind)
    assert claim is not None
    return claim


def test_every_bit_comes_back_with_the_attributes(store: Store) -> None:
    assert store.get_attributes(OFFICE) == SceneAttributes()
    generation = store.get_generation(OFFICE)
    assert add(store, claimed(store), of(store), 0.0)
    assert store.get_attributes(OFFICE).self_calibrations == (of(store),)
    assert store.get_attributes(OFFICE).self_calibration(OTHER) is None
    assert store.get_generation(OFFICE) == generation
    store.update_scene(OFFICE, down_in_world=(0.0, 0.0, -1.0))
    assert store.get_scene(OFFICE).attributes == SceneAttributes(down_in_world=(0.0, 0.0, -1.0))


def test_a_scene_is_due_after_each_change_alone(store: Store) -> None:
    assert count_waiting(store.database, KIND) == 1
    add(store, claimed(store), of(store), 0.0)
    assert (count_waiting(store.database, KIND), claim_scene(store.database, KIND)) == (0, None)
    assert claimed(store, OTHER).kind == OTHER
    store.delete_reference(OFFICE, "a")
    assert count_waiting(store.database, KIND) == 1
    assert claimed(store).scene_key == OFFICE
    assert store.get_attributes(OFFICE).self_calibration(KIND) is not None  # the last one until then


def test_a_first_calibration_leaves_the_scene_due(store: Store) -> None:
    assert claim_scene(store.database, KIND, is_first=True) is None  # two references
    store.add_references(OFFICE, [make_reference("c", 3)])
    first = claim_scene(store.database, KIND, is_first=True)
    assert first is not None
    found = of(store)
    assert add(store, first, found, 0.0, is_first=True)
    assert store.get_attributes(OFFICE).self_calibrations == (found,)
    assert claim_scene(store.database, KIND, is_first=True) is None
    assert claim_scene(store.database, KIND) is not None


def test_a_first_calibration_is_made_again_when_references_double(store: Store) -> None:
    store.add_references(OFFICE, [make_reference("c", 3)])
    first = claim_scene(store.database, KIND, is_first=True)
    assert first is not None
    store.add_references(OFFICE, [make_reference("too late", 4)])
    add(store, first, of(store), 0.0, is_first=True)
    for _ in range(9):
        store.update_scene(OFFICE, down_in_world=(0.0, 0.0, -1.0))
    assert claim_scene(store.database, KIND, is_first=True) is None
    store.add_references(OFFICE, [make_reference(f"more-{i}", 5 + i) for i in range(2)])
    again = claim_scene(store.database, KIND, is_first=True)
    assert again is not None
    add(store, again, of(store), 0.0)
    store.add_references(OFFICE, [make_reference(f"most-{i}", 40 + i) for i in range(6)])
    assert claim_scene(store.database, KIND, is_first=True) is None  # idle time does it


def test_after_an_upgrade_no_calibration_is_a_first_one(store: Store) -> None:
    store.add_references(OFFICE, [make_reference("c", 3)])
    add(store, claimed(store, OTHER), of(store, kind=OTHER), 0.0)
    assert claim_scene(store.database, KIND, is_first=True) is None
    assert claim_scene(store.database, KIND) is not None


def test_frequent_changes_do_not_keep_servers_busy(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    add(store, claimed(store), of(store), 100.0)
    store.delete_reference(OFFICE, "a")
    assert claim_scene(store.database, KIND) is None
    let_pass(monkeypatch, 101.0)
    assert claim_scene(store.database, KIND) is not None


def test_of_two_servers_one_calibrates(store: Store) -> None:
    with ThreadPoolExecutor(4) as pool:
        claims = list(pool.map(lambda _: claim_scene(store.database, KIND), range(8)))
    assert sum(it is not None for it in claims) == 1


def test_the_claim_of_a_killed_server_ends(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    killed = claimed(store)
    let_pass(monkeypatch, CLAIM_S - 1)
    assert claim_scene(store.database, KIND) is None
    let_pass(monkeypatch, 2)
    found = claimed(store)
    assert renew(store.database, killed) is None
    assert not add(store, killed, of(store, 9.0), 0.0)
    assert add(store, found, of(store), 0.0)
    assert store.get_attributes(OFFICE).self_calibrations == (of(store),)


def test_a_renewed_claim_lasts(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    claim = claimed(store)
    let_pass(monkeypatch, CLAIM_S - 1)
    renewed = renew(store.database, claim)
    assert renewed is not None
    let_pass(monkeypatch, CLAIM_S - 1)
    assert claim_scene(store.database, KIND) is None
    assert add(store, renewed, of(store), 0.0)


def test_failures_are_tried_again_later_and_later(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    waits = []
    for _ in range(3):
        waits.append(postpone(store.database, claimed(store)))
        assert claim_scene(store.database, KIND) is None
        let_pass(monkeypatch, waits[-1] + 1)
    assert waits == [30, 60, 120]


def test_a_closed_server_leaves_the_scene_to_others(store: Store) -> None:
    release(store.database, claimed(store))
    assert claim_scene(store.database, KIND) is not None


def test_a_deleted_scene_takes_its_calibration_along(store: Store, place: Place) -> None:
    add(store, claimed(store), of(store), 0.0)
    store.delete_reference(OFFICE, "a")
    claim = claimed(store)
    store.delete_scene(OFFICE)
    store.create_scene(OFFICE)
    assert not add(store, claim, SelfCalibration(KIND, 99, 12, 9.0), 0.0)
    assert store.get_attributes(OFFICE) == SceneAttributes()
    assert place.fetch("SELECT * FROM scene_calibration") == []


def test_damaged_ones_are_not_used_and_made_again(store: Store, place: Place) -> None:
    add(store, claimed(store), of(store), 0.0)
    place.execute("UPDATE scene_calibration SET sha256 = ?", "0" * 64)
    store.update_scene(OFFICE, down_in_world=None)  # forgets what is cached
    assert store.get_attributes(OFFICE).self_calibrations == ()
    assert discard_damaged(store.database, OTHER) == 0
    assert discard_damaged(store.database, KIND) == 1
    assert claim_scene(store.database, KIND) is not None


def test_kinds_without_use_are_deleted(store: Store, place: Place) -> None:
    for kind in (KIND, OTHER):
        add(store, claimed(store, kind), of(store, kind=kind), 0.0)
    record_use(store.database, [KIND, OTHER])
    place.execute("UPDATE matching_use SET used_time_us = 0 WHERE matching = ?", OTHER)
    delete_unused(store.database, lambda: None)
    assert place.fetch("SELECT kind FROM scene_calibration") == [(KIND,)]


def test_the_newest_references_come_first(store: Store) -> None:
    store.add_references(OFFICE, [make_reference("c", 3)])
    assert list_newest(store.database, OFFICE, 1) == ["c"]
    assert set(list_newest(store.database, OFFICE, 9)) == {"a", "b", "c"}
