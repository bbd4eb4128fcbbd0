"""Adopted references, and references that are retired and restored; on either database."""

from collections.abc import Callable
from dataclasses import replace
from datetime import datetime, timedelta, timezone

import pytest
from support.adopted import COVARIANCE, HALL, RADII, VOUCHERS, adopted, hall
from support.stores import Place, make_reference

from mapless import AdoptionPolicy, Provenance
from mapless_server.errors import AlreadyExists, NotFound
from mapless_server.scenes.adoption.policy import AdoptionOptions, with_usefulness
from mapless_server.store import RetirementReason, Store, adoption
from mapless_server.store.pairs import PairStore, Progress
from mapless_server.store.portions import IndexReader
from mapless_server.store.records import Standing


def indexed(store: Store, since: int | None = None) -> list[str]:
    """Ids of the references that an index reads."""
    return [it.reference_id for it in store.list_changes(HALL, since, "vlad").added]


def test_what_vouches_for_an_adopted_reference_is_kept(place: Place) -> None:
    with place.open() as store:
        hall(store)
        adoption.adopt(store, HALL, adopted("new"), 9)
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
            adoption.adopt(store, HALL, adopted("new"), 9)
        assert indexed(store) == ["a", "b"]


def test_nothing_is_adopted_whose_voucher_was_deleted(place: Place) -> None:
    with place.open() as store:
        hall(store)
        store.delete_reference(HALL, "b")
        with pytest.raises(adoption.NotAdopted, match="vouches for it was deleted or retired"):
            adoption.adopt(store, HALL, adopted("new"), 9)


def test_nothing_is_adopted_whose_voucher_is_retired(place: Place) -> None:
    with place.open() as store:
        keys = hall(store)
        adoption.retire(store, HALL, [keys["b"]], RetirementReason.CONTRADICTED)
        with pytest.raises(adoption.NotAdopted, match="deleted or retired"):
            adoption.adopt(store, HALL, adopted("new"), 9)


def test_a_full_place_keeps_the_most_useful(place: Place) -> None:
    """However many servers adopt at once: what leaves is decided in the transaction that adds."""
    with place.open() as store:
        hall(store)
        first = adoption.adopt(store, HALL, adopted("x", 0.1), 2)[0].key
        adoption.adopt(store, HALL, adopted("y", 0.3), 2)
        before = store.get_generation(HALL)
        other = store.uncached()
        assert adoption.adopt(other, HALL, adopted("z"), 2)[1] == {first}
        assert [it.reference_id for it in adoption.list_adopted(store.database, HALL)] == ["z", "y"]
        changes = store.list_changes(HALL, before, "vlad")
        assert [it.reference_id for it in changes.added] == ["z"]
        assert changes.removed == {first}
        assert store.get_scene(HALL).reference_count == 4
        with pytest.raises(adoption.PlaceFull):
            adoption.adopt(store, HALL, adopted("w"), 2)
        assert indexed(store) == ["a", "b", "y", "z"]
        with pytest.raises(AlreadyExists):  # which does not make room for itself
            adoption.adopt(store, HALL, adopted("y", 0.9), 2)


def test_a_flood_by_one_token_pushes_out_one_a_day_at_most(place: Place) -> None:
    """Each of four gives 15 % of the matches of its place, and a new one may be worth 20 %."""
    with place.open() as store:
        hall(store)
        for i in range(4):
            adoption.adopt(store, HALL, adopted(f"useful-{i}", 0.15), 4)
        for day in range(2):
            adoption.adopt(store, HALL, adopted(f"flood-{day}", adopted_by=f"{day}:robot"), 4)
            for i in range(3):
                with pytest.raises(adoption.PlaceFull):
                    adoption.adopt(store, HALL, adopted(f"more-{day}-{i}", 0.9, adopted_by=f"{day}:robot"), 4)
        adoption.adopt(store, HALL, adopted("other", adopted_by="1:other"), 4)
        (key,) = (it.key for it in adoption.list_adopted(store.database, HALL) if it.reference_id == "other")
        adoption.retire(store, HALL, [key], RetirementReason.BY_OPERATOR)
        with pytest.raises(adoption.PlaceFull):
            adoption.adopt(store, HALL, adopted("again", adopted_by="1:other"), 4)


def test_over_days_what_photographs_use_stays(place: Place) -> None:
    """Each day three photographs match one of the place's two references, and a new photograph asks for room."""
    options = AdoptionOptions()
    with place.open() as store:
        hall(store)
        adoption.adopt(store, HALL, adopted("used", options.first_usefulness), 2)
        for day in range(10):
            adoption.adopt(store, HALL, adopted(f"of-day-{day}", options.first_usefulness), 2)
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
        key = adoption.adopt(store, HALL, adopted("x", 0.9), 1)[0].key
        adoption.retire(store, HALL, [key], RetirementReason.VOUCHERS_GONE)
        assert adoption.adopt(store, HALL, adopted("y"), 1)[1] == frozenset()


def test_of_two_servers_one_adopts_a_photograph(place: Place) -> None:
    with place.open() as store:
        hall(store)
        other = store.uncached()
        adoption.adopt(store, HALL, adopted("same"), 9)
        with pytest.raises(AlreadyExists):
            adoption.adopt(other, HALL, adopted("same"), 9)
        assert len(adoption.list_adopted(store.database, HALL)) == 1


def test_adopted_references_are_listed_by_usefulness(place: Place) -> None:
    with place.open() as store:
        hall(store)
        keys = {name: adoption.adopt(store, HALL, adopted(name, it), 9)[0].key for name, it in (("x", 0.3), ("y", 0.1))}
        assert [it.reference_id for it in adoption.list_adopted(store.database, HALL)] == ["y", "x"]
        adoption.set_usefulness(store.database, {keys["y"]: 0.5, "gone": 0.1})
        found = adoption.list_adopted(store.database, HALL)
        assert [(it.reference_id, it.usefulness, it.place_key) for it in found] == [
            ("x", 0.3, "place"),
            ("y", 0.5, "place"),
        ]


def test_old_adopted_references_expire_and_surveyed_do_not(place: Place) -> None:
    with place.open() as store:
        hall(store)
        adoption.adopt(store, HALL, adopted("new"), 9)
        now = datetime.now(timezone.utc)
        assert adoption.list_expired(store.database, now - timedelta(hours=1)) == []
        assert adoption.list_expired(store.database, now + timedelta(hours=1)) == [(HALL, "new")]


def test_an_adopted_reference_of_a_time_to_come_expires(place: Place) -> None:
    """A clock that was set back prolongs nothing."""
    with place.open() as store:
        hall(store)
        adoption.adopt(store, HALL, adopted("new"), 9)
        place.execute("UPDATE adopted_reference SET adopt_time_us = adopt_time_us + 3600000000")
        assert adoption.list_expired(store.database, datetime.now(timezone.utc) - timedelta(hours=1)) == [(HALL, "new")]


@pytest.mark.parametrize("how", ["deleted", "replaced", "retired"])
def test_lost_vouchers_are_weighed_by_their_matches(place: Place, how: str) -> None:
    with place.open() as store:
        keys = hall(store)
        key = adoption.adopt(store, HALL, adopted("new"), 9)[0].key
        assert adoption.missing_vouchers(store.database, HALL) == {}
        if how == "retired":
            adoption.retire(store, HALL, [keys["a"]], RetirementReason.CONTRADICTED)
        else:
            store.delete_reference(HALL, "a")
        if how == "replaced":  # by another photograph with its id
            store.add_references(HALL, [make_reference("a")])
        assert adoption.missing_vouchers(store.database, HALL) == {key: 40 / 60}


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
        assert store.restore_reference(HALL, "a").retired is None
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
        assert store.restore_reference(HALL, "b").retired is None
        retired = store.list_retirements(HALL, ["a", "b"])
        assert {name: it.reason for name, it in retired.items()} == {"a": RetirementReason.CONTRADICTED}
        with pytest.raises(NotFound):
            store.restore_reference(HALL, "gone")


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
            adoption.adopt(store, HALL, replace(adopted(name), place_key=keys[here]), 9)
        names = {it.reference_id: it.key for it in store.list_references(HALL, 10)}
        for key in names.values():
            adoption.retire(store, HALL, [key], RetirementReason.VOUCHERS_GONE)
        assert indexed(store) == []
        assert adoption.restore(store, HALL, place_id="a") == ["a", "at a"]
        assert indexed(store) == ["a", "at a"]
        later = datetime.now(timezone.utc) + timedelta(hours=1)
        assert adoption.restore(store, HALL, since=later) == []
        assert adoption.restore(store, HALL, since=later - timedelta(days=1)) == ["at b", "b"]
        assert sorted(indexed(store)) == ["a", "at a", "at b", "b"]
        assert adoption.restore(store, HALL) == []
        with pytest.raises(NotFound) as caught:
            adoption.restore(store, HALL, place_id="gone")
        assert caught.value.field == "place"


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
        assert adoption.list_outdated(store.database, HALL) == {keys["a"]: "a"}
        assert adoption.list_outdated_scenes(store.database) == {HALL: {keys["a"]: 9}}
        adoption.retire(store, HALL, [keys["a"]], RetirementReason.CONTRADICTED)
        store.restore_reference(HALL, "a")
        assert adoption.read_standings(store.database, keys.values()) == {}


def test_the_policy_of_a_scene_is_kept(place: Place) -> None:
    with place.open() as store:
        hall(store)
        store.update_scene(HALL, down_in_world=(0.0, 0.0, -1.0))
        assert store.get_attributes(HALL).adoption == AdoptionPolicy(most_per_place=2)
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
        store.restore_reference(HALL, "a")
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
        store.restore_reference(HALL, "a")
        assert [it.reference_id for it in reader.read_portion(HALL, "", 10, "vlad").references] == ["a", "b"]
