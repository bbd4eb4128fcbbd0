"""A pose that is rejected for its radius alone goes with the rejection if the caller asks for it, and only then.

The photograph shows a window of a room, and its two references stand nearly at one place.
"""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support import corner
from support.commands import run, run_client
from support.images import encode
from support.waiting import wait_until

from mapless import (
    Client,
    ConnectOptions,
    Hypothesis,
    PositionPrior,
    Priors,
    Rejected,
    RigImage,
    SequenceFrame,
)
from mapless.geometry import rotation_angle_deg
from mapless_server.services.capture.folder import calls_of
from mapless_tools.child import child_server

ANGLES = (0.0, 0.8)
TRUE = corner.pose(10.0, -1.5)
PHOTO = corner.photograph(TRUE)
WINDOW = np.zeros((corner.CAMERA.height_px, corner.CAMERA.width_px, 3), np.uint8)
WINDOW[160:220, 211:301] = 255
MASK = encode(".png", WINDOW)
NEEDED = "8 % is needed"


@pytest.fixture(scope="module")
def asked(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Client, str, Path]]:
    """A client, the server's address, and the folder in which its calls are captured."""
    folder = tmp_path_factory.mktemp("imprecise")
    flags = {"--capture-dir": str(folder / "calls"), "--features": "sift"}
    with (
        child_server(folder / "data", flags, {"MAPLESS_CAPTURE_HOURS": "1"}) as server,
        Client(server.address, ConnectOptions(timeout_s=120)) as client,
    ):
        corner.make_corner(client, [corner.pose(it) for it in ANGLES])
        yield client, server.address, folder


@pytest.fixture
def client(asked: tuple[Client, str, Path]) -> Client:
    return asked[0]


def the_pose(rejected: object) -> Hypothesis:
    """The pose of a rejection for the radius alone, which says truly how far it is off."""
    assert isinstance(rejected, Rejected)
    assert rejected.reason == "GATE"
    assert NEEDED in rejected.message
    (found,) = rejected.hypotheses
    assert_true(found)
    return found


def assert_true(found: Hypothesis) -> None:
    assert found.accuracy is not None
    assert found.covariance is not None
    off_m = float(np.linalg.norm(found.world_from_camera.translation - TRUE.translation))
    off_deg = rotation_angle_deg(found.world_from_camera.rotation.T @ TRUE.rotation)
    assert off_m < 2 * found.accuracy.position_95_m
    assert off_deg < 2 * found.accuracy.rotation_95_deg
    assert found.inlier_count > 10
    assert {it.rpartition("/")[2] for it in found.references} == {"r0", "r1"}


def test_only_who_asks_has_the_pose(client: Client) -> None:
    """In the axes and the session of the caller."""
    silent = client.localize(PHOTO, corner.CAMERA, "corner", mask=MASK)
    assert isinstance(silent, Rejected)
    assert NEEDED in silent.message
    assert silent.hypotheses == ()
    session = corner.pose(1.0)
    asked: dict[str, Any] = {"include_imprecise_pose": True, "axes": "arkit", "session_from_camera": session}
    answer = client.localize(PHOTO, corner.CAMERA, "corner", mask=MASK, **asked)
    found = the_pose(answer).in_axes
    assert found is not None
    assert found.axes == "ARKIT"
    assert found.world_from_session is not None
    placed = found.world_from_session.compose(session)
    np.testing.assert_allclose(placed.translation, TRUE.translation, atol=1.0)
    assert "the pose that is too imprecise, in ARKIT axes" in str(answer)
    (only,) = client.localize_progressively(PHOTO, corner.CAMERA, "corner", mask=MASK, include_imprecise_pose=True)
    the_pose(only)


def test_what_else_speaks_against_it_takes_it_away(client: Client) -> None:
    """Too little evidence for the coverage, and a limit that leaves the references, but not the pose."""
    limit = PositionPrior(corner.pose(0.0).translation, radius_m=0.3)
    for coverage, priors in ((0.001, Priors()), (0.0, Priors(position=limit))):
        answer = client.localize(
            PHOTO, corner.CAMERA, "corner", mask=MASK, include_imprecise_pose=True, coverage=coverage, priors=priors
        )
        assert isinstance(answer, Rejected)
        assert answer.hypotheses == ()


@pytest.mark.parametrize("is_asked", [True, False])
def test_photographs_of_groups_have_theirs(client: Client, is_asked: bool) -> None:
    rig = [RigImage(PHOTO, corner.CAMERA, corner.pose(0.0), mask=MASK)]
    walk = [SequenceFrame(PHOTO, corner.CAMERA, it, mask=MASK) for it in (TRUE, TRUE)]
    for joint in (
        client.localize_rig(rig, "corner", include_imprecise_pose=is_asked),
        client.localize_sequence(walk, "corner", include_imprecise_pose=is_asked),
    ):
        for image in joint.images:
            assert image.rejected_alone == "GATE"
            assert len(image.hypotheses_alone) == is_asked
            list(map(assert_true, image.hypotheses_alone))


def test_the_command_prints_it_and_fails_all_the_same(
    asked: tuple[Client, str, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "photo.png").write_bytes(PHOTO)
    (tmp_path / "mask.png").write_bytes(MASK)
    camera = {"width_px": 512, "height_px": 384, "focal_x_px": 430, "focal_y_px": 430}
    (tmp_path / "camera.json").write_text(json.dumps(camera | {"principal_x_px": 255.5, "principal_y_px": 191.5}))
    form, wanted = ("--address", asked[1]), "--include-imprecise-pose"
    flags = ("corner", tmp_path / "photo.png", "--camera", tmp_path / "camera.json", "--mask", tmp_path / "mask.png")
    code, printed, _ = run_client(capsys, *form, "--json", "localize", *flags, wanted)
    (found,) = json.loads(printed)["hypotheses"]
    assert code == 3
    assert found["accuracy"]["position_95_m"] > 0.1
    code, printed, _ = run_client(capsys, *form, "--text", "localize", *flags, wanted)
    assert code == 3
    assert printed.startswith("not localized in ")
    assert "the pose that is too imprecise:\n  position" in printed
    assert "too imprecise" not in run_client(capsys, *form, "--text", "localize", *flags)[1]


def test_a_replay_gives_it_again(asked: tuple[Client, str, Path]) -> None:
    client, _, folder = asked
    the_pose(client.localize(PHOTO, corner.CAMERA, "corner", mask=MASK, include_imprecise_pose=True))
    wait_until(lambda: len(calls_of(folder / "calls")) >= 1)
    done = run("replay", folder / "calls", "--data-dir", folder / "data", "--last", "3", "--json")
    assert {it["verdict"] for it in json.loads(done.stdout)["calls"]} == {"identical"}
