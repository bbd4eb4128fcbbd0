"""Localize through a real server: requests, answers, refusals."""

import itertools
import threading
from datetime import datetime, timezone
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.servers import CAMERA, COARSE_X_M, COVARIANCE, PHOTO, RunningServer, Staged, make_scene, pose, serving
from support.waiting import wait_until, with_enough_time

from mapless import (
    Client,
    ConnectOptions,
    DeadlineExceeded,
    InvalidArgument,
    LocalizationResult,
    NewReference,
    NotFound,
    PositionPrior,
    Priors,
    Rejected,
    Unavailable,
)
from mapless.geodesy import Datum, geodetic_from_world
from mapless.priors import GeoPositionPrior, GravityPrior
from mapless_server.security import SceneKey
from mapless_server.store import Store


def localized(answer: LocalizationResult | Rejected) -> LocalizationResult:
    assert isinstance(answer, LocalizationResult)
    return answer


def rejected(answer: LocalizationResult | Rejected) -> Rejected:
    assert isinstance(answer, Rejected)
    return answer


def test_an_answer_in_full(client: Client, scene: str) -> None:
    captured = datetime(2026, 1, 2, 3, 4, 5, 678901, timezone.utc)
    answer = localized(
        client.localize(
            PHOTO, CAMERA, scene, ["r2", "r0"], variant="full", capture_time=captured, session_from_camera=pose(7.0)
        )
    )
    np.testing.assert_allclose(answer.world_from_camera.matrix(), pose(2.0).matrix(), atol=1e-12)
    assert answer.covariance is not None
    np.testing.assert_array_equal(answer.covariance, COVARIANCE)
    assert answer.accuracy is not None
    assert 0.18 < answer.accuracy.position_68_m < 0.19
    assert answer.accuracy.position_68_m < answer.accuracy.position_95_m
    assert not answer.accuracy.calibrated
    assert (answer.pose_stage, answer.inlier_count, answer.match_count) == ("REFINED", 90, 120)
    assert answer.capture_time == captured
    assert answer.world_from_session is not None
    now = answer.world_from_session.compose(pose(7.0))
    np.testing.assert_allclose(now.matrix(), pose(2.0).matrix(), atol=1e-12)

    used = answer.diagnostics
    assert [use.name for use in used.references] == [f"scenes/{scene}/references/{r}" for r in ("r2", "r0")]
    assert [use.match_count for use in used.references] == [0, 1]
    assert (used.backend, used.features, used.variant) == ("geometric", "stand-in", "FULL")
    assert used.store_generation == client.get_scene(scene).generation
    assert used.scale is not None
    assert (used.scale.metres_per_unit, used.scale.stage) == (2.0, "TRIANGULATION")
    assert list(used.stage_s) == ["decode", "features", "correspond", "coarse", "pnp"]
    assert used.stage_s["coarse"] == 0.1
    assert 0 <= used.queue_s <= used.total_s
    assert (used.processed_width_px, used.processed_height_px) == (96, 64)
    assert len(used.request_id) == 32


@pytest.mark.parametrize("deletions", [1, 2, 3])
def test_references_that_go_while_the_server_chooses(
    server: RunningServer, client: Client, scene: str, monkeypatch: pytest.MonkeyPatch, deletions: int
) -> None:
    listed = Store.list_changes
    left = iter(range(deletions))

    def list_then_delete(store: Store, scene_key: SceneKey, *arguments: Any) -> Any:
        changes = listed(store, scene_key, *arguments)
        # Threads that find how well poses agree, and count photographs, list references at other times.
        is_query = not threading.current_thread().name.startswith(("agreement", "counting"))
        for i in itertools.islice(left, 1 if is_query and scene_key == SceneKey(scene) else 0):
            store.delete_reference(scene_key, f"r{i}")
        return changes

    monkeypatch.setattr(Store, "list_changes", list_then_delete)
    with Client(server.address, ConnectOptions(max_attempts=1)) as impatient:
        if deletions < 3:
            uses = localized(impatient.localize(PHOTO, CAMERA, scene)).diagnostics.references
            assert [use.name for use in uses] == [f"scenes/{scene}/references/r{i}" for i in range(deletions, 3)]
        else:
            with pytest.raises(Unavailable) as caught:
                impatient.localize(PHOTO, CAMERA, scene)
            assert caught.value.reason == "SCENE_CHANGED"
    # The client's own retry finds a scene at rest, be it empty.
    assert client.localize(PHOTO, CAMERA, scene)


def test_an_empty_scene_is_a_rejection(client: Client) -> None:
    client.create_scene("empty")
    answer = rejected(client.localize(PHOTO, CAMERA, "empty"))
    assert answer.reason == "NO_USABLE_REFERENCES"
    assert answer.diagnostics.processed_width_px == 96
    near = Priors(PositionPrior(np.zeros(3), 3.0))
    for same in (answer, rejected(client.localize(PHOTO, CAMERA, "empty", priors=near))):
        assert same.message == "the scene has no references"
        assert same.hint is not None
        assert same.hint.message.startswith("There are no references")
    client.delete_scene("empty")


def test_a_pose_outside_the_prior_is_rejected(client: Client, scene: str) -> None:
    at_r1 = pose(1.0).translation
    near = PositionPrior(at_r1 + np.array([0.3, 0, 0]), 0.5)
    far = PositionPrior(at_r1 + np.array([0.6, 0, 0]), 0.5)
    localized(client.localize(PHOTO, CAMERA, scene, ["r1"], priors=Priors(near)))
    answer = rejected(client.localize(PHOTO, CAMERA, scene, ["r1"], priors=Priors(far)))
    assert answer.reason == "PRIOR_CONFLICT"
    assert "0.10 m outside" in answer.message


@pytest.mark.parametrize("image", [b"", PHOTO[:-100]], ids=["by its header", "by its pixels"])
def test_a_bad_request_is_refused_by_its_field(server: RunningServer, client: Client, scene: str, image: bytes) -> None:
    """Nothing is computed; all other fields are in `services/test_refused_requests.py`."""
    computed_before = server.method.call_count
    with pytest.raises(InvalidArgument) as caught:
        client.localize(image, CAMERA, scene)
    assert caught.value.field == "image"
    assert server.method.call_count == computed_before


def test_unknown_scenes_and_references(client: Client, scene: str) -> None:
    with pytest.raises(NotFound, match="nowhere"):
        client.localize(PHOTO, CAMERA, "nowhere")
    with pytest.raises(NotFound, match="nowhere"):
        client.localize(PHOTO, CAMERA, "nowhere", ["r1"])
    with pytest.raises(NotFound) as caught:
        client.localize(PHOTO, CAMERA, scene, ["r1", "absent"])
    assert caught.value.field == "references[1]"


DATUM = Datum(47.3769, 8.5417, 450.0)
GRAVITY = Priors(gravity=GravityPrior(np.array([0.0, 1.0, 0.0]), sigma_deg=1.0))
SATELLITE = Priors(geo_position=GeoPositionPrior(47.3769, 8.5417, horizontal_sigma_m=4.0))


@pytest.mark.parametrize(
    ("priors", "field", "flag"),
    [(GRAVITY, "gravity_prior.down_in_world", "--down"), (SATELLITE, "geo_position_prior", "--datum")],
    ids=["gravity", "satellites"],
)
def test_what_the_scene_must_say_for_a_prior_is_named(
    client: Client, scene: str, priors: Priors, field: str, flag: str
) -> None:
    with pytest.raises(InvalidArgument, match=f"mapless scene update {flag}") as caught:
        client.localize(PHOTO, CAMERA, scene, priors=priors)
    assert caught.value.field == field
    client.update_scene(scene, datum=DATUM)
    assert isinstance(client.localize(PHOTO, CAMERA, scene, priors=priors), LocalizationResult)


def test_satellites_and_a_covariance_narrow_the_choice_alike(client: Client) -> None:
    """Four standard deviations of half a metre and ten metres around x = 4 m; height unknown."""
    client.create_scene("square", datum=DATUM)
    client.add_references("square", [NewReference(f"x{x}", PHOTO, CAMERA, pose(float(x))) for x in (0, 8, 15, 40)])
    there = geodetic_from_world(pose(4.0).translation, DATUM)
    satellites = GeoPositionPrior(there.latitude_deg, there.longitude_deg, horizontal_sigma_m=0.5)
    likely = PositionPrior(pose(4.0).translation, covariance_m2=0.5**2 * np.eye(3))
    for priors in (Priors(geo_position=satellites), Priors(likely)):
        answer = client.localize(PHOTO, CAMERA, "square", priors=priors)
        assert {use.name.rpartition("/")[2] for use in answer.diagnostics.references} == {"x0", "x8", "x15"}
    nowhere = client.localize(PHOTO, CAMERA, "square", priors=Priors(PositionPrior(np.array([1e6, 0, 0]), 3.0)))
    assert isinstance(nowhere, Rejected)
    assert (nowhere.reason, nowhere.message) == ("NO_USABLE_REFERENCES", "no reference is where the prior says")
    client.delete_scene("square")


def test_the_coarse_pose_is_answered_if_refining_has_no_time(tmp_path: Path) -> None:
    staged = Staged()
    with serving(tmp_path, method=staged.method()) as server, Client(server.address) as client:
        make_scene(client)
        coarse = with_enough_time(
            lambda limit_s: client.localize(PHOTO, CAMERA, "s", allow_coarse=True, timeout_s=limit_s), DeadlineExceeded
        )
        assert isinstance(coarse, LocalizationResult)
        assert (coarse.pose_stage, coarse.covariance, coarse.accuracy) == ("COARSE", None, None)
        np.testing.assert_allclose(coarse.world_from_camera.matrix(), pose(COARSE_X_M).matrix(), atol=1e-9)
        with pytest.raises(DeadlineExceeded):
            client.localize(PHOTO, CAMERA, "s", timeout_s=1.0)
        assert staged.refining.acquire(blocking=False)
        wait_until(lambda: server.value("mapless_jobs_terminated_total", outcome="degraded"))
