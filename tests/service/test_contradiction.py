"""Scenes whose poses are read otherwise than they were meant, through a server: what is said and what is answered."""

import re
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.commands import run
from support.images import encode
from support.servers import RunningServer, serving_really
from support.waiting import wait_until

import mapless_tools.demo
from mapless import Client, GroupRejected, NewReference, Rejected, RigidTransform, SequenceFrame
from mapless.geometry import Similarity, rotation_from_vector
from mapless_server.images import ImageLimits, decode_image
from mapless_tools.dataset import Frame
from mapless_tools.ingest.formats.cameras import read_folder

FRAMES = read_folder(Path(mapless_tools.demo.__file__).parent / "room").frames
ALL = [it for it in FRAMES if "query" not in it.name]
REFERENCES = ALL[:5]
QUERIES = [it for it in FRAMES if "query" in it.name][:2]
PATIENT_S = 120.0
SIZE_PX = (480, 360)
Reading = Callable[[RigidTransform], RigidTransform]
READINGS: dict[str, Reading] = {
    "right": lambda pose: pose,
    "opengl": lambda pose: RigidTransform(pose.rotation @ np.diag([1.0, -1.0, -1.0]), pose.translation),
    "millimetres": lambda pose: RigidTransform(pose.rotation, 1000 * pose.translation),
}
OTHER_ROTATION = np.array([0.1, 0.7, -0.2])
OTHER_FROM_WORLD = Similarity(0.4, rotation_from_vector(OTHER_ROTATION), np.array([3.0, -2.0, 11.0]))
"""World of a second session with half of the references."""


@cache
def photo(frame: Frame) -> bytes:
    """At half its size, which is enough here and four times as fast."""
    whole = decode_image(frame.image_path.read_bytes(), ImageLimits())
    return encode(".png", np.asarray(cv2.resize(whole, SIZE_PX, interpolation=cv2.INTER_AREA), np.uint8))


def reference(frame: Frame, read: Reading) -> NewReference:
    return NewReference(frame.name, photo(frame), frame.camera.resized(*SIZE_PX), read(frame.world_from_camera))


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    with serving_really(tmp_path_factory.mktemp("data")) as server, Client(server.address) as client:
        for scene, read in READINGS.items():
            client.create_scene(scene)
            client.add_references(scene, [reference(it, read) for it in REFERENCES])
        client.create_scene("sessions")
        for session, pose_of in ((ALL[:8:2], READINGS["right"]), (ALL[1:8:2], OTHER_FROM_WORLD.transform_pose)):
            client.add_references("sessions", [reference(it, pose_of) for it in session])
        client.create_scene("start")
        client.add_references("start", [reference(it, lambda _: RigidTransform.identity()) for it in ALL[:4]])
        client.add_references("start", [reference(it, READINGS["right"]) for it in ALL[4:8]])
        yield server


@pytest.fixture
def client(server: RunningServer) -> Iterator[Client]:
    with Client(server.address) as client:
        yield client


def test_wrong_poses_are_said_and_answer_nothing(client: Client) -> None:
    wait_until(lambda: "OpenGL" in client.get_scene("opengl").contradiction)
    known = client.get_scene("opengl")
    assert known.warnings == (known.contradiction,)
    assert known.agreeing_pair_count < known.compared_pair_count / 2
    sequence = [SequenceFrame(photo(it), it.camera.resized(*SIZE_PX), it.world_from_camera) for it in QUERIES]
    alone = client.localize(sequence[0].image, sequence[0].camera, "opengl", timeout_s=PATIENT_S)
    together = client.localize_sequence(sequence, "opengl", timeout_s=PATIENT_S)
    assert isinstance(alone, Rejected)
    assert isinstance(together, GroupRejected)
    for answer in (alone, together):
        assert answer.hint is not None
        assert answer.hint.advice == "CHECK_REFERENCE_POSES"
        assert answer.message.count("the scene contradicts itself") == 1


def test_a_second_session_is_said_with_the_similarity_that_aligns_it(client: Client) -> None:
    wait_until(
        lambda: (
            re.search("groups of 4 and 4 references.*would fit the other", client.get_scene("sessions").contradiction)
            is not None
        )
    )
    (text,) = client.get_scene("sessions").warnings
    named = re.search(r"that of (\S+), (\S+), (\S+) would", text)
    assert named is not None
    assert set(named.groups()) <= {it.name for it in ALL[1:8:2]}
    numbers = re.search(r"scale (\S+), rotation by (\S+) degrees about \((.+?)\), translation \((.+?)\)", text)
    assert numbers is not None
    scale, angle_deg, axis, translation = (np.array([float(it) for it in part.split(",")]) for part in numbers.groups())
    axis_angle = -np.radians(angle_deg) * axis  # of the similarity's inverse, which was planted
    np.testing.assert_allclose(1 / scale, OTHER_FROM_WORLD.scale, rtol=0.01)
    np.testing.assert_allclose(axis_angle, OTHER_ROTATION, atol=0.01)
    moved = scale * rotation_from_vector(-axis_angle) @ OTHER_FROM_WORLD.translation + translation
    np.testing.assert_allclose(moved, 0, atol=0.1)


def test_poses_of_a_tracker_that_had_not_begun_are_said(client: Client) -> None:
    names = ", ".join(it.name for it in ALL[:4])
    wait_until(lambda: f"exactly the same pose ({names})" in str(client.get_scene("start").warnings))
    warnings = client.get_scene("start").warnings
    assert any("the identity: had tracking not begun?" in it for it in warnings)
    assert not any("likely" in it for it in warnings)


def test_millimetres_are_warned_of_and_reject_nothing(client: Client) -> None:
    wait_until(lambda: len(client.get_scene("millimetres").warnings) > 0)
    known = client.get_scene("millimetres")
    assert known.contradiction == ""
    again = client.add_reference("millimetres", reference(ALL[5], READINGS["millimetres"]))
    for warnings in (known.warnings, again.warnings):
        assert any("are the poses in millimetres?" in it for it in warnings)
    client.update_scene("millimetres", arbitrary_unit=True)
    assert not any("millimetres" in it for it in client.get_scene("millimetres").warnings)


def test_right_poses_are_not_accused(client: Client) -> None:
    known = client.get_scene("right")
    assert (known.contradiction, known.warnings) == ("", ())
    assert known.agreeing_pair_count == known.compared_pair_count > 0


def test_the_audit_says_it_first_and_fails(server: RunningServer) -> None:
    wait_until(lambda: server.value("mapless_contradicting_scenes") >= 2)
    wrong = run("audit", "opengl", "--text", "--address", server.address)
    assert wrong.exit_code == 1
    assert wrong.stdout.startswith("wrong: the scene contradicts itself: of ")
    assert wrong.stdout.splitlines()[-1].endswith(": the scene contradicts itself")
    right = run("audit", "right", "--text", "--address", server.address)
    assert right.exit_code == 0
    assert "pairs of references agree with their poses" in right.stdout
