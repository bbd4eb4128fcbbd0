"""Reading a large scene in portions: the same as all at once, and its history, on either database."""

import numpy as np
import pytest
from support.stores import Place, make_reference

from mapless_server.errors import NotFound
from mapless_server.security import SceneKey
from mapless_server.store import Store
from mapless_server.store.adoption import retire
from mapless_server.store.portions import IndexReader
from mapless_server.store.records import RetirementReason

SCENE, OTHER, DESCRIPTOR = SceneKey("a"), SceneKey("b"), "vlad"


def fill(store: Store, scene_key: SceneKey, count: int) -> None:
    store.create_scene(scene_key)
    for i in range(count):
        store.add_references(scene_key, [make_reference(f"r{i}", seed=i, dimension=8)])


def test_portions_are_the_scene_in_the_order_of_ids(store: Store, place: Place) -> None:
    fill(store, SCENE, 8)
    fill(store, OTHER, 3)
    retire(store, SCENE, [store.get_reference(SCENE, "r7").key], RetirementReason.CONTRADICTED)
    r3, r5 = (store.get_reference(SCENE, it).key for it in ("r3", "r5"))
    place.execute("UPDATE global_descriptor SET sha256 = 'wrong' WHERE reference_key = ?", r3)
    place.execute("UPDATE reference SET geometry_sha256 = 'wrong' WHERE key = ?", r5)
    reader, found, sizes = IndexReader(store.database), [], []
    portion = reader.read_portion(SCENE, "", 3, DESCRIPTOR)
    while portion.last_id:
        found.append(portion)
        sizes.append(len(portion.references))
        portion = reader.read_portion(SCENE, portion.last_id, 3, DESCRIPTOR)
    whole = store.list_changes(SCENE, None, DESCRIPTOR)
    references = [it for some in found for it in some.references]
    assert sizes == [3, 1, 1]
    assert [it for some in found for it in some.damaged] == [*whole.damaged] == ["r3", "r5"]
    assert [(it.reference_id, it.key) for it in references] == [(it.reference_id, it.key) for it in whole.added]
    for it, expected in zip(references, whole.added, strict=True):
        np.testing.assert_array_equal(it.world_from_camera.matrix(), expected.world_from_camera.matrix())
        assert it.descriptor is not None
        assert expected.descriptor is not None
        np.testing.assert_array_equal(it.descriptor, expected.descriptor)


def test_the_last_change_until_a_generation_stays_the_same(store: Store) -> None:
    fill(store, SCENE, 2)
    reader = IndexReader(store.database)
    first = reader.read_state(SCENE)
    assert [reader.count(it) for it in (SCENE, OTHER)] == [2, 0]
    assert (first.reference_count, first.last_change) == (2, store.get_reference(SCENE, "r1").key)
    gone = store.delete_reference(SCENE, "r0")
    second = reader.read_state(SCENE)
    assert (second.reference_count, second.last_change) == (1, gone)
    retired = retire(store, SCENE, [store.get_reference(SCENE, "r1").key], RetirementReason.CONTRADICTED)
    third = reader.read_state(SCENE)
    assert (third.reference_count, [third.last_change]) == (0, retired)
    fill(store, OTHER, 1)
    assert reader.read_state(SCENE, first.generation).last_change == first.last_change
    assert reader.read_state(SCENE, second.generation).last_change == second.last_change


def test_a_scene_without_changes_has_none_a_missing_one_no_state(store: Store) -> None:
    store.create_scene(SCENE)
    assert IndexReader(store.database).read_state(SCENE).last_change == ""
    with pytest.raises(NotFound):
        IndexReader(store.database).read_state(OTHER)
