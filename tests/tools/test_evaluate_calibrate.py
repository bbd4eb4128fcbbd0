"""`mapless-server evaluate --calibrate` on a running server, with photographs whose poses are off by planted errors."""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import run
from support.images import encode
from support.layouts import write_cameras
from support.scenes import random_for
from support.wall import Shot, wall

from mapless import Client, LocalizationResult, NewReference, RigidTransform
from mapless.geometry import Camera, rotation_from_vector
from mapless_server.method.bundle.estimate import growth
from mapless_server.scenes.calibration.fit import FitOptions
from mapless_tools.child import child_server
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.calibrate import _compared

CAMERA = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)
SHOTS = wall(CAMERA, 25, step_m=0.12)
REFERENCES, PHOTOGRAPHS = SHOTS[::4], [it for i, it in enumerate(SHOTS) if i % 4 in (1, 3)][:10]
OFF_M = 0.0015
"""Three times the radii of 68 % that are claimed."""


def off(shots: Sequence[Shot], planted_m: float = OFF_M) -> list[Shot]:
    """The photographs with poses that are off by so much, each in another direction, and by a tenth as many degrees."""
    random = random_for("off", planted_m)
    moved = []
    for image, pose in shots:
        shift, axis = (it / np.linalg.norm(it) for it in random.standard_normal((2, 3)))
        turned = rotation_from_vector(np.radians(10 * planted_m) * axis) @ pose.rotation
        moved.append((image, RigidTransform(turned, pose.translation + planted_m * shift)))
    return moved


@pytest.fixture(scope="module")
def address(tmp_path_factory: pytest.TempPathFactory) -> Iterator[str]:
    with child_server(tmp_path_factory.mktemp("data"), {"--features": "sift"}) as server:
        yield server.address


@pytest.fixture(scope="module")
def client(address: str) -> Iterator[Client]:
    with Client(address) as connected:
        connected.create_scene("hall")
        connected.add_references(
            "hall",
            [NewReference(f"r{i}", encode(".png", it), CAMERA, pose) for i, (it, pose) in enumerate(REFERENCES)],
        )
        connected.create_scene("model", arbitrary_unit=True)
        yield connected


def answer(client: Client, **flags: Any) -> LocalizationResult:
    found = client.localize(encode(".png", PHOTOGRAPHS[4][0]), CAMERA, "hall", **flags)
    assert isinstance(found, LocalizationResult)
    return found


def refusal(address: str, folder: Path, *arguments: object) -> str:
    done = run("evaluate", folder, "--calibrate", *arguments, "--address", address)
    assert done.exit_code == 2, done.output
    (line,) = (it for it in done.stderr.strip().splitlines() if it.startswith("mapless-server: "))
    return str(line)


def test_planted_errors_are_in_the_next_answers_radii(client: Client, address: str, tmp_path: Path) -> None:
    folder = write_cameras(tmp_path / "walk", off(PHOTOGRAPHS), CAMERA)
    done = run(
        *("evaluate", folder, "--calibrate", "hall", "--address", address, "--json", tmp_path / "figures.json"),
    )
    assert done.exit_code == 0, done.output
    assert "stored with scene hall, from 10 photographs" in done.stdout
    figures: dict[str, Any] = json.loads((tmp_path / "figures.json").read_text())
    assert (figures["stored_scene"], figures["references"], figures["localized"]) == ("hall", len(REFERENCES), 10)
    assert {it["calibration"] for it in figures["per_query"]} == {"GENERIC"}

    before, after = answer(client, ignore_calibration=True, include_debug=True).accuracy, answer(client).accuracy
    stored = client.get_scene("hall").calibration
    assert before is not None
    assert after is not None
    assert stored is not None
    assert (after.calibration, after.sample_size) == ("MEASURED", 10)
    # Of errors that are all alike the model sees the median.
    expected_m = OFF_M / FitOptions().median_ratio
    assert before.position_68_m < 0.5 * expected_m
    assert after.position_68_m == pytest.approx(expected_m, rel=0.5)
    assert after.position_95_m > after.position_68_m
    # By the model, at the gap that was measured.
    frame = Frame("it", tmp_path, CAMERA, PHOTOGRAPHS[4][1])
    poses = {it.reference_id: it.world_from_camera for it in client.list_references("hall")}
    compared = _compared(frame, answer(client, include_debug=True), poses)
    assert compared is not None
    scaled_m = growth(compared.gap) * stored.position_factor_68 * before.position_68_m
    assert after.position_68_m == pytest.approx(np.hypot(scaled_m, stored.reference_noise_m), rel=1e-3)

    # Measured again it gives the same: answers are compared as they are without a calibration.
    assert run("evaluate", folder, "--calibrate", "hall", "--address", address).exit_code == 0
    again = client.get_scene("hall").calibration
    assert again is not None
    assert again.position_factor_68 == pytest.approx(stored.position_factor_68)


def test_unsuitable_photographs_and_scenes_are_refused(client: Client, address: str, tmp_path: Path) -> None:
    good = write_cameras(tmp_path / "good", off(PHOTOGRAPHS), CAMERA)
    client.update_scene("hall", calibration=None)
    assert "there is no scene nowhere" in refusal(address, good, "nowhere")
    assert "scene model: its unit of length is arbitrary" in refusal(address, good, "model")
    assert "9 photographs are too few" in refusal(address, good, "hall", "--queries", 9)
    own = write_cameras(tmp_path / "own", [*PHOTOGRAPHS, REFERENCES[2]], CAMERA)
    assert "1 of 11 photographs are references of scene hall themselves, the first, 10.png, is r2" in refusal(
        address, own, "hall"
    )
    elsewhere = RigidTransform(rotation_from_vector([0.0, 0.0, 0.5]), np.array([10.0, 0.0, 0.0]))
    moved = [(image, elsewhere.compose(pose)) for image, pose in PHOTOGRAPHS]
    other = write_cameras(tmp_path / "other", moved, CAMERA)
    assert "are the folder's poses in the scene's world?" in refusal(address, other, "hall")
    content = json.loads((good / "cameras.json").read_text()) | {"metric": False}
    (good / "cameras.json").write_text(json.dumps(content))
    assert "good: its unit of length is arbitrary" in refusal(address, good, "hall")
    assert client.get_scene("hall").calibration is None


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--calibrate", "a/b"), "a/b"),
        (("--calibrate", ""), "an id is 1 to 128 characters"),
        (("--calibrate", "s", "--references", 4), "--references: only without --calibrate"),
        (("--calibrate", "s", "--scales", "full", "--worst", 1), "--scales, --worst: only without --calibrate"),
        (("--calibrate", "s", "--k", 0), "k, the references of a query"),
        (("--calibrate", "s", "--layout", "polaroid"), "must be auto or one of"),
        (("--address", "localhost:1"), "--address: only with --calibrate"),
    ],
)
def test_flags_that_do_not_go_together_are_one_line(tmp_path: Path, arguments: tuple[object, ...], words: str) -> None:
    folder = write_cameras(tmp_path / "walk", PHOTOGRAPHS[:2], CAMERA)
    done = run("evaluate", folder, *arguments)
    assert done.exit_code == 2, done.output
    assert done.stdout == ""
    assert words in done.stderr
