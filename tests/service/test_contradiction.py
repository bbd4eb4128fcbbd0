"""A scene whose poses are of OpenGL's axes, or inverse, through a server: it is said, and no pose is answered."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from support.commands import run
from support.servers import RunningServer, serving_really
from support.waiting import wait_until

import mapless_tools.demo
from mapless import Client, NewReference, Rejected, RigidTransform
from mapless_tools.ingest.formats.cameras import read_folder

FRAMES = read_folder(Path(mapless_tools.demo.__file__).parent / "room").frames
REFERENCES = [it for it in FRAMES if "query" not in it.name][:5]
QUERIES = [it for it in FRAMES if "query" in it.name][:2]
PATIENT_S = 120.0
READINGS: dict[str, Callable[[RigidTransform], RigidTransform]] = {
    "right": lambda pose: pose,
    "opengl": lambda pose: RigidTransform(pose.rotation @ np.diag([1.0, -1.0, -1.0]), pose.translation),
    "inverse": lambda pose: pose.inverse(),
}


@pytest.fixture(scope="module")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    with serving_really(tmp_path_factory.mktemp("data")) as server, Client(server.address) as client:
        for scene, read in READINGS.items():
            client.create_scene(scene)
            for frame in REFERENCES:
                pose = read(frame.world_from_camera)
                client.add_reference(scene, NewReference(frame.name, frame.image_path, frame.camera, pose))
        yield server


@pytest.fixture
def client(server: RunningServer) -> Iterator[Client]:
    with Client(server.address) as client:
        yield client


@pytest.mark.parametrize(("scene", "likely"), [("opengl", "OpenGL"), ("inverse", "camera_from_world")])
def test_wrong_poses_are_said_and_answer_nothing(client: Client, scene: str, likely: str) -> None:
    wait_until(lambda: likely in client.get_scene(scene).contradiction)
    known = client.get_scene(scene)
    assert known.warnings == (known.contradiction,)
    assert known.agreeing_pair_count < known.compared_pair_count / 2
    for frame in QUERIES:
        answer = client.localize(frame.image_path, frame.camera, scene, timeout_s=PATIENT_S)
        assert isinstance(answer, Rejected)
        assert answer.hint is not None
        assert answer.hint.advice == "CHECK_REFERENCE_POSES"
        assert known.contradiction.partition(":")[0] in answer.message
        assert not answer.intrinsics_checks


def test_right_poses_are_not_accused(client: Client) -> None:
    known = client.get_scene("right")
    assert known.contradiction == ""
    assert known.agreeing_pair_count == known.compared_pair_count > 0
    answers = [client.localize(it.image_path, it.camera, "right", timeout_s=PATIENT_S) for it in QUERIES]
    hints = [it.hint for it in answers if isinstance(it, Rejected)]
    assert all(it is not None and it.advice != "CHECK_REFERENCE_POSES" for it in hints)


def test_the_metric_counts_the_scenes(server: RunningServer) -> None:
    wait_until(lambda: server.value("mapless_contradicting_scenes") == 2)


def test_the_audit_says_it_first_and_fails(server: RunningServer) -> None:
    wrong = run("audit", "opengl", "--text", "--address", server.address)
    assert wrong.exit_code == 1
    assert wrong.stdout.startswith("wrong: the scene contradicts itself: of ")
    assert wrong.stdout.splitlines()[-1].endswith(": the scene contradicts itself")
    right = run("audit", "right", "--text", "--address", server.address)
    assert right.exit_code == 0
    assert "pairs of references agree with their poses" in right.stdout
