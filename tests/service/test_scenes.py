"""A scene's attributes through a real server: set, changed, cleared, and refused by field."""

import asyncio
from dataclasses import replace
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from support.servers import CAMERA, PHOTO, Stubs, make_scene, pose, serving

from mapless import (
    UNCHANGED,
    Calibration,
    Client,
    Datum,
    InvalidArgument,
    LocalizationResult,
    NewReference,
    NotFound,
    Quaternion,
    Scene,
)
from mapless.geodesy import enu_from_y_up
from mapless.requests import create_request
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.security import key_of
from mapless_server.store import SceneAttributes, SelfCalibration, Store

DATUM = Datum(47.5, 8.25, 400.0, enu_from_y_up(0))
CALIBRATION = Calibration(
    *(1.5, 1.25, 2.0, 1.75, 40, "sift-2048", "geometric", "BEST", "0.1.0"),
    reference_noise_m=0.01,
    reference_noise_deg=0.1,
    grows_with_gap=True,
)


def uncounted(scene: Scene) -> Scene:
    """The scene as calls that do not count its references answer it."""
    return replace(scene, adopted_reference_count=None, retired_reference_count=None)


def test_a_scene_is_created_with_what_is_known_of_it(client: Client) -> None:
    created = client.create_scene("placed", datum=DATUM, down_in_world=(0, -9.81, 0))
    assert (created.datum, created.down_in_world, created.calibration) == (DATUM, (0, -1, 0), None)
    assert created.generation == 1
    assert uncounted(client.get_scene("placed")) == created
    assert created in list(client.list_scenes())
    client.delete_scene("placed")
    assert client.create_scene("placed").datum is None
    client.delete_scene("placed")


def test_what_is_not_given_stays_and_none_forgets(client: Client, scene: str) -> None:
    generation = client.get_scene(scene).generation
    assert client.update_scene(scene, datum=DATUM).datum == DATUM
    assert client.update_scene(f"scenes/{scene}", down_in_world=(0.0, -2.0, 0.0)).datum == DATUM
    updated = client.update_scene(scene, calibration=CALIBRATION)
    assert (updated.datum, updated.down_in_world) == (DATUM, (0, -1, 0))
    assert updated.calibration is not None
    assert replace(updated.calibration, create_time=None) == CALIBRATION
    assert updated.calibration.create_time is not None
    assert abs(updated.calibration.create_time - datetime.now(timezone.utc)) < timedelta(minutes=1)
    assert updated.generation == generation + 3
    updated = client.update_scene(scene, datum=None, calibration=UNCHANGED)
    assert (updated.datum, updated.down_in_world, updated.calibration is None) == (None, (0, -1, 0), False)
    updated = client.update_scene(scene, down_in_world=None, calibration=None)
    assert (updated.datum, updated.down_in_world, updated.calibration) == (None, None, None)
    assert updated == uncounted(client.get_scene(scene))
    assert updated.reference_count == 3


def test_scenes_are_grouped_by_labels(client: Client) -> None:
    assert client.create_scene("lobby", labels={"site": "north", "floor": "1"}).labels["floor"] == "1"
    client.create_scene("attic", labels={"site": "north"})
    found = [it.scene_id for it in client.list_scenes(labels={"site": "north"}, page_size=1)]
    assert found == ["attic", "lobby"]
    assert client.update_scene("lobby", labels={"site": "south"}).labels == {"site": "south"}
    assert client.update_scene("attic", labels=None).labels == {}
    assert list(client.list_scenes(labels={"site": "north"})) == []


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        ({"a b": "1"}, "A-Z a-z 0-9"),
        ({"": "1"}, "A-Z a-z 0-9"),
        ({"n" * 65: "1"}, "1 to 64"),
        ({"site": ""}, "1 to 128"),
        ({"site": "v" * 129}, "1 to 128"),
        ({"site": "a\nb"}, "control character"),
        ({f"n{i}": "1" for i in range(33)}, "at most 32 labels, has 33"),
    ],
)
def test_wrong_labels_are_refused_by_field(client: Client, scene: str, labels: dict[str, str], message: str) -> None:
    for call, field in (
        (lambda: client.create_scene("never", labels=labels), "labels"),
        (lambda: client.update_scene(scene, labels=labels), "scene.labels"),
        (lambda: list(client.list_scenes(labels=labels)), "labels"),
    ):
        with pytest.raises(InvalidArgument, match=message) as caught:
            call()
        assert caught.value.field == field


@pytest.mark.parametrize(
    ("labels", "message"),
    [
        (["site=a"], "labels must be a Mapping"),
        ({"floor": 1}, r"labels\['floor'\] must be a str"),
        ({1: "a"}, "a name"),
    ],
)
def test_labels_of_another_type_are_named(client: Client, labels: Any, message: str) -> None:
    with pytest.raises(TypeError, match=message):
        client.create_scene("never", labels=labels)


def test_an_update_needs_a_mask_and_an_existing_scene(client: Client, scene: str) -> None:
    with pytest.raises(InvalidArgument) as caught:
        client.update_scene(scene)
    assert caught.value.field == "update_mask"
    with pytest.raises(NotFound):
        client.update_scene("nowhere", datum=None)


def test_a_datum_of_another_world_is_refused(client: Client, scene: str) -> None:
    """One that leaves out that the world's y is up, not its z; whichever of the two comes later is the guilty one."""
    upright = replace(DATUM, enu_from_world=Quaternion(0, 0, 0, 1))
    client.update_scene(scene, down_in_world=(0, -1, 0))
    with pytest.raises(InvalidArgument, match="90 degrees off") as caught:
        client.update_scene(scene, datum=upright)
    assert caught.value.field == "scene.datum"
    client.update_scene(scene, datum=upright, down_in_world=None)
    with pytest.raises(InvalidArgument, match="enu_from_world") as caught:
        client.update_scene(scene, down_in_world=(0, -1, 0))
    assert caught.value.field == "scene.down_in_world"
    with pytest.raises(InvalidArgument) as caught:
        client.create_scene("never", datum=upright, down_in_world=(0, -1, 0))
    assert caught.value.field == "down_in_world"


def test_answers_say_that_the_unit_is_arbitrary(client: Client) -> None:
    assert client.create_scene("units", arbitrary_unit=True).arbitrary_unit
    client.add_references("units", [NewReference(f"r{i}", PHOTO, CAMERA, pose(i)) for i in range(3)])
    assert client.get_scene("units").arbitrary_unit
    answer = client.localize(PHOTO, CAMERA, "units")
    assert isinstance(answer, LocalizationResult)
    assert answer.arbitrary_unit
    assert client.check_coverage("units", pose(0.5), CAMERA).arbitrary_unit
    with pytest.raises(InvalidArgument, match="unit of length") as caught:
        client.update_scene("units", datum=DATUM)
    assert caught.value.field == "scene.datum"
    with pytest.raises(InvalidArgument, match="unit of length") as caught:
        client.create_scene("never", datum=DATUM, arbitrary_unit=True)
    assert caught.value.field == "datum"
    assert not client.update_scene("units", arbitrary_unit=None).arbitrary_unit
    answer = client.localize(PHOTO, CAMERA, "units")
    assert isinstance(answer, LocalizationResult)
    assert not answer.arbitrary_unit
    client.update_scene("units", datum=replace(DATUM, enu_from_world=Quaternion(0, 0, 0, 1)))
    with pytest.raises(InvalidArgument, match="unit of length") as caught:
        client.update_scene("units", arbitrary_unit=True)
    assert caught.value.field == "scene.arbitrary_unit"
    client.delete_scene("units")


def test_an_update_that_contradicts_references_is_reported(client: Client, scene: str) -> None:
    """The references' cameras are upright in a world whose y is down."""
    updated = client.update_scene(scene, down_in_world=(0.0, -1.0, 0.0))
    assert updated.down_in_world == (0.0, -1.0, 0.0)
    assert len(updated.warnings) == 1
    assert "degrees off the down of 3 reference cameras" in updated.warnings[0]
    assert client.update_scene(scene, down_in_world=(0.0, 1.0, 0.0)).warnings == ()
    assert client.get_scene(scene).warnings == ()


def test_added_references_that_contradict_their_scene_are_said(client: Client, stubs: Stubs) -> None:
    """Cameras are upright in a world whose y is down: said at once, of one reference and of a batch, and stored."""
    client.create_scene("added", down_in_world=(0.0, -1.0, 0.0))
    first = client.add_reference("added", NewReference("a", PHOTO, CAMERA, pose(0.0)))
    assert first.warnings == ()  # one shows no typical direction
    added = [NewReference(f"b{i}", PHOTO, CAMERA, pose(i)) for i in (1.0, 2.0)]
    for stored in client.add_references("added", added):
        assert "degrees off the down of 3 reference cameras" in stored.warnings[0]
    request = create_request("scenes/added", NewReference("c", PHOTO, CAMERA, pose(3.0)))
    text, _ = stubs.references.CreateReference(request, timeout=20).warnings
    assert "degrees off the down of 4 reference cameras" in text
    assert client.get_scene("added").reference_count == 4
    client.update_scene("added", down_in_world=None)
    (text,) = client.add_reference("added", NewReference("d", PHOTO, CAMERA, pose(4.0))).warnings
    assert text.startswith("d is the same photograph as a, but its pose is 4 m and 22.9 degrees away")
    assert client.get_scene("added").reference_count == 5
    client.delete_scene("added")


def test_a_lens_that_references_contradict_is_said(client: Client, scene: str, monkeypatch: pytest.MonkeyPatch) -> None:
    kinds = ("a", 2, "a lens"), ("b", 2, "a lens"), ("outdated", 1, "another lens")
    known = SceneAttributes(self_calibrations=tuple(SelfCalibration(a, at, 3, lens=lens) for a, at, lens in kinds))
    monkeypatch.setattr(Store, "get_attributes", lambda *_: known)
    assert client.get_scene(scene).warnings == ("a lens",)


def test_what_is_deleted_leaves_the_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The engine is notified: of one reference, then of the others with their scene."""
    heard: list[object] = []
    monkeypatch.setattr(QueueEngine, "forget_references", lambda _, keys: heard.append(set(keys)))
    monkeypatch.setattr(QueueEngine, "forget_scene", lambda _, scene_key: heard.append(scene_key))
    store = Store.open(tmp_path)
    with serving(tmp_path, store=store) as server, Client(server.address) as client:
        make_scene(client, "s", 3)
        client.localize(PHOTO, CAMERA, "s")
        scene_key = key_of("default", "s")
        keys = store.find_keys(scene_key, ["r0", "r1", "r2"])
        client.delete_reference("s", "r1")
        client.delete_scene("s")
        with pytest.raises(NotFound):
            client.delete_scene("s")
    assert heard == [{keys["r1"]}, {keys["r0"], keys["r2"]}, scene_key, scene_key]


def test_coverage_is_of_one_unit_though_it_changes_meanwhile(tmp_path: Path) -> None:
    """The scene's unit is changed while its coverage is computed: it is computed again, and stated in the new unit."""
    with serving(tmp_path) as server, Client(server.address) as client:
        client.create_scene("s")
        usual, asked = server.engine.check_coverage, 0

        async def changing(*arguments: Any) -> Any:
            nonlocal asked
            asked += 1
            found = await usual(*arguments)
            if asked == 1:
                await asyncio.to_thread(client.update_scene, "s", arbitrary_unit=True)
            return found

        server.engine.check_coverage = changing  # type: ignore[method-assign, assignment]
        assert client.check_coverage("s", pose(0.0), CAMERA).arbitrary_unit
    assert asked == 2
