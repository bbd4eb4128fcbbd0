"""`mapless-server calibrate` on a real server whose answers are off by planted errors.

The stand-in method answers the pose of the reference that resembles the photograph most. Each photograph is one of the
references, stored anew, and its pose in the folder is that reference's, moved by the error that is planted.
"""

import json
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.commands import run
from support.images import encode, textured
from support.layouts import write_cameras
from support.servers import CAMERA, COVARIANCE, RunningServer, pose, serving
from support.wall import wall

from mapless import Camera, Client, LocalizationResult, NewReference, RigidTransform
from mapless.geometry import rotation_from_vector
from mapless_server.method.bundle.estimate import accuracy_from_covariance
from mapless_server.store import Store
from mapless_tools.calibrate.claims import Claim, Sample, fit_factors

COUNT = 12
OFF_M = np.linspace(0.05, 0.75, COUNT)
"""Planted; what is claimed is 0.19 m (68 %) and 0.28 m (95 %)."""
OFF_DEG = np.linspace(0.05, 1.6, COUNT)


def picture(i: int) -> Any:
    return cv2.resize(textured(12, 8, seed=i), (96, 64), interpolation=cv2.INTER_CUBIC)


def moved(i: int) -> RigidTransform:
    """Reference i's pose with the planted error."""
    turn = rotation_from_vector([0.0, np.radians(OFF_DEG[i]), 0.0])
    return RigidTransform(turn @ pose(i).rotation, pose(i).translation + [0.0, OFF_M[i], 0.0])


def write_folder(folder: Path, poses: Sequence[RigidTransform], suffix: str = ".webp") -> Path:
    """Photographs 0, 1, ... with these poses."""
    return write_cameras(folder, ((picture(i), it) for i, it in enumerate(poses)), CAMERA, suffix)


def fill(client: Client, scene: str, count: int = COUNT) -> str:
    client.create_scene(scene)
    client.add_references(
        scene, [NewReference(f"r{i}", encode(".png", picture(i)), CAMERA, pose(i)) for i in range(count)]
    )
    return scene


@pytest.fixture
def planted(client: Client, request: pytest.FixtureRequest) -> Iterator[str]:
    scene = fill(client, request.node.name.replace("_", "-")[:60].strip("-").replace("[", "-").replace("]", ""))
    yield scene
    client.delete_scene(scene)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_folder(tmp_path_factory.mktemp("planted") / "walk", [moved(i) for i in range(COUNT)])


def calibrate(server: RunningServer, output: Path, *arguments: object) -> Any:
    return run("calibrate", *arguments, "--address", server.address, "--output", output)


def refusal(done: Any, code: int = 2) -> str:
    assert done.exit_code == code, done.output
    assert done.stdout == ""
    lines: list[str] = [it for it in done.stderr.strip().splitlines() if it.startswith("mapless-server: ")]
    assert len(lines) == 1
    return lines[0]


def expected_factors() -> Any:
    claimed = accuracy_from_covariance(COVARIANCE)
    turned = np.degrees(np.degrees(COVARIANCE[3:, 3:]))
    return fit_factors(
        Sample(
            tuple(Claim.of(e, claimed.position_68_m, claimed.position_95_m, COVARIANCE[:3, :3]) for e in OFF_M),
            tuple(Claim.of(e, claimed.rotation_68_deg, claimed.rotation_95_deg, turned) for e in OFF_DEG),
        )
    )


def answer_to(client: Client, scene: str) -> LocalizationResult:
    answer = client.localize(encode(".webp", picture(3)), CAMERA, scene)
    assert isinstance(answer, LocalizationResult)
    return answer


def test_planted_factors_multiply_answers_until_they_are_cleared(
    server: RunningServer, client: Client, planted: str, folder: Path, tmp_path: Path
) -> None:
    before = answer_to(client, planted)
    done = calibrate(server, tmp_path, folder, "--scene", planted)
    assert done.exit_code == 0, done.output
    stored, expected = client.get_scene(planted).calibration, expected_factors()
    assert stored is not None
    assert stored.position_factor_68 == pytest.approx(expected.position_68)
    assert stored.position_factor_95 == pytest.approx(expected.position_95)
    assert stored.rotation_factor_68 == pytest.approx(expected.rotation_68)
    assert stored.rotation_factor_95 == pytest.approx(expected.rotation_95)
    assert stored.position_factor_68 > 1.5
    assert (stored.query_count, stored.features, stored.backend) == (COUNT, "stand-in", "geometric")

    after = answer_to(client, planted)
    assert before.accuracy is not None
    assert after.accuracy is not None
    assert (before.accuracy.calibrated, after.accuracy.calibrated) == (False, True)
    assert after.accuracy.position_68_m == pytest.approx(stored.position_factor_68 * before.accuracy.position_68_m)
    assert after.accuracy.position_95_m == pytest.approx(stored.position_factor_95 * before.accuracy.position_95_m)
    assert after.accuracy.rotation_68_deg == pytest.approx(stored.rotation_factor_68 * before.accuracy.rotation_68_deg)
    assert after.covariance is not None
    radii = accuracy_from_covariance(after.covariance)
    assert radii.position_68_m == pytest.approx(after.accuracy.position_68_m)
    assert radii.rotation_68_deg == pytest.approx(after.accuracy.rotation_68_deg)

    figures = json.loads((tmp_path / "report.json").read_text())
    assert [it["error_m"] for it in figures["per_query"]] == pytest.approx(OFF_M.tolist())
    assert figures["held"][0]["before"]["part"] == sum(before.accuracy.position_68_m >= OFF_M)
    assert "<svg" in (tmp_path / "report.html").read_text()

    # Calibrated again, it measures answers as they are without a calibration.
    assert calibrate(server, tmp_path, folder, "--scene", planted).exit_code == 0
    again = client.get_scene(planted).calibration
    assert again is not None
    assert again.position_factor_68 == pytest.approx(stored.position_factor_68)
    assert again.rotation_factor_95 == pytest.approx(stored.rotation_factor_95)

    assert calibrate(server, tmp_path, "--scene", planted, "--clear").exit_code == 0
    assert client.get_scene(planted).calibration is None
    accuracy = answer_to(client, planted).accuracy
    assert accuracy is not None
    assert not accuracy.calibrated


def test_other_features_are_not_calibrated(folder: Path, tmp_path: Path) -> None:
    data = tmp_path / "data"
    with serving(data) as server, Client(server.address) as client:
        scene = fill(client, "planted")
        assert calibrate(server, tmp_path / "out", folder, "--scene", scene).exit_code == 0
    with serving(data, features=("stronger",), store=Store.open(data)) as server, Client(server.address) as client:
        answer = answer_to(client, scene)
        assert client.get_scene(scene).calibration is not None
        assert answer.diagnostics.features == "stronger"
        assert answer.accuracy is not None
        assert not answer.accuracy.calibrated
        assert answer.accuracy.position_68_m == pytest.approx(accuracy_from_covariance(COVARIANCE).position_68_m)


def test_a_dry_run_compares_no_photo_with_itself_nor_stores(
    server: RunningServer, client: Client, planted: str, tmp_path: Path
) -> None:
    """The folder holds the references' very files; the method answers a reference, so what sees itself is exact."""
    same = write_folder(tmp_path / "same", [pose(i) for i in range(COUNT)], ".png")
    done = calibrate(server, tmp_path, same, "--scene", planted, "--dry-run")
    assert "dry run" in done.stdout
    assert client.get_scene(planted).calibration is None
    figures = json.loads((tmp_path / "report.json").read_text())
    assert len(figures["per_query"]) == COUNT
    assert min(it["error_m"] for it in figures["per_query"]) > 0.9


def test_few_photographs_calibrate_nothing(
    server: RunningServer, client: Client, planted: str, folder: Path, tmp_path: Path
) -> None:
    done = calibrate(server, tmp_path, folder, "--scene", planted, "--query-count", 9)
    assert done.exit_code == 1
    assert "9 answers are too few" in " ".join(done.stdout.split())
    assert client.get_scene(planted).calibration is None
    assert json.loads((tmp_path / "report.json").read_text())["factors"] is None


def test_another_world_is_reported_and_not_stored(
    server: RunningServer, client: Client, planted: str, tmp_path: Path
) -> None:
    motion = RigidTransform(rotation_from_vector([0.0, 0.0, 0.5]), np.array([10.0, 0.0, 0.0]))
    other = write_folder(tmp_path / "other", [motion.compose(pose(i)) for i in range(COUNT)])
    assert "another world" in refusal(calibrate(server, tmp_path, other, "--scene", planted))
    assert client.get_scene(planted).calibration is None


def test_a_reference_with_another_pose_is_reported(server: RunningServer, planted: str, tmp_path: Path) -> None:
    other = write_folder(tmp_path / "other", [moved(i) for i in range(COUNT)], ".png")
    said = refusal(calibrate(server, tmp_path, other, "--scene", planted))
    assert "0.png is reference r0" in said
    assert "0.05 m" in said


def test_a_scene_without_answers_is_reported(
    server: RunningServer, client: Client, folder: Path, tmp_path: Path
) -> None:
    fill(client, "lonely", 1)
    assert "has 1 reference; two are needed" in refusal(calibrate(server, tmp_path, folder, "--scene", "lonely"))
    assert "NOT_FOUND" in refusal(calibrate(server, tmp_path, folder, "--scene", "nowhere"), 1)
    assert "NOT_FOUND" in refusal(calibrate(server, tmp_path, "--scene", "nowhere", "--clear"), 1)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--scene", "s", "--references", 4), "--references: only without --scene"),
        (("--dry-run",), "--dry-run: only with --scene"),
        (("--scene", "s", "--clear"), "--clear takes --scene and no folder"),
        (("--scene", "a/b"), "a/b"),
        (("--query-count", 0), "at least 1 query"),
        (("--k", 0), "k, the references of a query"),
        (("--right-cm", 0), "right_cm must be above 0"),
        (("--layout", "polaroid"), "format must be auto or one of"),
    ],
)
def test_wrong_flags_are_one_line(
    server: RunningServer, folder: Path, tmp_path: Path, arguments: tuple[object, ...], words: str
) -> None:
    assert words in refusal(calibrate(server, tmp_path / "out", folder, *arguments))
    assert not (tmp_path / "out").exists()


def test_wrong_folders_are_one_line(server: RunningServer, tmp_path: Path) -> None:
    assert "no layout that is known" in refusal(calibrate(server, tmp_path / "out", tmp_path, "--scene", "s"))
    assert "is not a folder" in refusal(calibrate(server, tmp_path / "out", tmp_path / "nowhere"))
    assert "name the folder" in refusal(calibrate(server, tmp_path / "out", "--scene", "s"))


@pytest.mark.nightly
@pytest.mark.timeout(600)
def test_a_folder_by_itself(tmp_path: Path) -> None:
    """Through a server of its own, with the real method: right answers, and claims that were counted."""
    camera = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)
    write_cameras(tmp_path / "walk", wall(camera, 11), camera)
    done = run("calibrate", tmp_path / "walk", "--output", tmp_path / "out")
    assert done.exit_code == 0, done.output
    figures = json.loads((tmp_path / "out/report.json").read_text())
    assert (figures["photographs"], figures["references"], figures["scene"]) == (11, 11, None)
    assert figures["right"]["part"] >= 10
    assert figures["computed_by"]["variant"] == "BEST"
    assert 0.05 < figures["factors"]["position_68"] < 20
