"""Adopted references, and references that are retired and restored; on either database."""

from collections.abc import Callable, Mapping
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from typing import Any

import pytest
from sqlalchemy import Connection, Table
from support.adopted import COVARIANCE, HALL, RADII, VOUCHERS, adopt, adopted, hall
from support.stores import Place, make_reference

from mapless import AdoptionPolicy, Provenance, Voucher
from mapless_server.errors import AlreadyExists, FailedPrecondition, NotFound
from mapless_server.scenes.adoption.policy import AdoptionOptions, with_usefulness
from mapless_server.security import SceneKey
from mapless_server.store import RetirementReason, Store, adoption, queries, restoring
from mapless_server.store.pairs import PairStore, Progress
from mapless_server.store.portions import IndexReader
from mapless_server.store.records import Standing


def indexed(store: Store, since: int | None = None) -> list[str]:
    """Ids of the references that an index reads."""
    return [it.reference_id for it in store.list_changes(HALL, since, "vlad").added]


def test_what_vouches_for_an_adopted_reference_is_kept(place: Place) -> None:
    with place.open() as store:
        hall(store)
        adopt(store, adopted("new"), 9)
    with place.open() as store:
        assert store.get_reference(HALL, "new").provenance == Provenance("ADOPTED", RADII, 0.5, VOUCHERS, COVARIANCE)
        assert [it.reference_id for it in store.list_references(HALL, 10, only_adopted=True)] == ["new"]
        assert [it.reference_id for it in store.list_references(HALL, 10)] == ["a", "b", "new"]
        assert adoption.list_adopting_scenes(store.database) == {HALL: store.get_generation(HALL)}


def test_nothing_is_adopted_once_the_scene_stops(place: Place) -> None:
    with place.open() as store:
        hall(store)
        store.update_scene(HALL, adoption=None)
        with pytest.raises(adoption.NotAdopted, match="adopts no photographs any more"):
            adopt(store, adopted("new"), 9)
        assert indexed(store) == ["a", "b"]


def test_nothing_is_adopted_whose_voucher_was_deleted(place: Place) -> None:
    with place.open() as store:
        hall(store)
        store.delete_reference(HALL, "b")
        with pytest.raises(adoption.NotAdopted, match="vouches for it was deleted, retired"):
            adopt(store, adopted("new"), 9)


def test_nothing_is_adopted_whose_voucher_is_retired(place: Place) -> None:
    with place.open() as store:
        keys = hall(store)
        adoption.retire(store, HALL, [keys["b"]], RetirementReason.CONTRADICTED)
        with pytest.raises(adoption.NotAdopted, match="vouches for it was deleted, retired"):
            adopt(store, adopted("new"), 9)


def test_nothing_is_adopted_whose_voucher_was_replaced(place: Place) -> None:
    """By another photograph with its id, while the photograph was considered; an adopted one vouches for nothing."""
    with place.open() as store:
        keys = hall(store)
        store.delete_reference(HALL, "b")
        store.add_references(HALL, [make_reference("b", seed=1)])
        new = replace(adopted("new"), place_key=keys["a"])
        with pytest.raises(adoption.NotAdopted, match="retired or replaced"):
            adoption.adopt(store, HALL, new, keys.values(), 9)
        adopt(store, new)
        with pytest.raises(adoption.NotAdopted, match="vouches for it"):
            adopt(store, adopted("other", vouchers=(Voucher("a", 40), Voucher("new", 20))))


def test_nothing_is_adopted_where_the_place_has_changed(place: Place) -> None:
    """By another server, which found it outdated meanwhile; or its reference is gone."""
    with place.open() as store:
        keys, here = hall(store), adopted("new", vouchers=(Voucher("b", 40),))
        adoption.change_standings(store.database, [keys["a"]], lambda _, it: adoption.outdated(it))
        with pytest.raises(adoption.NotAdopted, match="its place needs a new survey"):
            adopt(store, replace(here, place_key=keys["a"]))
        store.delete_reference(HALL, "a")
        with pytest.raises(adoption.NotAdopted, match="the surveyed reference of its place was deleted"):
            adopt(store, replace(here, place_key=keys["a"]))


def test_a_standing_deleted_while_it_is_locked_is_made_again(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """As by another server that restores the reference at that moment."""
    insert_new, calls = queries.insert_new, list[str]()

    def insert(connection: Connection, table: Table, row: Mapping[str, Any]) -> bool:
        calls.append(table.name)
        return len(calls) > 1 and insert_new(connection, table, row)

    with place.open() as store:
        key = hall(store)["a"]
        monkeypatch.setattr(queries, "insert_new", insert)
        made = adoption.change_standings(store.database, [key], lambda _, it: replace(it, photograph_count=1))
        assert made == adoption.read_standings(store.database, [key]) == {key: Standing(photograph_count=1)}


def test_a_full_place_keeps_the_most_useful(place: Place) -> None:
    """However many servers adopt at once: what leaves is decided in the transaction that adds."""
    with place.open() as store:
        hall(store)
        first = adopt(store, adopted("x", 0.1), 2)[0].key
        adopt(store, adopted("y", 0.3), 2)
        before = store.get_generation(HALL)
        other = store.uncached()
        assert adopt(other, adopted("z"), 2)[1] == {first}
        assert [it.reference_id for it in adoption.list_adopted(store.database, HALL)] == ["z", "y"]
        changes = store.list_changes(HALL, before, "vlad")
        assert [it.reference_id for it in changes.added] == ["z"]
        assert changes.removed == {first}
        assert store.get_scene(HALL).reference_count == 4
        with pytest.raises(adoption.PlaceFull):
            adopt(store, adopted("w"), 2)
        assert indexed(store) == ["a", "b", "y", "z"]
        with pytest.raises(AlreadyExists):  # which does not make room for itself
            adopt(store, adopted("y", 0.9), 2)


def test_a_flood_by_one_token_pushes_out_one_a_day_at_most(place: Place) -> None:
    """Each of four gives 15 % of the matches of its place, and a new one may be worth 20 %."""
    with place.open() as store:
        hall(store)
        for i in range(4):
            adopt(store, adopted(f"useful-{i}", 0.15), 4)
        for day in range(2):
            adopt(store, adopted(f"flood-{day}", adopted_by=f"{day}:robot"), 4)
            for i in range(3):
                with pytest.raises(adoption.PlaceFull):
                    adopt(store, adopted(f"more-{day}-{i}", 0.9, adopted_by=f"{day}:robot"), 4)
        adopt(store, adopted("other", adopted_by="1:other"), 4)
        (key,) = (it.key for it in adoption.list_adopted(store.database, HALL) if it.reference_id == "other")
        adoption.retire(store, HALL, [key], RetirementReason.BY_OPERATOR)
        with pytest.raises(adoption.PlaceFull):
            adopt(store, adopted("again", adopted_by="1:other"), 4)


def test_over_days_what_photographs_use_stays(place: Place) -> None:
    """Each day three photographs match one of the place's two references, and a new photograph asks for room."""
    options = AdoptionOptions()
    with place.open() as store:
        hall(store)
        adopt(store, adopted("used", options.first_usefulness), 2)
        for day in range(10):
            adopt(store, adopted(f"of-day-{day}", options.first_usefulness), 2)
            here = {it.reference_id: it for it in adoption.list_adopted(store.database, HALL)}
            assert set(here) == {"used", f"of-day-{day}"}
            for name, share in {"used": 0.3, f"of-day-{day}": 0.0}.items():
                useful = here[name].usefulness
                for _ in range(3):
                    useful = with_usefulness(useful, share, options)
                adoption.set_usefulness(store.database, {here[name].key: useful})


def test_a_retired_reference_keeps_no_place_full(place: Place) -> None:
    with place.open() as store:
        hall(store)
        key = adopt(store, adopted("x", 0.9), 1)[0].key
        adoption.retire(store, HALL, [key], RetirementReason.VOUCHERS_GONE)
        assert adopt(store, adopted("y"), 1)[1] == frozenset()


def test_of_two_servers_one_adopts_a_photograph(place: Place) -> None:
    with place.open() as store:
        hall(store)
        other = store.uncached()
        adopt(store, adopted("same"), 9)
        with pytest.raises(AlreadyExists):
            adopt(other, adopted("same"), 9)
        assert len(adoption.list_adopted(store.database, HALL)) == 1


def test_adopted_references_are_listed_by_usefulness(place: Place) -> None:
    with place.open() as store:
        at_a = hall(store)["a"]
        keys = {name: adopt(store, adopted(name, it), 9)[0].key for name, it in (("x", 0.3), ("y", 0.1))}
        assert [it.reference_id for it in adoption.list_adopted(store.database, HALL)] == ["y", "x"]
        assert adoption.list_adopted_at(store.database, [at_a]) == adoption.list_adopted(store.database, HALL)
        assert adoption.list_adopted_at(store.database, ["elsewhere"]) == []
        adoption.set_usefulness(store.database, {keys["y"]: 0.5, "gone": 0.1})
        found = adoption.list_adopted(store.database, HALL)
        assert [(it.reference_id, it.usefulness, it.place_key) for it in found] == [
            ("x", 0.3, at_a),
            ("y", 0.5, at_a),
        ]


def test_old_adopted_references_expire_and_surveyed_do_not(place: Place) -> None:
    with place.open() as store:
        hall(store)
        adopt(store, adopted("new"), 9)
        now = datetime.now(timezone.utc)
        assert adoption.list_expired(store.database, now - timedelta(hours=1)) == []
        assert adoption.list_expired(store.database, now + timedelta(hours=1)) == [(HALL, "new")]


def test_an_adopted_reference_of_a_time_to_come_expires(place: Place) -> None:
    """A clock that was set back prolongs nothing."""
    with place.open() as store:
        hall(store)
        adopt(store, adopted("new"), 9)
        place.execute("UPDATE adopted_reference SET adopt_time_us = adopt_time_us + 3600000000")
        assert adoption.list_expired(store.database, datetime.now(timezone.utc) - timedelta(hours=1)) == [(HALL, "new")]


@pytest.mark.parametrize("how", ["deleted", "replaced", "retired"])
def test_lost_vouchers_are_weighed_by_their_matches(place: Place, how: str) -> None:
    with place.open() as store:
        keys = hall(store)
        key = adopt(store, adopted("new"), 9)[0].key
        assert adoption.unvouched(store.database, HALL) == []
        if how == "retired":
            adoption.retire(store, HALL, [keys["a"]], RetirementReason.CONTRADICTED)
        else:
            store.delete_reference(HALL, "a")
        if how == "replaced":  # by another photograph with its id
            store.add_references(HALL, [make_reference("a")])
        assert adoption.unvouched(store.database, HALL) == [key]  # 40 of 60


def test_a_retired_reference_leaves_indexes_until_restored(place: Place) -> None:
    with place.open() as store:
        keys = hall(store)
        before = store.get_generation(HALL)
        assert adoption.retire(store, HALL, [keys["a"], "gone"], RetirementReason.CONTRADICTED) == [keys["a"]]
        changes = store.list_changes(HALL, before, "vlad")
        assert (len(changes.added), sorted(changes.removed)) == (0, [keys["a"]])
        assert indexed(store) == ["b"]
        retired = store.get_reference(HALL, "a").retired
        assert retired is not None
        assert retired.reason is RetirementReason.CONTRADICTED
        assert list(store.list_retirements(HALL, ["a", "b"])) == ["a"]
        assert [it.reference_id for it in store.list_references(HALL, 10, only_retired=True)] == ["a"]
        between = store.get_generation(HALL)
        assert restoring.restore_reference(store, HALL, "a").retired is None
        for since in (before, between):
            changes = store.list_changes(HALL, since, "vlad")
            assert changes.is_whole
            assert [it.reference_id for it in changes.added] == ["a", "b"]
        assert indexed(store) == ["a", "b"]
        assert store.get_scene(HALL).reference_count == 2


def test_retiring_twice_and_restoring_others_changes_nothing(place: Place) -> None:
    with place.open() as store:
        keys = hall(store)
        adoption.retire(store, HALL, [keys["a"]], RetirementReason.CONTRADICTED)
        assert adoption.retire(store, HALL, [keys["a"]], RetirementReason.SURVEY_OUTDATED) == []
        assert restoring.restore_reference(store, HALL, "b").retired is None
        retired = store.list_retirements(HALL, ["a", "b"])
        assert {name: it.reason for name, it in retired.items()} == {"a": RetirementReason.CONTRADICTED}
        with pytest.raises(NotFound):
            restoring.restore_reference(store, HALL, "gone")


def test_an_operator_retires_a_reference_once(place: Place) -> None:
    with place.open() as store:
        keys = hall(store)
        retired = adoption.retire_by_operator(store, HALL, "a").retired
        assert retired is not None
        assert retired.reason is RetirementReason.BY_OPERATOR
        assert indexed(store) == ["b"]
        assert adoption.retire_by_operator(store, HALL, "a").retired == retired
        adoption.retire(store, HALL, [keys["b"]], RetirementReason.CONTRADICTED)
        again = adoption.retire_by_operator(store, HALL, "b").retired
        assert again is not None
        assert again.reason is RetirementReason.CONTRADICTED
        with pytest.raises(NotFound):
            adoption.retire_by_operator(store, HALL, "gone")


def test_all_retired_ones_are_restored_or_some_of_them(place: Place) -> None:
    with place.open() as store:
        keys = hall(store)
        for name, here in (("at a", "a"), ("at b", "b")):
            adopt(store, replace(adopted(name), place_key=keys[here]), 9)
        names = {it.reference_id: it.key for it in store.list_references(HALL, 10)}
        for key in names.values():
            adoption.retire(store, HALL, [key], RetirementReason.BY_OPERATOR)
        assert indexed(store) == []
        assert restoring.restore(store, HALL, place_id="a").reference_ids == ["a", "at a"]
        assert indexed(store) == ["a", "at a"]
        later = datetime.now(timezone.utc) + timedelta(hours=1)
        assert restoring.restore(store, HALL, since=later).reference_ids == []
        assert restoring.restore(store, HALL, since=later - timedelta(days=1)).reference_ids == ["at b", "b"]
        assert sorted(indexed(store)) == ["a", "at a", "at b", "b"]
        assert restoring.restore(store, HALL) == restoring.Restored([], {})
        with pytest.raises(NotFound) as caught:
            restoring.restore(store, HALL, place_id="gone")
        assert caught.value.field == "place"


@pytest.mark.parametrize("by", ["place", "all"])
def test_restoring_ends_that_a_place_is_outdated(place: Place, by: str) -> None:
    """A false alarm: without that, the next photograph would retire what is restored."""
    with place.open() as store:
        keys = hall(store)
        new, _ = adopt(store, adopted("new"))
        adoption.change_standings(store.database, [keys["a"]], lambda _, it: adoption.outdated(it))
        adoption.retire(store, HALL, [new.key], RetirementReason.SURVEY_OUTDATED)
        with pytest.raises(FailedPrecondition, match="its place needs a new survey"):
            restoring.restore_reference(store, HALL, "new")
        day = datetime.now(timezone.utc) - timedelta(days=1)
        assert restoring.restore(store, HALL, since=day).staying == {"new": "its place needs a new survey"}
        restored = restoring.restore(store, HALL, place_id="a" if by == "place" else "")
        assert restored == restoring.Restored(["new"], {})
        assert adoption.list_outdated_scenes(store.database) == {}


def test_what_nothing_vouches_for_stays_retired(place: Place) -> None:
    with place.open() as store:
        keys = hall(store)
        new, _ = adopt(store, adopted("new", vouchers=(Voucher("b", 40),)))
        for key in (keys["b"], new.key):
            adoption.retire(store, HALL, [key], RetirementReason.CONTRADICTED)
        with pytest.raises(FailedPrecondition, match="what vouches for it was deleted or is retired"):
            restoring.restore_reference(store, HALL, "new")
        assert list(restoring.restore(store, HALL, place_id="a").staying) == ["new"]
        assert restoring.restore(store, HALL).reference_ids == ["b", "new"]
        assert adoption.unvouched(store.database, HALL) == []


def test_restoring_keeps_to_the_most_of_a_place(place: Place) -> None:
    with place.open() as store:
        hall(store)
        retired = [adopt(store, adopted(f"old-{it}", it / 10))[0].key for it in range(3)]
        adoption.retire(store, HALL, retired, RetirementReason.SURVEY_OUTDATED)
        adopt(store, adopted("new"))
        restored = restoring.restore(store, HALL)  # two is the most
        assert restored.reference_ids == ["old-2"]
        assert list(restored.staying) == ["old-0", "old-1"]
        assert set(restored.staying.values()) == {"its place has as many adopted references as it may"}
        assert len(adopt(store, adopted("newer", 0.9), 2)[1]) == 1


def _moved(store: Store) -> tuple[dict[str, str], dict[str, RetirementReason]]:
    """Keys by id, and why references retire: three of a deleted place b come to a place that has one."""
    keys = hall(store)
    vouchers = (Voucher("a", 40),)
    for name, useful, here in (("at a", 0.25, "a"), ("b1", 0.1, "b"), ("b2", 0.2, "b"), ("b3", 0.3, "b")):
        keys[name] = adopt(store, replace(adopted(name, useful, vouchers), place_key=keys[here]))[0].key
    adoption.retire(store, HALL, [keys["b1"]], RetirementReason.BY_OPERATOR)
    store.delete_reference(HALL, "b")
    unplaced = adoption.list_unplaced(store.database, HALL)
    assert unplaced == sorted(keys[it] for it in ("b1", "b2", "b3"))
    return keys, adoption.set_places(store, HALL, dict.fromkeys(unplaced, keys["a"]))


def test_a_place_that_gets_others_keeps_the_most_useful(place: Place) -> None:
    with place.open() as store:
        keys, reasons = _moved(store)  # two is the most; what is retired already takes no room
        assert reasons == {keys["b2"]: RetirementReason.PLACE_FULL}
        assert indexed(store) == ["a", "at a", "b3"]
        assert adoption.list_unplaced(store.database, HALL) == []
        store.delete_reference(HALL, "at a")
        assert restoring.restore(store, HALL).reference_ids == ["b2"]


def test_moved_to_an_outdated_place_a_reference_retires(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    with place.open() as store:
        delete = store.delete_reference

        def outdated(scene_key: SceneKey, reference_id: str) -> str:
            at_a = store.find_keys(HALL, ["a"]).values()
            adoption.change_standings(store.database, at_a, lambda _, it: adoption.outdated(it))
            return delete(scene_key, reference_id)

        monkeypatch.setattr(store, "delete_reference", outdated)
        keys, reasons = _moved(store)
        assert reasons == {keys[it]: RetirementReason.SURVEY_OUTDATED for it in ("at a", "b2", "b3")}
        assert indexed(store) == ["a"]


def test_standings_are_counted_and_forgotten_when_restored(place: Place) -> None:
    with place.open() as store:
        keys = hall(store)

        def counted(key: str, it: Standing) -> Standing:
            return replace(
                it,
                contradiction_count=it.contradiction_count + 1,
                surveyed_share=0.25,
                photograph_count=5,
                contradicted_by=("7:", "8:a"),
                surveyed_by=("7::25", "8:a:30"),
                outdate_time_us=9,
            )

        change: Callable[[str, Standing], Standing] = counted
        for _ in range(2):
            made = adoption.change_standings(store.database, [keys["a"], "gone"], change)
        assert (
            made
            == {keys["a"]: Standing(2, 0, 0.25, 5, ("7:", "8:a"), ("7::25", "8:a:30"), 9)}
            == adoption.read_standings(store.database, keys.values())
        )
        assert adoption.list_outdated_scenes(store.database) == {HALL: {keys["a"]: 9}}
        adoption.retire(store, HALL, [keys["a"]], RetirementReason.CONTRADICTED)
        restoring.restore_reference(store, HALL, "a")
        assert adoption.read_standings(store.database, keys.values()) == {}


def test_the_policy_of_a_scene_is_kept(place: Place) -> None:
    with place.open() as store:
        hall(store)
        store.update_scene(HALL, down_in_world=(0.0, 0.0, -1.0))
        assert store.get_attributes(HALL).adoption == AdoptionPolicy(most_per_place=2, max_radius_m=0.03)
        assert store.update_scene(HALL, adoption=None).attributes.adoption is None


def test_the_background_leaves_retired_references_alone(place: Place) -> None:
    with place.open() as store:
        keys, pairs, progress = hall(store), PairStore(store.database), Progress()
        adoption.retire(store, HALL, [keys["a"]], RetirementReason.CONTRADICTED)
        claim = pairs.claim("nearest", progress)
        assert claim is not None
        assert claim.reference_id == "b"
        pairs.add("nearest", claim, {}, is_complete=True)
        assert pairs.claim("nearest", progress) is None
        assert pairs.count_waiting("nearest") == 0
        restoring.restore_reference(store, HALL, "a")
        assert pairs.count_waiting("nearest") == 1
        claim = pairs.claim("nearest", progress)
        assert claim is not None
        assert claim.reference_id == "a"


def test_a_scene_read_in_portions_lacks_retired_references(place: Place) -> None:
    with place.open() as store:
        keys, reader = hall(store), IndexReader(store.database)
        adoption.retire(store, HALL, [keys["a"]], RetirementReason.CONTRADICTED)
        assert [it.reference_id for it in reader.read_portion(HALL, "", 10, "vlad").references] == ["b"]
        assert reader.read_state(HALL).reference_count == 1
        restoring.restore_reference(store, HALL, "a")
        assert [it.reference_id for it in reader.read_portion(HALL, "", 10, "vlad").references] == ["a", "b"]
