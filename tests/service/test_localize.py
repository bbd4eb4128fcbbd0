"""Localize through a real server: requests, answers, refusals."""

import itertools
import math
import threading
from datetime import datetime, timezone
from typing import Any

import numpy as np
import pytest
from support.images import encode, png_claiming, textured, with_exif_orientation
from support.messages import set_field
from support.servers import CAMERA, COVARIANCE, PHOTO, RunningServer, Stubs, failure_of, localize_request, pose

from mapless import (
    Client,
    ConnectOptions,
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
from mapless.geometry import Camera
from mapless.priors import GeoPositionPrior, GravityPrior
from mapless.v1 import geometry_pb2 as geometry_pb
from mapless.v1 import localization_service_pb2 as pb
from mapless_server.security import SceneKey
from mapless_server.store import Store

JPEG = encode(".jpg", textured())


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
        # How well a scene's poses agree is found in a thread of its own, which lists references at other times.
        is_query = not threading.current_thread().name.startswith("agreement")
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


def test_exif_orientation_does_not_turn_the_intrinsics(client: Client, scene: str) -> None:
    turned = Camera(64, 96, 80.0, 81.0, 31.5, 47.5)
    with pytest.raises(InvalidArgument, match="64x96 pixels, the image has 96x64") as caught:
        client.localize(with_exif_orientation(JPEG, 6), turned, scene)
    assert caught.value.field == "intrinsics.width_px"


Case = tuple[str, Any] | tuple[str, Any, str]
"""The field that is set, to what, and the field that is refused if it is another one."""


def session_at(**quaternion: float) -> geometry_pb.RigidTransform:
    return geometry_pb.RigidTransform(
        rotation=geometry_pb.Quaternion(**quaternion), translation_m=geometry_pb.Vector3(x=0, y=0, z=0)
    )


def prior_at(radius_m: float, x_m: float = 0.0) -> pb.PositionPrior:
    return pb.PositionPrior(position_m=geometry_pb.Vector3(x=x_m), radius_m=radius_m)


BAD_REQUESTS: dict[str, Case] = {
    "no image": ("image", b""),
    "not an image": ("image", b"<svg/>" * 30),
    "truncated": ("image", PHOTO[:-100]),
    "900 megapixels": ("image", png_claiming(30_000, 30_000)),
    "too many bytes": ("image", PHOTO + bytes(17 * 2**20)),
    "no intrinsics": ("intrinsics", None),
    "other size": ("intrinsics.width_px", 97),
    "focal length 0": ("intrinsics.focal_x_px", 0.0),
    "focal length NaN": ("intrinsics.focal_x_px", math.nan),
    "principal point infinite": ("intrinsics.principal_y_px", math.inf),
    "zero quaternion": ("session_from_camera", session_at(), "session_from_camera.rotation"),
    "radius 0": ("position_prior", prior_at(0.0), "position_prior.radius_m"),
    "time in milliseconds": ("capture_time.seconds", 1_700_000_000_000, "capture_time"),
    "time of -5 ns": ("capture_time.nanos", -5, "capture_time"),
    "no scene": ("scene", None),
    "scene id alone": ("scene", "kitchen"),
    "duplicate reference": ("references", ["{scene}/references/r1"] * 2, "references[1]"),
    "reference of another scene": ("references", ["scenes/other/references/r1"], "references[0]"),
    "reference id with ..": ("references", ["{scene}/references/a..b"], "references[0]"),
    "reference id with /": ("references", ["{scene}/references/../../etc/passwd"], "references[0]"),
    "reference id of 10,000": ("references", ["{scene}/references/" + "x" * 10_000], "references[0]"),
    "65 references": ("references", [f"{{scene}}/references/r{i}" for i in range(65)]),
    "unknown variant": ("options.variant", 77),
    "unknown scale strategy": ("options.scale_strategy", -1),
    "65 chosen": ("options.reference_count", 65),
    "-1 chosen": ("options.reference_count", -1),
}


@pytest.mark.parametrize("name", BAD_REQUESTS)
def test_bad_requests_are_refused_by_field(
    server: RunningServer, stubs: Stubs, client: Client, scene: str, name: str
) -> None:
    path, value, *other = BAD_REQUESTS[name]
    if path == "references":
        value = [it.format(scene=f"scenes/{scene}") for it in value]
    request = localize_request(scene)
    set_field(request, path, value)
    computed_before = server.method.call_count
    error = failure_of(stubs.localization.Localize, request)
    assert (error.code, error.field) == ("INVALID_ARGUMENT", (*other, path)[0])
    assert len(error.message) <= 1000
    assert server.method.call_count == computed_before
    localized(client.localize(PHOTO, CAMERA, scene))


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
