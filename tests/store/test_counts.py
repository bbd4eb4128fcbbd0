"""Counts of answered photographs, and what a report reads; on either database."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import datetime, timezone

import pytest
from sqlalchemy import Connection, func, select
from support.plain_reports import stored_counts, times
from support.stores import Place, Shared, make_reference

from mapless import Accuracy, AdoptionPolicy, Provenance, Voucher
from mapless_server.security import SceneKey
from mapless_server.store import RetirementReason, SceneAttributes, Store, adoption, counts, deletion
from mapless_server.store.counts import LOCALIZED, CountKey, Sums
from mapless_server.store.reporting import Days, find_references, read_report
from mapless_server.store.tables import scene_count

HALL = SceneKey("hall")
MONDAY = 20_000
"""A day since 1970."""
KEY = CountKey(MONDAY, "place", "low_overlap")
ONE = Sums(photograph_count=1, position_count=1, offset_x=1.5, squared_offset=2.25, forward_z=1.0)


def stored(store: Store, first_day: int = 0, last_day: int = 2 * MONDAY) -> dict[CountKey, Sums]:
    return stored_counts(store, HALL, first_day, last_day)


def test_counts_of_one_key_add_up(place: Place) -> None:
    other = CountKey(MONDAY, "place", LOCALIZED)
    with place.open() as store:
        store.create_scene(HALL)
        counts.add_counts(store.database, {HALL: {KEY: ONE}})
        counts.add_counts(store.database, {HALL: {KEY: times(ONE, 2), other: Sums(1, 1, 0.5, 40, 1, -3.0)}})
    with place.open() as store:
        assert stored(store) == {KEY: times(ONE, 3), other: Sums(1, 1, 0.5, 40, 1, -3.0)}


def test_counts_of_two_servers_add_up(shared: Shared) -> None:
    with shared.open() as first, shared.open() as second:
        first.create_scene(HALL)
        for store in (first, second):
            counts.add_counts(store.database, {HALL: {KEY: ONE}})
        assert stored(first) == stored(second) == {KEY: times(ONE, 2)}


def test_a_deleted_scene_leaves_no_counts(place: Place) -> None:
    with place.open() as store:
        store.create_scene(HALL)
        counts.add_counts(store.database, {HALL: {KEY: ONE}})
        store.delete_scene(HALL)
        counts.add_counts(store.database, {HALL: {KEY: ONE}})  # of a server that has not noticed
        store.create_scene(HALL)
        assert stored(store) == {}
    assert place.fetch("SELECT COUNT(*) FROM scene_count") == [(0,)]


def test_counting_is_no_change_of_the_scene(place: Place) -> None:
    with place.open() as store:
        before = store.create_scene(HALL).generation
        counts.add_counts(store.database, {HALL: {KEY: ONE}})
        assert store.get_generation(HALL) == before


def test_counts_of_old_days_are_deleted(place: Place) -> None:
    with place.open() as store:
        store.create_scene(HALL)
        counts.add_counts(store.database, {HALL: {KEY: ONE, KEY._replace(day=MONDAY + 1): ONE}})
        assert counts.delete_counts(store.database, MONDAY + 1) == 1
        assert [it.day for it in stored(store)] == [MONDAY + 1]


@pytest.mark.parametrize("of", ["days", "scene"])
def test_no_transaction_deletes_more_than_a_portion(place: Place, monkeypatch: pytest.MonkeyPatch, of: str) -> None:
    """Others wait for a portion, not for a year of counts."""
    monkeypatch.setattr(deletion, "COUNTS_AT_A_TIME", 2)
    with place.open() as store:
        store.create_scene(HALL)
        counts.add_counts(store.database, {HALL: {KEY._replace(day=MONDAY + i): ONE for i in range(5)}})
        write, left = store.database.write, list[int]()

        @contextmanager
        def counted() -> Iterator[Connection]:
            with write() as connection:
                yield connection
                left.append(connection.scalar(select(func.count()).select_from(scene_count)) or 0)

        monkeypatch.setattr(store.database, "write", counted)
        if of == "days":
            assert counts.delete_counts(store.database, MONDAY + 9) == 5
        else:
            store.delete_scene(HALL)
        assert left[:3] == [3, 1, 0]


def test_a_report_has_what_was_adopted_and_retired(place: Place) -> None:
    today = int(datetime.now(timezone.utc).timestamp()) // 86400
    with place.open() as store:
        store.create_scene(HALL, SceneAttributes(adoption=AdoptionPolicy()))
        keys = {it.reference_id: it.key for it in store.add_references(HALL, [make_reference(it) for it in "ab"])}
        at_b = keys["b"]
        known = Provenance("ADOPTED", Accuracy(0.01, 0.02, 0.1, 0.2), 0.5, (Voucher("b", 40),))
        (new, _), _ = [
            adoption.adopt(store, HALL, replace(make_reference(it), provenance=known, place_key=at_b), [at_b], 9)
            for it in "xy"
        ]
        adoption.retire(store, HALL, [new.key], RetirementReason.VOUCHERS_GONE)
        adoption.retire(store, HALL, [keys["a"]], RetirementReason.CONTRADICTED)
        with read_report(store.database, HALL, Days(today, today + 1, 1), 14) as reader:
            events, adopted = reader.events(9)
            assert find_references(reader.connection, HALL, [keys["a"], "gone"]).keys() == {keys["a"]}
        assert [(it.reference_id, it.retirement_reason) for it in reversed(events)] == [
            ("x", None),
            ("y", None),
            ("x", "vouchers_gone"),
            ("a", "contradicted"),
        ]
        assert adopted == {at_b: (1, 1), keys["a"]: (0, 1)}
        with read_report(store.database, HALL, Days(today - 9, today - 1, 1), 14) as reader:
            assert reader.events(9)[0] == []


def test_adding_to_many_scenes_is_one_transaction(place: Place) -> None:
    with place.open() as store:
        scenes = [SceneKey(f"s{i}") for i in range(3)]
        for it in scenes:
            store.create_scene(it)
        store.add_references(scenes[0], [make_reference("a")])
        counts.add_counts(store.database, {it: {KEY: ONE} for it in [*scenes, SceneKey("gone")]})
        assert counts.scenes_created(store.database, [*scenes, SceneKey("gone")]).keys() == set(scenes)
    assert place.fetch("SELECT COUNT(*) FROM scene_count") == [(3,)]


def test_the_scenes_with_most_photographs_are_named(place: Place) -> None:
    hall, yard, quiet = (SceneKey(it) for it in ("hall", "yard", "quiet"))
    localized = CountKey(MONDAY, "p", LOCALIZED)
    with place.open() as store:
        for it in (hall, yard, quiet):
            store.create_scene(it)
        planted = {
            hall: {KEY: times(ONE, 3), localized: Sums(photograph_count=2)},
            yard: {localized._replace(day=MONDAY + 1): Sums(photograph_count=9)},
            quiet: {localized: Sums(photograph_count=1), localized._replace(day=MONDAY - 1): Sums(photograph_count=50)},
        }
        counts.add_counts(store.database, planted)
        assert counts.busiest_scenes(store.database, MONDAY, 7, 3) == [
            (yard, 9, 9, 0, 0),
            (hall, 5, 2, 0, 0),
            (quiet, 1, 1, 50, 50),
        ]
