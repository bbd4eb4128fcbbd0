"""The scenes that a query searches: by labels or keys, current after every change; on either database."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
from sqlalchemy import event
from support.stores import Place, Shared, make_reference

from mapless.geodesy import Datum
from mapless_server.errors import DataLoss, NotFound
from mapless_server.security import DEFAULT_TENANT, SceneKey, SceneLimit, key_of, scene_id_of
from mapless_server.store import GroupedScene, SceneAttributes, Store
from mapless_server.store.scene_groups import NAME_BYTES

A, B, HALL = SceneKey("a"), SceneKey("b"), SceneKey("hall")
NORTH = {"site": "north"}
OUTDOORS = SceneAttributes(Datum(47.0, 8.0, 400.0))
DOWN = SceneAttributes(down_in_world=(0.0, 0.0, -1.0))


@contextmanager
def statements(store: Store) -> Iterator[list[str]]:
    """The statements that select scenes in the block."""
    found: list[str] = []
    with store.database.read() as connection:
        engine = connection.engine

    def note(*arguments: object) -> None:
        if str(arguments[2]).startswith("SELECT scene"):
            found.append(str(arguments[2]))

    event.listen(engine, "before_cursor_execute", note)
    try:
        yield found
    finally:
        event.remove(engine, "before_cursor_execute", note)


def keys_of(found: tuple[GroupedScene, ...]) -> list[str]:
    return [it.scene_key for it in found]


def test_scenes_of_a_group_are_those_with_all_labels(store: Store) -> None:
    for key, labels in ((HALL, NORTH | {"floor": "2"}), (B, {}), (A, NORTH), (key_of("acme", "a"), NORTH)):
        store.create_scene(key, labels=labels)
    assert keys_of(store.find_scenes(DEFAULT_TENANT)) == ["a", "b", "hall"]
    assert keys_of(store.find_scenes(DEFAULT_TENANT, NORTH)) == ["a", "hall"]
    assert keys_of(store.find_scenes(DEFAULT_TENANT, NORTH | {"floor": "2"})) == ["hall"]
    assert keys_of(store.find_scenes("acme")) == ["acme/a"]
    assert store.find_scenes("acme", {"site": "south"}) == store.find_scenes("nobody") == ()


def test_named_scenes_keep_the_order_and_say_who_is_missing(store: Store) -> None:
    for key in (A, B, HALL):
        store.create_scene(key)
    found = store.find_scenes_named([HALL, SceneKey("x"), A, key_of("acme", "b")])
    assert keys_of(found.found) == ["hall", "a"]
    assert found.missing == ("x", "acme/b")
    with pytest.raises(ValueError, match="at most 64 items, has 65"):
        store.find_scenes_named([SceneKey(f"s{it}") for it in range(65)])
    with pytest.raises(ValueError, match="twice"):
        store.find_scenes_named([A, A])


def test_a_groups_scenes_are_as_each_is_alone(store: Store) -> None:
    store.create_scene(A, OUTDOORS)
    store.create_scene(B, DOWN)
    store.create_scene(HALL, replace(DOWN, arbitrary_unit=True))
    store.add_references(B, [make_reference("r0")])
    for found in (store.find_scenes(DEFAULT_TENANT), store.find_scenes_named([A, B, HALL]).found):
        for scene, key in zip(found, (A, B, HALL), strict=True):
            alone = store.load_references(key, [], "sift").scene
            expected = (alone.generation, alone.create_time_us, alone.attributes)
            assert (scene.generation, scene.create_time_us, scene.attributes) == expected


def limit_of(*scene_ids: str, **labels: str) -> SceneLimit:
    return SceneLimit(frozenset(scene_ids), frozenset(labels.items()))


LIMITS = (limit_of("a", "x"), limit_of(site="north"), limit_of("b", site="north", floor="2"), limit_of("x", site="x"))


@pytest.mark.parametrize("limit", LIMITS)
def test_every_look_up_keeps_to_the_limit(store: Store, limit: SceneLimit) -> None:
    labels: dict[str, dict[str, str]] = {"a": {}, "b": NORTH, "hall": NORTH | {"floor": "2"}, "yard": {"floor": "2"}}
    for tenant in (DEFAULT_TENANT, "acme"):
        for scene_id, its in labels.items():
            store.create_scene(key_of(tenant, scene_id), labels=its)
    for tenant in (DEFAULT_TENANT, "acme"):
        expected = [key_of(tenant, it) for it in labels if limit.holds(it, labels[it])]
        assert keys_of(store.find_scenes(tenant, limit=limit)) == expected
        assert [it.scene_key for it in store.list_scenes(tenant, 10, limit=limit)] == expected
        of_group = [it for it in expected if labels[scene_id_of(it)].get("floor") == "2"]
        assert keys_of(store.find_scenes(tenant, {"floor": "2"}, limit)) == of_group
        assert [key_of(tenant, it) for it in labels if it in store.find_within(tenant, labels, limit)] == expected
        for scene_id in labels:
            key = key_of(tenant, scene_id)
            if key in expected:
                assert store.update_scene(key, labels=labels[scene_id], limit=limit).scene_key == key
            else:
                with pytest.raises(NotFound, match=f"there is no scene '{scene_id}'"):
                    store.update_scene(key, labels=NORTH | {"floor": "2"}, limit=limit)


def test_scenes_within_a_limit_are_asked_for_once(place: Place) -> None:
    with place.open() as store:
        store.create_scene(A, labels=NORTH)
        store.create_scene(B)
        for limit, count in ((limit_of("a", "b"), 0), (limit_of(site="north"), 1)):
            with statements(store) as first:
                found = store.find_within(DEFAULT_TENANT, ["a"], limit)
            with statements(store) as second:
                assert store.find_within(DEFAULT_TENANT, ["a"], limit) == found == {"a"}
            assert (len(first), len(second)) == (count, count if isinstance(place, Shared) else 0)
        store.update_scene(A, labels={})
        assert store.find_within(DEFAULT_TENANT, ["a"], limit_of(site="north")) == frozenset()


CHANGES: dict[str, Callable[[Store], object]] = {
    "create": lambda store: store.create_scene(HALL, labels=NORTH),
    "delete": lambda store: store.delete_scene(A),
    "labels": lambda store: store.update_scene(B, labels=NORTH),
    "datum": lambda store: store.update_scene(A, datum=OUTDOORS.datum),
    "references": lambda store: store.add_references(A, [make_reference("r0")]),
    "anew": lambda store: (store.delete_scene(A), store.create_scene(A, DOWN, NORTH)),
}


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("is_others", [False, True])
def test_every_change_counts_at_once(place: Place, change: str, is_others: bool) -> None:
    if is_others and not isinstance(place, Shared):
        pytest.skip("only one server writes here")
    with place.open() as store:
        store.create_scene(A, labels=NORTH)
        store.create_scene(B)
        store.find_scenes(DEFAULT_TENANT, NORTH), store.find_scenes_named([A, B, HALL])
        if is_others:
            with place.open() as other:
                CHANGES[change](other)
        else:
            CHANGES[change](store)
        group, named = store.find_scenes(DEFAULT_TENANT, NORTH), store.find_scenes_named([A, B, HALL])
        now = {it.scene_key: it for it in store.list_scenes(DEFAULT_TENANT, 10)}
        assert keys_of(group) == [key for key, it in now.items() if it.labels == NORTH]
        assert keys_of(named.found) == list(now)
        assert named.missing == tuple(it for it in (A, B, HALL) if it not in now)
        for scene in (*group, *named.found):
            expected = now[scene.scene_key]
            assert (scene.generation, scene.attributes) == (expected.generation, expected.attributes)


def test_an_unchanged_scene_or_group_stays_the_same_object(store: Store) -> None:
    store.create_scene(A, OUTDOORS)
    store.create_scene(B, DOWN)
    before = store.find_scenes(DEFAULT_TENANT)
    store.update_scene(B, down_in_world=None)
    after = store.find_scenes(DEFAULT_TENANT)
    assert [now is then for now, then in zip(after, before, strict=True)] == [True, False]
    store.create_scene(key_of("acme", "a"))
    assert store.find_scenes(DEFAULT_TENANT) is after


def test_a_group_is_read_in_one_statement_and_not_again(place: Place) -> None:
    with place.open() as store:
        for number in range(100):
            store.create_scene(SceneKey(f"s{number:03}"), labels=NORTH)
        names = [SceneKey(f"s{number:03}") for number in range(64)]
        with statements(store) as first:
            group, named = store.find_scenes(DEFAULT_TENANT, NORTH), store.find_scenes_named(names)
        with statements(store) as second:
            assert store.find_scenes(DEFAULT_TENANT, NORTH) == group
            assert store.find_scenes_named(names).found == named.found
        assert (len(group), len(named.found)) == (100, 64)
        assert len(first) == 2
        assert len(second) == (2 if isinstance(place, Shared) else 0)


def test_names_without_scenes_count_in_the_cache(store: Store) -> None:
    """With one scene that exists, each other name may be made up."""
    store.create_scene(A)
    sizes = []
    for made_up in (0, 63):
        before = store._groups._found.used
        store.find_scenes_named([A, *(SceneKey(f"x{it}") for it in range(made_up))])
        sizes.append(store._groups._found.used - before)
    assert sizes[1] - sizes[0] == 63 * NAME_BYTES


def test_a_damaged_scene_of_a_group_fails_alone(place: Place) -> None:
    with place.open() as store:
        store.create_scene(A, OUTDOORS)
        store.create_scene(B, DOWN)
    place.execute("UPDATE scene SET attributes_sha256 = ? WHERE scene_id = ?", "0" * 64, A)
    with place.open() as store:
        damaged, whole = store.find_scenes(DEFAULT_TENANT)
        assert whole.attributes == DOWN
        with pytest.raises(DataLoss, match="scene 'a' is damaged"):
            _ = damaged.attributes
