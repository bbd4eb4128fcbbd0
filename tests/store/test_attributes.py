"""Attributes of a scene are kept exactly, changed one by one, forgotten with it; on either database."""

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from datetime import datetime, timezone
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.stores import EXTRACTOR, Place, Shared, make_reference

from mapless.geodesy import Datum, enu_from_y_up
from mapless.geometry import Quaternion, rotation_from_vector
from mapless.scenes import Calibration, unit_vector
from mapless_server import errors
from mapless_server.security import DEFAULT_TENANT, SceneKey
from mapless_server.store import ContradictingDown, SceneAttributes, Store, codec, deletion

OFFICE, HALL, NOWHERE = map(SceneKey, ("office", "hall", "nowhere"))
DATUM = Datum(47.1 / 3, -8.1 / 3, 400.1 / 3, Quaternion(0.0, 0.0, 0.6, 0.8))
DOWN = unit_vector(0.01, -0.02, -1.0)
CALIBRATION = Calibration(1.1 / 3, 2.2 / 3, 3.1, 4.1, 40, "sift-2048", "geometric", "BEST", "0.1.0")
BEFORE = datetime.now(timezone.utc)


def known_of(store: Store, key: SceneKey) -> SceneAttributes:
    """As every method returns it."""
    scene = store.get_scene(key)
    assert scene in store.list_scenes(DEFAULT_TENANT, 10)
    assert store.get_attributes(key) == scene.attributes
    return scene.attributes


def test_attributes_of_a_new_scene_are_stored_exactly(place: Place) -> None:
    said = SceneAttributes(DATUM, DOWN, replace(CALIBRATION, create_time=BEFORE))
    with place.open() as store:
        assert store.create_scene(OFFICE, said).attributes == said
        assert store.get_scene(OFFICE).generation == 1
    with place.open() as store:
        assert known_of(store, OFFICE) == said


def test_each_change_is_alone_and_raises_the_generation(store: Store) -> None:
    store.create_scene(OFFICE)
    expected, generation = SceneAttributes(), 1
    changes: list[dict[str, Any]] = [
        {"datum": DATUM},
        {"down_in_world": DOWN},
        {"calibration": CALIBRATION},
        {"datum": replace(DATUM, height_m=0.0)},
        {"down_in_world": None},
        {"datum": None, "down_in_world": DOWN},
        {"calibration": None},
        {"down_in_world": None},
    ]
    for change in changes:
        updated = store.update_scene(OFFICE, **change)
        expected, generation = replace(expected, **change), generation + 1
        found = updated.attributes
        if found.calibration is not None:  # when it was stored, by the store's clock
            assert found.calibration.create_time is not None
            assert BEFORE <= found.calibration.create_time <= datetime.now(timezone.utc)
            found = replace(found, calibration=replace(found.calibration, create_time=None))
        assert found == expected
        assert known_of(store, OFFICE) == updated.attributes
        assert updated == store.get_scene(OFFICE)
        assert updated.generation == generation
    assert expected == SceneAttributes()


@pytest.mark.parametrize("count", [0, 3])
def test_a_scene_deleted_and_created_again_has_forgotten(
    store: Store, monkeypatch: pytest.MonkeyPatch, count: int
) -> None:
    """Whether it is deleted in one portion, or in several."""
    monkeypatch.setattr(deletion, "REFERENCES_AT_A_TIME", 2)
    store.create_scene(OFFICE, SceneAttributes(DATUM, DOWN))
    if count:
        store.add_references(OFFICE, [make_reference(f"r{i}") for i in range(count)])
    assert store.get_attributes(OFFICE).datum == DATUM
    store.delete_scene(OFFICE)
    with pytest.raises(errors.NotFound):
        store.get_attributes(OFFICE)
    store.create_scene(OFFICE)
    assert known_of(store, OFFICE) == SceneAttributes()


def test_a_datum_that_contradicts_down_is_refused_unchanged(store: Store) -> None:
    """The world's y is up, and the datum, which says nothing of turning, takes its z for it."""
    before = store.create_scene(OFFICE, SceneAttributes(down_in_world=(0.0, -1.0, 0.0)))
    with pytest.raises(ContradictingDown, match="90 degrees off"):
        store.update_scene(OFFICE, datum=Datum(0, 0, 0))
    assert store.get_scene(OFFICE) == before
    turned = Datum(0, 0, 0, enu_from_y_up(0))
    assert store.update_scene(OFFICE, datum=turned).attributes.datum == turned
    with pytest.raises(ContradictingDown, match="11 degrees off"):
        store.update_scene(OFFICE, down_in_world=unit_vector(0, -1, np.tan(np.radians(11))))


def test_down_is_the_given_one_or_the_datums_or_unknown() -> None:
    datum = Datum(0, 0, 0, enu_from_y_up(0))
    said = unit_vector(0.05, -1.0, 0.0)
    assert SceneAttributes().down() is None
    for attributes, expected in (
        (SceneAttributes(datum), (0, -1, 0)),
        (SceneAttributes(datum, said), said),
        (SceneAttributes(None, said), said),
    ):
        down = attributes.down()
        assert down is not None
        np.testing.assert_allclose(down, expected, atol=1e-12)


DAMAGES = {
    "other bytes": "UPDATE scene SET attributes = ? WHERE scene_id = 'office'",
    "no bytes": "UPDATE scene SET attributes = NULL WHERE scene_id = 'office' AND attributes <> ?",
    "no checksum": "UPDATE scene SET attributes_sha256 = NULL WHERE scene_id = 'office' AND attributes <> ?",
    "another scene's": "UPDATE scene SET attributes = (SELECT attributes FROM scene WHERE scene_id = 'hall'), "
    "attributes_sha256 = (SELECT attributes_sha256 FROM scene WHERE scene_id = 'hall') "
    "WHERE scene_id = 'office' AND attributes <> ?",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damage_is_reported_and_repairable_while_serving(place: Place, damage: str) -> None:
    with place.open() as store:
        store.create_scene(OFFICE, SceneAttributes(DATUM))
        store.create_scene(HALL, SceneAttributes(down_in_world=DOWN))
        store.add_references(OFFICE, [make_reference("a")])
    place.execute(DAMAGES[damage], b"{}")
    with place.open() as store:
        calls = (
            lambda: store.get_scene(OFFICE),
            lambda: store.get_attributes(OFFICE),
            lambda: store.list_scenes(DEFAULT_TENANT, 10),
            lambda: store.update_scene(OFFICE, datum=DATUM, down_in_world=None),
        )
        for call in calls:
            with pytest.raises(errors.DataLoss, match="'office' is damaged"):
                call()
        assert store.get_scene(HALL).attributes.down_in_world == DOWN
        assert len(store.load_references(OFFICE, None, EXTRACTOR).references) == 1
        store.add_references(OFFICE, [make_reference("b")])
        assert store.get_generation(OFFICE) == 3
        store.update_scene(OFFICE, datum=DATUM, down_in_world=None, calibration=None)
        assert known_of(store, OFFICE) == SceneAttributes(DATUM)


def test_the_next_call_sees_what_another_server_changed(shared: Shared) -> None:
    with shared.open() as one, shared.open() as other:
        one.create_scene(OFFICE)
        for datum in (DATUM, None, replace(DATUM, height_m=1.0)):
            one.update_scene(OFFICE, datum=datum)
            assert other.get_attributes(OFFICE).datum == datum
        one.delete_scene(OFFICE)
        with pytest.raises(errors.NotFound):
            other.get_attributes(OFFICE)


def test_changes_at_once_lose_none_of_each_other(store: Store) -> None:
    store.create_scene(OFFICE)
    values: list[dict[str, Any]] = [{"datum": DATUM}, {"down_in_world": DOWN}, {"calibration": CALIBRATION}]
    rounds = 5
    with ThreadPoolExecutor(3) as threads:
        for _ in range(rounds):
            nothing: list[dict[str, Any]] = [dict.fromkeys(value) for value in values]
            list(threads.map(lambda value: store.update_scene(OFFICE, **value), nothing))
            assert known_of(store, OFFICE) == SceneAttributes()
            list(threads.map(lambda value: store.update_scene(OFFICE, **value), values))
            found = known_of(store, OFFICE)
            assert (found.datum, found.down_in_world, found.calibration is None) == (DATUM, DOWN, False)
    assert store.get_scene(OFFICE).generation == 1 + 6 * rounds


factor = st.floats(0.01, 1000)
vector = st.tuples(*[st.floats(-3.0, 3.0)] * 3)
quaternion = vector.map(lambda it: Quaternion.from_matrix(rotation_from_vector(it)))


@settings(max_examples=30)
@given(
    st.none() | st.builds(Datum, st.floats(-90, 90), st.floats(-180, 180), st.floats(-12_000, 1e5), quaternion),
    st.none()
    | st.builds(
        Calibration,
        *[factor] * 4,
        st.integers(1, 2**31 - 1),
        *[st.text(max_size=20)] * 4,
        st.none() | st.datetimes(timezones=st.just(timezone.utc)),
        *[st.floats(0, 1e6)] * 2,
        st.booleans(),
    ),
)
def test_every_bit_comes_back(datum: Datum | None, calibration: Calibration | None) -> None:
    for down in (None, DOWN if datum is None else tuple(datum.down_in_world().tolist())):
        attributes = SceneAttributes(datum, down, calibration)
        data = codec.encode_attributes(attributes)
        sha256 = None if data is None else codec.sha256_for("x", data)
        assert codec.decode_attributes("x", data, sha256) == attributes


def test_a_unit_is_the_metre_until_marked(store: Store) -> None:
    store.create_scene(OFFICE, SceneAttributes(arbitrary_unit=True))
    assert known_of(store, OFFICE).arbitrary_unit
    assert store.update_scene(OFFICE, down_in_world=DOWN).attributes.arbitrary_unit
    store.update_scene(OFFICE, datum=None, down_in_world=None, calibration=None)
    assert known_of(store, OFFICE).arbitrary_unit, "it was not damaged, so not to be replaced"
    store.update_scene(OFFICE, arbitrary_unit=False)
    assert known_of(store, OFFICE) == SceneAttributes()
