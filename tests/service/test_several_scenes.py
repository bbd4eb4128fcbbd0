"""Several scenes in one call through a real server: what is found, refused, watched, logged and captured."""

import logging
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import grpc
import numpy as np
import pytest
from support.corner import CAMERA, PAPERS, photograph, pose, wallpaper
from support.images import encode
from support.servers import RunningServer, serving_really
from support.waiting import wait_until

from mapless import (
    Client,
    Datum,
    GeoPositionPrior,
    GroupRejected,
    InvalidArgument,
    LocalizationResult,
    MaplessError,
    NewReference,
    NotFound,
    PosePrior,
    PositionPrior,
    Priors,
    Rejected,
    RigImage,
    RigLocalization,
    SequenceFrame,
    SequenceLocalization,
)
from mapless.geodesy import world_from_other_world
from mapless.v1 import localization_service_pb2 as pb
from mapless.v1.localization_service_pb2_grpc import LocalizationServiceStub
from mapless_server.services.capture.calls import decode_call
from mapless_server.services.capture.folder import calls_of
from mapless_server.settings import Settings
from mapless_tools.replay.report import Selection, replay

HALL, YARD = Datum(47.0, 8.0, 400.0), Datum(47.001, 8.0, 400.0)
OTHERS = [tuple(wallpaper(seed) for seed in range(first, first + 3)) for first in (10, 20)]
ELSEWHERE = tuple(wallpaper(seed) for seed in range(30, 33))
POSES = [pose(angle, height) for angle in (-12, 0, 12) for height in (-1.8, -1.2)]
TRUE = pose(2.0, -1.5)
PHOTO = photograph(TRUE)
SITE_A: dict[str, str] = {"site": "a"}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("several")


@pytest.fixture(scope="module")
def server(folder: Path) -> Iterator[RunningServer]:
    options: dict[str, Any] = {"features": "sift", "backend": "geometric", "background_matching": False}
    with serving_really(folder / "data", capture_dir=folder / "captured", allow_watching=True, **options) as server:
        with Client(server.address) as client:
            fill(client, "hall", PAPERS, labels=SITE_A, datum=HALL)
            fill(client, "yard", OTHERS[0], labels=SITE_A, datum=YARD)
            fill(client, "doll", OTHERS[1], labels=SITE_A, arbitrary_unit=True)
            fill(client, "twin", PAPERS, labels={"site": "b"})
        yield server


@pytest.fixture(scope="module")
def client(server: RunningServer) -> Iterator[Client]:
    with Client(server.address) as client:
        yield client


def fill(client: Client, scene_id: str, papers: Any, **attributes: Any) -> None:
    client.create_scene(scene_id, **attributes)
    references = [NewReference(f"r{i}", photograph(at, papers=papers), CAMERA, at) for i, at in enumerate(POSES)]
    client.add_references(scene_id, references)


def found(client: Client, photo: bytes = PHOTO, **where: Any) -> LocalizationResult:
    answer = client.localize(photo, CAMERA, **where)
    assert isinstance(answer, LocalizationResult), str(answer)
    return answer


@pytest.mark.parametrize("where", [{"scenes": ["yard", "hall"]}, {"group": SITE_A}, {"scenes": ["hall"]}])
def test_the_answer_is_the_one_with_its_scene_named(client: Client, where: dict[str, Any]) -> None:
    named, answer = found(client, scene="hall"), found(client, **where)
    assert (named.scene, answer.scene) == ("scenes/hall", "scenes/hall")
    np.testing.assert_array_equal(answer.world_from_camera.matrix(), named.world_from_camera.matrix())
    assert (answer.accuracy, answer.trust, answer.geo_pose) == (named.accuracy, named.trust, named.geo_pose)
    assert answer.diagnostics.references == named.diagnostics.references
    several, count = answer.diagnostics, len(where.get("scenes", "abc"))
    assert several.searched_scene_count == count
    assert [it.scene for it in several.scenes if it.attempted] == (["scenes/hall"] if count > 1 else [])
    assert named.diagnostics.searched_scene_count == 1


def test_a_group_on_the_earth_has_the_scenes_with_a_datum(client: Client) -> None:
    assert found(client, group={}, with_datum=True).diagnostics.searched_scene_count == 2
    with pytest.raises(NotFound, match="no scene with 'site=b' and a datum"):
        client.localize(PHOTO, CAMERA, group={"site": "b"}, with_datum=True)


def test_the_unit_is_that_of_the_scene_that_was_found(client: Client) -> None:
    answer = found(client, photograph(TRUE, papers=OTHERS[1]), group=SITE_A)
    assert (answer.scene, answer.arbitrary_unit) == ("scenes/doll", True)
    assert not found(client, group=SITE_A).arbitrary_unit


def test_a_position_narrows_the_scenes_to_those_in_its_reach(client: Client) -> None:
    found(client, group=SITE_A)  # by then it is known how far their references reach
    near_hall = Priors(geo_position=GeoPositionPrior(47.0, 8.0, 5.0))
    assert found(client, group=SITE_A, priors=near_hall).diagnostics.searched_scene_count == 2  # one has no datum
    at_yard = PositionPrior(np.zeros(3), 20.0)
    answer = client.localize(PHOTO, CAMERA, group=SITE_A, prior_scene="yard", priors=Priors(position=at_yard))
    assert isinstance(answer, Rejected)
    assert answer.diagnostics.searched_scene_count == 2


def test_a_wrong_position_costs_no_answer(client: Client) -> None:
    """A receiver's error of a hundred metres, in each world's east: the hall is searched after what is near."""
    found(client, group=SITE_A)
    at_yard = Priors(geo_position=GeoPositionPrior(47.001, 8.0, 5.0))
    answer = found(client, group=SITE_A, priors=at_yard)
    assert (answer.scene, [it.conflict for it in answer.prior_checks]) == ("scenes/hall", [True])
    assert answer.diagnostics.searched_scene_count == 3
    assert not {"decode", "features"} & set(answer.diagnostics.stage_s)  # known from the search before
    limited = PositionPrior(np.zeros(3), 20.0)
    refused = client.localize(PHOTO, CAMERA, group=SITE_A, prior_scene="yard", priors=Priors(position=limited))
    assert isinstance(refused, Rejected)


@pytest.mark.parametrize("prior_scene", ["hall", "yard"])
def test_a_pose_prior_in_any_world_helps_where_it_belongs(client: Client, prior_scene: str) -> None:
    there = TRUE if prior_scene == "hall" else world_from_other_world(YARD, HALL).compose(TRUE)
    prior = Priors(pose=PosePrior.from_sigmas(there, 0.05, 1.0))
    answer = found(client, group=SITE_A, prior_scene=prior_scene, priors=prior)
    assert answer.scene == "scenes/hall"
    assert [it.conflict for it in answer.prior_checks] == [False]
    assert answer.diagnostics.is_tracked == (prior_scene == "hall")


def test_two_scenes_that_fit_are_both_named(client: Client) -> None:
    answer = client.localize(PHOTO, CAMERA, group={})
    assert isinstance(answer, Rejected)
    assert answer.reason == "AMBIGUOUS"
    assert sorted(it.scene for it in answer.hypotheses) == ["scenes/hall", "scenes/twin"]


WALK = [pose(angle, -1.5) for angle in (-4.0, 2.0, 8.0)]
BLANK = encode(".png", np.full((CAMERA.height_px, CAMERA.width_px, 3), 90, np.uint8))


def rig_of(photos: Sequence[bytes]) -> list[RigImage]:
    return [RigImage(photo, CAMERA, at) for photo, at in zip(photos, WALK, strict=False)]


def frames_of(photos: Sequence[bytes]) -> list[SequenceFrame]:
    return [SequenceFrame(photo, CAMERA, at) for photo, at in zip(photos, WALK, strict=False)]


def test_the_scene_of_priors_is_a_field_of_the_rig(client: Client) -> None:
    near = Priors(position=PositionPrior(np.zeros(3), 20.0))
    images = [replace(it, priors=near) for it in rig_of([PHOTO, PHOTO])]
    with pytest.raises(InvalidArgument) as error:
        client.localize_rig(images, group=SITE_A)
    assert error.value.field == "prior_scene"


@pytest.mark.parametrize("where", [{"scenes": ["yard", "hall"]}, {"group": SITE_A}])
def test_a_rig_is_answered_as_with_its_scene_named(client: Client, where: dict[str, Any]) -> None:
    """Its first photograph shows nothing, so that the second one finds the scene."""
    images = rig_of([BLANK, *(photograph(it) for it in WALK[1:])])
    named, answer = client.localize_rig(images, "hall"), client.localize_rig(images, **where)
    assert isinstance(named, RigLocalization)
    assert isinstance(answer, RigLocalization), str(answer)
    assert (answer.scene, named.scene) == ("scenes/hall", "scenes/hall")
    np.testing.assert_array_equal(answer.world_from_rig.matrix(), named.world_from_rig.matrix())


def test_a_limit_that_leaves_out_the_scene_of_a_rig_rejects_it(client: Client) -> None:
    """The second photograph's limit is at the yard; the first one finds the hall."""
    found(client, group=SITE_A)  # by then it is known how far their references reach
    at_yard = Priors(position=PositionPrior(world_from_other_world(HALL, YARD).translation, 5.0))
    first, second = rig_of([photograph(it) for it in WALK[:2]])
    images = [first, replace(second, priors=at_yard)]
    named = client.localize_rig(images, "hall")
    answer = client.localize_rig(images, group=SITE_A, prior_scene="hall")
    assert isinstance(named, GroupRejected)
    assert isinstance(answer, GroupRejected), str(answer)
    assert (answer.reason, answer.scene) == (named.reason, "scenes/hall") == ("PRIOR_CONFLICT", "scenes/hall")


def test_a_sequence_is_answered_as_with_its_scene_named(client: Client) -> None:
    frames = frames_of([photograph(it) for it in WALK])
    at_hall = Priors(geo_position=GeoPositionPrior(47.0, 8.0, 5.0))
    frames[0] = replace(frames[0], priors=at_hall)
    named, answer = client.localize_sequence(frames, "hall"), client.localize_sequence(frames, group=SITE_A)
    assert isinstance(named, SequenceLocalization)
    assert isinstance(answer, SequenceLocalization), str(answer)
    assert answer.scene == "scenes/hall"
    np.testing.assert_array_equal(answer.world_from_session.rotation, named.world_from_session.rotation)
    assert answer.images[0].prior_checks == named.images[0].prior_checks


def test_a_rig_that_fits_two_scenes_is_ambiguous(client: Client) -> None:
    answer = client.localize_rig(rig_of([photograph(it) for it in WALK]), group={})
    assert isinstance(answer, GroupRejected)
    assert answer.reason == "AMBIGUOUS"
    assert sorted(it.scene for it in answer.hypotheses) == ["scenes/hall", "scenes/twin"]


def logged(caplog: pytest.LogCaptureFixture, name: str) -> dict[str, Any]:
    """The line of the log of a client's only call. Those of earlier tests come late, too."""

    def lines() -> list[dict[str, Any]]:
        fields = [vars(it).get("fields", {}) for it in caplog.records]
        return [it for it in fields if it.get("client") == name]

    wait_until(lines)
    (line,) = lines()
    return line


def test_the_log_of_a_rig_has_the_scene_of_its_answer(client: Client, caplog: pytest.LogCaptureFixture) -> None:
    """Among the scenes of an ambiguous one, doll is the first, and has nothing to do with it."""
    with caplog.at_level(logging.INFO):
        answer = client.acting_for(None, "rig").localize_rig(rig_of([photograph(it) for it in WALK[:2]]), group={})
        line = logged(caplog, "rig")
    assert f"scenes/{line['scene']}" == answer.scene


def test_a_rig_of_no_scene_is_rejected(client: Client) -> None:
    answer = client.localize_rig(rig_of([photograph(it, papers=ELSEWHERE) for it in WALK[:2]]), group=SITE_A)
    assert isinstance(answer, GroupRejected)
    assert answer.reason != "AMBIGUOUS"


def test_a_photograph_with_references_names_its_scene(client: Client) -> None:
    images = [replace(it, references=("scenes/hall/references/r0",)) for it in rig_of([PHOTO])]
    with pytest.raises(InvalidArgument) as refused:
        client.localize_rig(images, group=SITE_A)
    assert refused.value.field == "images[0].references"


def test_watchers_see_answers_of_their_scene_and_nothing_of_others(client: Client, server: RunningServer) -> None:
    """The twin's first message is the answer in it alone: not that hall and twin fit, which the hall's watcher sees."""
    with grpc.insecure_channel(server.address) as channel:
        stub = LocalizationServiceStub(channel)
        watches = [
            stub.WatchQueries(pb.WatchQueriesRequest(scene=f"scenes/{it}"), timeout=60) for it in ("hall", "twin")
        ]
        for watch in watches:
            watch.initial_metadata()
        found(client, group=SITE_A)
        client.localize(PHOTO, CAMERA, group={})
        found(client, scene="twin")
        in_hall, in_either = next(watches[0]).answer, next(watches[0]).answer
        assert next(watches[1]).answer.diagnostics.searched_scene_count == 1
    assert in_hall.HasField("debug")
    assert in_either.rejection.reason == pb.REJECTION_REASON_AMBIGUOUS
    for answer in (in_hall, in_either):
        assert answer.diagnostics.searched_scene_count == 1
        assert not [it for it in ("twin", "yard", "doll", "other scene", '"scenes"') if it in str(answer)]


def test_log_and_metrics_have_what_was_searched_and_found(
    client: Client, server: RunningServer, caplog: pytest.LogCaptureFixture
) -> None:
    before = server.value("mapless_searched_scenes_sum")
    with caplog.at_level(logging.INFO):
        found(client.acting_for(None, "photograph"), group=SITE_A)
        line = logged(caplog, "photograph")
    assert (line["scene"], line["scenes"], line["searched_scenes"]) == ("hall", 3, 3)
    assert server.value("mapless_searched_scenes_sum") == before + 3


GEO = Priors(geo_position=GeoPositionPrior(47.0, 8.0, 5.0))
NEAR = Priors(position=PositionPrior(np.zeros(3), 5.0))
BAD: list[tuple[dict[str, Any], type[MaplessError], str]] = [
    ({"group": {"site": "x"}}, NotFound, "scene_group"),
    ({"group": {"a b": "c"}}, InvalidArgument, "scene_group.labels"),
    ({"scenes": ["hall", "nowhere"]}, NotFound, "scenes[1]"),
    ({"scenes": ["hall", "hall"]}, InvalidArgument, "scenes[1]"),
    ({"scenes": [f"s{i}" for i in range(65)]}, InvalidArgument, "scenes"),
    ({"group": SITE_A, "priors": NEAR}, InvalidArgument, "prior_scene"),
    ({"group": SITE_A, "priors": NEAR, "prior_scene": "twin"}, InvalidArgument, "prior_scene"),
    ({"scene": "hall", "prior_scene": "yard"}, InvalidArgument, "prior_scene"),
    ({"scenes": ["doll", "twin"], "priors": GEO}, InvalidArgument, "geo_position_prior"),
]


@pytest.mark.parametrize(("where", "error", "field"), BAD)
def test_a_wrong_group_is_refused_by_its_field(
    client: Client, where: dict[str, Any], error: type[MaplessError], field: str
) -> None:
    with pytest.raises(error) as refused:
        client.localize(PHOTO, CAMERA, **where)
    assert refused.value.field == field


def test_captured_calls_among_scenes_are_replayed_in_the_one_that_was_found(client: Client, folder: Path) -> None:
    before = set(calls_of(folder / "captured"))
    moved = world_from_other_world(YARD, HALL).compose(TRUE)
    asked: list[dict[str, Any]] = [
        {"group": SITE_A},
        {"scenes": ["yard", "hall"], "priors": GEO},
        {"group": SITE_A, "prior_scene": "hall", "priors": Priors(pose=PosePrior.from_sigmas(TRUE, 0.05, 1.0))},
        {"group": SITE_A, "prior_scene": "yard", "priors": Priors(pose=PosePrior.from_sigmas(moved, 0.05, 1.0))},
        {"group": {}},
    ]
    for where in asked:
        client.localize(PHOTO, CAMERA, **where)
    client.localize_rig(rig_of([photograph(it) for it in WALK[:2]]), group=SITE_A)
    wait_until(lambda: len(calls_of(folder / "captured")) == len(before) + len(asked) + 1)
    new = [decode_call(it.read_bytes()) for it in calls_of(folder / "captured") if it not in before]
    assert {(it.scene_id, it.attributes.datum) for it in new} == {("hall", HALL)}
    settings = Settings(data_dir=folder / "data", features="sift", backend="geometric", background_matching=False)
    wanted = Selection(frozenset(it.request_id for it in new))
    calls = replay(folder / "captured", wanted, settings).calls
    *computed, ambiguous, rig = calls
    assert [(it.verdict, it.changes, it.error) for it in (*computed, rig)] == [("identical", (), "")] * len(asked)
    assert (ambiguous.verdict, ambiguous.outcome_then) == ("not computed", "ambiguous")
    assert "poses in two scenes" in ambiguous.error
