"""Several scenes in a request: which are searched, and what its priors say in each of their worlds."""

import math
import threading
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from google.protobuf.json_format import ParseDict
from support.corner import CAMERA
from support.images import encode

from mapless.geodesy import Datum, geodetic_from_world, geopose, pose_from_geopose
from mapless.geometry import Array, Quaternion, RigidTransform, rotation_from_vector
from mapless.v1 import localization_service_pb2 as pb
from mapless.wire import FieldError, transform_to_message
from mapless_server.engine.options import EngineOptions
from mapless_server.engine.query import Photo, Query, SceneQuestion
from mapless_server.method.options import LocalizeOptions
from mapless_server.rpc import Call
from mapless_server.scenes import ANYWHERE
from mapless_server.security import DEFAULT_TENANT, SceneKey
from mapless_server.services.localization import LocalizationService
from mapless_server.services.messages import scenes as module
from mapless_server.services.messages.groups import queries_among
from mapless_server.services.messages.priors import priors_from_message
from mapless_server.services.messages.scenes import (
    FoundScenes,
    allowed_from_message,
    names_several,
    questions_from_message,
    scene_keys_from_message,
)
from mapless_server.services.photographs import in_scene
from mapless_server.services.watching import Watchers
from mapless_server.store import GroupedScene, SceneAttributes, Store

TURN = Quaternion(0.0, 0.0, math.sin(0.35), math.cos(0.35))
TILTED = Quaternion(0.5, -0.5, -0.5, 0.5)
HALL = SceneAttributes(Datum(47.3769, 8.5417, 450.0, TURN))
YARD = SceneAttributes(Datum(47.3775, 8.5431, 447.0, TILTED))
LOST = SceneAttributes(down_in_world=(0.0, 1.0, 0.0))
DOLL = SceneAttributes(arbitrary_unit=True)

POSE = RigidTransform(rotation_from_vector([0.4, -0.2, 0.9]), np.array([3.0, -2.0, 1.5]))
COVARIANCE = np.diag([1.0, 4.0, 9.0, 0.01, 0.02, 0.03])
NEAR = {"position_m": {"x": 3, "y": -2, "z": 1.5}, "radius_m": 7, "covariance_m2": COVARIANCE[:3, :3].ravel().tolist()}
LOOKING = {"direction": {"x": 0.6, "y": 0.8}, "max_angle_deg": 30, "sigma_deg": 10}
DOWN = {"down_in_camera": {"y": 1}, "sigma_deg": 1}
GEO = {"latitude_deg": 47.3771, "longitude_deg": 8.542, "horizontal_sigma_m": 4}
WIDE = {"position_m": {}, "covariance_m2": np.diag([1e-8, 1e12, 1e4]).ravel().tolist()}
"""Less certain along x in the worlds of other scenes than in the one that it is given in."""

IMAGE = encode(".png", np.zeros((CAMERA.height_px, CAMERA.width_px, 3), np.uint8))
PART = Query(SceneKey("s0"), (), Photo(IMAGE, CAMERA, "image"), ANYWHERE, 2, LocalizeOptions(), is_part=True)


def found(*attributes: SceneAttributes) -> FoundScenes:
    """Scenes s0, s1, ... with these attributes."""
    return FoundScenes(
        [GroupedScene(1, 0, lambda it=it: it, SceneKey(f"s{i}")) for i, it in enumerate(attributes)]  # type: ignore[misc]
    )


def request(**fields: Any) -> pb.LocalizeRequest:
    message = pb.LocalizeRequest()
    ParseDict(fields, message)
    return message


def questions(scenes: FoundScenes, **fields: Any) -> Sequence[SceneQuestion]:
    return questions_from_message(request(**fields), scenes, DEFAULT_TENANT, unknown).questions


def unknown(scenes: Sequence[GroupedScene]) -> Array:
    """Extents of scenes that were not searched yet."""
    return np.full(len(scenes), np.inf)


def counted_conversions(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Indices of scenes for which priors are converted from now on."""
    converted: list[int] = []
    question = module._ScenePriors.question

    def counted(it: Any, index: int) -> SceneQuestion:
        converted.append(index)
        return question(it, index)

    monkeypatch.setattr(module._ScenePriors, "question", counted)
    return converted


WAYS = {"scene": "scenes/a", "scenes": ["scenes/a"], "scene_group": {}}


@pytest.mark.parametrize(
    ("given", "field"), [(("scene", "scenes"), "scenes"), (("scenes", "scene_group"), "scene_group")]
)
def test_exactly_one_way_says_where_to_look(given: tuple[str, str], field: str) -> None:
    with pytest.raises(FieldError, match="exactly one of scene, scenes, scene_group") as error:
        names_several(request(**{it: WAYS[it] for it in given}))
    assert error.value.field == field
    with pytest.raises(FieldError, match="scenes or scene_group") as error:
        names_several(request())
    assert error.value.field == "scene"
    assert [names_several(request(**{name: value})) for name, value in WAYS.items()] == [False, True, True]


@pytest.mark.parametrize(
    ("listed", "field"),
    [(["scenes/a", "scenes/a"], "scenes[1]"), (["a"], "scenes[0]"), ([f"scenes/s{i}" for i in range(65)], "scenes")],
)
def test_a_wrong_list_of_scenes_is_refused(listed: list[str], field: str) -> None:
    with pytest.raises(FieldError) as error:
        scene_keys_from_message(request(scenes=listed), DEFAULT_TENANT)
    assert error.value.field == field


@pytest.mark.parametrize(
    ("fields", "field"),
    [
        ({"position_prior": NEAR}, "prior_scene"),
        ({"gravity_prior": DOWN | {"down_in_world": {"z": -1}}}, "prior_scene"),
        ({"position_prior": NEAR, "prior_scene": "scenes/s9"}, "prior_scene"),
        ({"prior_scene": "s0"}, "prior_scene"),
        ({"references": ["scenes/s0/references/r"]}, "references"),
        ({"position_prior": NEAR, "prior_scene": "scenes/s0", "geo_position_prior": GEO}, "geo_position_prior"),
        ({"geo_position_prior": GEO | {"latitude_deg": 91}}, "geo_position_prior.latitude_deg"),
        ({"heading_prior": LOOKING | {"sigma_deg": 91}, "prior_scene": "scenes/s0"}, "heading_prior.sigma_deg"),
    ],
)
def test_what_several_scenes_cannot_have_is_refused(fields: dict[str, Any], field: str) -> None:
    with pytest.raises(FieldError) as error:
        questions(found(HALL, YARD), **fields)
    assert error.value.field == field


def test_a_prior_that_no_scene_can_use_is_refused() -> None:
    for scenes, fields, field in (
        (found(LOST, DOLL), {"geo_position_prior": GEO}, "geo_position_prior"),
        (found(DOLL, DOLL), {"gravity_prior": DOWN}, "gravity_prior.down_in_world"),
    ):
        with pytest.raises(FieldError) as error:
            questions(scenes, **fields)
        assert error.value.field == field


def test_without_priors_the_questions_are_made_once() -> None:
    scenes = found(HALL, LOST)
    assert questions(scenes) is questions(scenes, prior_scene="scenes/s1")
    assert all(it.narrowing.is_empty and not it.priors and it.attributes is None for it in questions(scenes))


def test_a_pose_in_one_world_is_the_same_on_the_earth_in_another() -> None:
    assert HALL.datum is not None
    assert YARD.datum is not None
    sent = request(prior_scene="scenes/s0")
    sent.pose_prior.world_from_camera.CopyFrom(transform_to_message(POSE))
    sent.pose_prior.covariance.row_major.extend(COVARIANCE.ravel().tolist())
    asked = questions_from_message(sent, found(HALL, YARD), DEFAULT_TENANT, unknown)
    (here, there), prior_scene = asked.questions, asked.prior_scene
    assert prior_scene == "s0"
    assert here.priors.pose is not None
    assert there.priors.pose is not None
    np.testing.assert_allclose(here.priors.pose.world_from_camera.matrix(), POSE.matrix(), atol=1e-14)
    expected = pose_from_geopose(geopose(POSE, HALL.datum), YARD.datum)
    np.testing.assert_allclose(there.priors.pose.world_from_camera.matrix(), expected.matrix(), atol=1e-6)
    assert (here.attributes, there.attributes) == (None, YARD)
    # Moved by one standard deviation along an axis of the first world, both priors are as far off.
    off_m = np.array([0.0, 2.0, 0.0])
    moved = pose_from_geopose(geopose(POSE.shifted(off_m), HALL.datum), YARD.datum)
    assert here.priors.pose.term(POSE.shifted(off_m)).cost == pytest.approx(1)
    assert there.priors.pose.term(moved).cost == pytest.approx(1, rel=1e-4)


def test_limits_in_one_world_hold_at_the_same_places_of_another() -> None:
    assert HALL.datum is not None
    assert YARD.datum is not None
    here, there = questions(
        found(HALL, YARD), prior_scene="scenes/s0", position_prior=NEAR, heading_prior=LOOKING, gravity_prior=DOWN
    )
    generator = np.random.default_rng(5)
    for _ in range(200):
        turn = rotation_from_vector(generator.normal(size=3))
        pose = RigidTransform(turn, generator.normal([3.0, -2.0, 1.5], 5.0))
        same = pose_from_geopose(geopose(pose, HALL.datum), YARD.datum)
        assert bool(here.narrowing.contradiction(pose)) == bool(there.narrowing.contradiction(same))
        assert there.priors.cost(same) == pytest.approx(here.priors.cost(pose), rel=1e-3, abs=1e-6)


def test_the_widest_and_the_surest_prior_can_be_turned() -> None:
    _, there = questions(found(HALL, YARD), prior_scene="scenes/s0", position_prior=WIDE)
    assert there.priors.position is not None
    sigmas_m = np.sqrt(np.linalg.eigvalsh(there.priors.position.covariance))
    np.testing.assert_allclose(sigmas_m, [10.0, 100.0, 1e6], rtol=0.01)


def test_priors_of_one_world_count_only_where_both_have_datums() -> None:
    hall, lost = questions(found(HALL, LOST), prior_scene="scenes/s0", position_prior=NEAR)
    assert (hall.narrowing.position is None, lost.narrowing.is_empty, bool(lost.priors)) == (False, True, False)
    hall, lost = questions(found(HALL, LOST), prior_scene="scenes/s1", position_prior=NEAR)
    assert (hall.narrowing.is_empty, lost.narrowing.position is None) == (True, False)
    assert (hall.attributes, lost.attributes) == (None, None)


def test_what_holds_on_the_earth_is_in_each_scene_as_if_it_were_named() -> None:
    fields = {"geo_position_prior": GEO, "gravity_prior": DOWN}
    *placed, doll = questions(found(HALL, YARD, LOST, DOLL), **fields)
    for question, attributes in zip(placed, (HALL, YARD, LOST), strict=True):
        sent = request(**fields)
        if attributes.datum is None:
            sent.ClearField("geo_position_prior")
        _, alone = priors_from_message(sent, attributes)
        for prior, expected in zip(question.priors, alone, strict=True):
            for name, value in vars(expected).items():
                np.testing.assert_array_equal(getattr(prior, name), value)
        assert question.attributes is attributes
    assert (bool(doll.priors), doll.narrowing.is_empty, doll.attributes) == (False, True, None)


def test_scenes_beyond_a_geo_position_cost_no_conversion(monkeypatch: pytest.MonkeyPatch) -> None:
    far = [SceneAttributes(Datum(-60.0 + i / 20, i / 12, 0.0)) for i in range(1_997)]
    scenes = found(HALL, *far, YARD, LOST)
    converted = counted_conversions(monkeypatch)
    sent = request(geo_position_prior=GEO)
    asked = questions_from_message(sent, scenes, DEFAULT_TENANT, lambda them: np.full(len(them), 100.0))
    assert [it.scene_key for it in asked.questions] == ["s0", "s1998", "s1999"]
    assert len(converted) == 3
    assert asked.beyond is not None
    assert len(asked.beyond()) == 1_997
    everywhere = questions_from_message(sent, scenes, DEFAULT_TENANT, unknown)
    assert (len(everywhere.questions), everywhere.beyond) == (2_000, None)


SURE = GEO | {"horizontal_sigma_m": 1e-4, "height_m": 450.0, "vertical_sigma_m": 1e6}
"""In a scene's world, horizontally less certain: its directions differ by MIN_SIGMA_RATIO at most."""


@pytest.mark.parametrize(
    "fields",
    [
        {"geo_position_prior": GEO},
        {"geo_position_prior": SURE},
        {"position_prior": WIDE, "prior_scene": "scenes/s0"},
        {"position_prior": NEAR, "prior_scene": "scenes/s0"},
    ],
)
def test_a_scene_with_a_reference_that_is_likely_is_kept(fields: dict[str, Any]) -> None:
    assert HALL.datum is not None
    generator = np.random.default_rng(3)
    places = [geodetic_from_world(generator.normal([30.0, 20.0, 0.0], 60.0), HALL.datum) for _ in range(60)]
    scenes = found(HALL, *(SceneAttributes(Datum(it.latitude_deg, it.longitude_deg, it.height_m)) for it in places))
    references = [generator.normal(0.0, 8.0, (5, 3)) for _ in scenes.scenes]
    extents_m = np.array([np.linalg.norm(it, axis=1).max() for it in references])
    asked = questions_from_message(request(**fields), scenes, DEFAULT_TENANT, lambda _: extents_m)
    kept = {it.scene_key for it in asked.questions}
    for question, centres in zip(questions(scenes, **fields), references, strict=True):
        narrowing = question.narrowing
        limits = [it for it in (narrowing.position, *narrowing.likely_positions) if it is not None]
        if np.all([it.keeps(centres, narrowing.margin_m) for it in limits], axis=0).any():
            assert question.scene_key in kept
    assert len(kept) < 61


def test_limits_count_in_a_scene_that_they_left_out() -> None:
    """A photograph of a rig whose scene is found by another one is answered as if that scene were named."""
    sent = request(position_prior=NEAR, prior_scene="scenes/s0")
    allowed = allowed_from_message(sent, found(HALL, YARD), DEFAULT_TENANT, lambda _: np.ones(2))
    assert [it.scene_key for it in allowed] == ["s0"]
    there = in_scene(replace(PART, scenes=allowed), SceneKey("s1"))
    _, named = questions(found(HALL, YARD), position_prior=NEAR, prior_scene="scenes/s0")
    assert there.narrowing.position is not None
    assert named.narrowing.position is not None
    np.testing.assert_array_equal(there.narrowing.position.position, named.narrowing.position.position)
    assert (there.scene_key, there.attributes, bool(there.priors)) == ("s1", YARD, True)


def test_photographs_that_are_not_looked_for_cost_no_conversion(monkeypatch: pytest.MonkeyPatch) -> None:
    """Among 100 scenes, the next ones are looked for only where the first is not found: one question names a scene."""
    converted = counted_conversions(monkeypatch)
    rig = pb.LocalizeRigRequest()
    for _ in range(3):
        rig.images.add(image=IMAGE, geo_position_prior=ParseDict(GEO, pb.GeoPositionPrior()))
    scenes = found(*[HALL, YARD] * 50)
    ask = partial(allowed_from_message, found=scenes, tenant=DEFAULT_TENANT, extents=unknown)
    queries = queries_among(rig, "images", (1, 8), EngineOptions(), ask)
    assert ([len(it.scenes) for it in queries], len(converted)) == ([100] * 3, 3)
    queries[1].in_prior_scene()  # as the event loop does when it begins
    assert len(converted) == 3


async def test_the_event_loop_does_not_convert_priors_of_rigs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    threads: list[threading.Thread] = []
    question = module._ScenePriors.question

    def noted(it: Any, index: int) -> SceneQuestion:
        threads.append(threading.current_thread())
        return question(it, index)

    monkeypatch.setattr(module._ScenePriors, "question", noted)
    rig = pb.LocalizeRigRequest()
    rig.scene_group.SetInParent()
    rig.images.add(image=IMAGE, geo_position_prior=ParseDict(GEO, pb.GeoPositionPrior()))
    engine: Any = SimpleNamespace(options=EngineOptions(), references=SimpleNamespace(extents_m=unknown))
    metrics: Any = None
    with Store.open(tmp_path) as store:
        store.create_scene(SceneKey("s0"), HALL)
        service = LocalizationService(lambda: engine, metrics, store, Watchers(False))
        await service._queries(rig, "images", (1, 8), Call("id", 0.0, math.inf))
    assert threads
    assert threading.current_thread() not in threads


@pytest.mark.parametrize("sigma_deg", [0, 91])
def test_a_wrong_gravity_is_refused_before_it_is_converted(sigma_deg: float) -> None:
    with pytest.raises(FieldError) as error:
        allowed_from_message(
            request(gravity_prior=DOWN | {"sigma_deg": sigma_deg}), found(DOLL, HALL), DEFAULT_TENANT, unknown
        )
    assert error.value.field == "gravity_prior.sigma_deg"


def test_a_geo_position_far_from_all_scenes_leaves_all() -> None:
    asked = questions_from_message(
        request(geo_position_prior=GEO | {"latitude_deg": 0}), found(HALL, YARD), DEFAULT_TENANT, lambda _: np.ones(2)
    )
    assert (len(asked.questions), asked.beyond) == (2, None)
