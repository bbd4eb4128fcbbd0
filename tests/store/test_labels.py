"""Labels group scenes: stored, replaced together, and found without reading other scenes; on either database."""

import pytest
from support.stores import Place

from mapless_server.errors import NotFound
from mapless_server.security import DEFAULT_TENANT, SceneKey, key_of

A, B, HALL = SceneKey("a"), SceneKey("b"), SceneKey("hall")
SITE = {"site": "north", "floor": "1"}


def test_scenes_are_listed_by_all_of_their_labels(place: Place) -> None:
    with place.open() as store:
        store.create_scene(A, labels=SITE)
        store.create_scene(B, labels=SITE | {"floor": "2"})
        store.create_scene(HALL)
        store.create_scene(key_of("acme", "a"), labels=SITE)

        def listed(**labels: str) -> list[str]:
            return [it.scene_id for it in store.list_scenes(DEFAULT_TENANT, 10, labels=labels)]

        assert listed(site="north") == ["a", "b"]
        assert listed(site="north", floor="2") == ["b"]
        assert listed(site="NORTH") == listed(floor="north") == []
        assert [it.scene_id for it in store.list_scenes(DEFAULT_TENANT, 1, "a", {"site": "north"})] == ["b"]
        assert [it.scene_key for it in store.list_scenes("acme", 10, labels=SITE)] == ["acme/a"]


def test_labels_are_replaced_together(place: Place) -> None:
    with place.open() as store:
        before = store.create_scene(A, labels=SITE)
        assert store.update_scene(A, down_in_world=(0.0, 0.0, -1.0)).labels == before.labels == SITE
        after = store.update_scene(A, labels={"site": "south"})
        assert after.labels == {"site": "south"}
        assert store.update_scene(A, labels={}).labels == store.get_scene(A).labels == {}


def test_labels_are_no_change_of_what_is_computed(place: Place) -> None:
    with place.open() as store:
        store.create_scene(A)
        before = store.get_generation(A)
        assert store.update_scene(A, labels=SITE).generation == store.get_generation(A) == before
        assert store.update_scene(A, labels={}, down_in_world=(0.0, 0.0, -1.0)).generation > before
        with pytest.raises(NotFound):
            store.update_scene(B, labels=SITE)


def test_a_scene_made_anew_has_no_labels_of_the_former(place: Place) -> None:
    with place.open() as store:
        store.create_scene(A, labels=SITE)
        store.delete_scene(A)
        assert store.create_scene(A).labels == {}
