"""`mapless-server import` against a real server, and of a folder to a store of its own."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import pytest
from support.commands import run
from support.images import encode
from support.layouts import CAMERA, assert_same_camera, assert_same_pose, truth, write_cameras, write_image
from support.servers import RunningServer
from support.wall import wall
from typer.testing import Result

from mapless import Client
from mapless.geometry import Camera
from mapless_tools.child import ServerFailed
from mapless_tools.ingest.formats.writing import LAYOUTS, PosedImage

COUNT = 12


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Twelve photographs, the first eight for references."""
    path = tmp_path / "photographs"
    images = []
    for i, pose in enumerate(truth(COUNT).poses):
        write_image(path / "images" / f"p{i:02d}.png", seed=i)
        images.append(PosedImage(f"p{i:02d}.png", CAMERA, pose))
    content = json.loads(LAYOUTS["cameras"].files(images, "a test")["cameras.json"])
    for i, frame in enumerate(content["frames"]):
        frame["split"] = "train" if i < 8 else "test"
    (path / "cameras.json").write_text(json.dumps(content))
    return path


@pytest.fixture
def scene(client: Client) -> str:
    """An id that no scene has."""
    return f"import-{time.monotonic_ns()}"


def run_import(server: RunningServer, folder: Path, scene: str, *more: object) -> Result:
    return run("import", folder, scene, "--address", server.address, *more)


def stored(client: Client, scene: str) -> list[str]:
    return [reference.reference_id for reference in client.list_references(scene)]


def test_blank_photographs_are_warned_of(server: RunningServer, scene: str, folder: Path, tmp_path: Path) -> None:
    black = np.zeros((CAMERA.height_px, CAMERA.width_px, 3), np.uint8)
    (folder / "images" / "p03.png").write_bytes(encode(".png", black))
    done = run_import(server, folder, scene, "--skip-check", "--report", tmp_path / "report.json")
    assert done.exit_code == 0, done.output
    assert "  p03: no local features: nothing can be matched with it" in done.stdout
    assert json.loads((tmp_path / "report.json").read_text())["blank"] == ["p03"]


def test_a_folder_becomes_a_scene_and_again_changes_nothing(
    server: RunningServer, client: Client, scene: str, folder: Path, tmp_path: Path
) -> None:
    done = run_import(server, folder, scene, "--report", tmp_path / "report.json")
    assert done.exit_code == 0, done.output
    assert f"scene {scene}: 12 added" in done.stdout
    assert "layout cameras" in done.stderr
    planted = truth(COUNT)
    for i, reference in enumerate(client.list_references(scene)):
        assert reference.reference_id == f"p{i:02d}"
        assert_same_pose(reference.world_from_camera, planted.poses[i])
        assert_same_camera(reference.camera, CAMERA)
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["format"], len(report["added"]), report["stopped"]) == ("cameras", 12, "")
    generation = client.get_scene(scene).generation
    again = run_import(server, folder, scene)
    assert again.exit_code == 0
    assert "0 added, 12 skipped as duplicates, 0 refused" in again.stdout
    assert client.get_scene(scene).generation == generation


def test_a_part_of_a_folder_with_a_prefix(server: RunningServer, client: Client, scene: str, folder: Path) -> None:
    assert run_import(server, folder, scene, "--split", "train", "--stride", 3, "--id-prefix", "east-").exit_code == 0
    assert stored(client, scene) == ["east-p00", "east-p03", "east-p06"]
    assert run_import(server, folder, scene, "--split", "test", "--max", 2).exit_code == 0
    assert stored(client, scene) == ["east-p00", "east-p03", "east-p06", "p08", "p10"]


def test_labels_are_added_to_those_of_the_scene(
    server: RunningServer, client: Client, scene: str, folder: Path
) -> None:
    def labels_after(*flags: str) -> Mapping[str, str]:
        assert run_import(server, folder, scene, "--skip-check", "--max", 2, *flags).exit_code == 0
        return client.get_scene(scene).labels

    assert labels_after("--label", "site=a", "--label", "floor=1") == {"site": "a", "floor": "1"}
    assert labels_after("--label", "floor=2") == {"site": "a", "floor": "2"}
    assert labels_after() == {"site": "a", "floor": "2"}


def test_single_frames_are_refused_by_name_and_the_rest_is_in(
    server: RunningServer, client: Client, scene: str, folder: Path
) -> None:
    """By the reader, before sending, and by the server: a photograph that ends in the middle."""
    file = folder / "cameras.json"
    content = json.loads(file.read_text())
    content["frames"][1]["world_from_camera"][2][2] *= -1
    content["frames"][2]["width"] = 640
    file.write_text(json.dumps(content))
    (folder / "images" / "p03.png").unlink()
    cut = folder / "images" / "p04.png"
    cut.write_bytes(cut.read_bytes()[:300])
    dry = run_import(server, folder, scene, "--skip-check", "--dry-run")
    assert (dry.exit_code, "96x64 pixels, its camera 640x64" in dry.stdout) == (1, True)
    done = run_import(server, folder, scene, "--skip-check")
    assert done.exit_code == 1
    assert "8 added" in done.stdout
    assert "4 refused" in done.stdout
    for part in ("frames[1]", "world_from_camera", "96x64 pixels, its camera 640x64", "there is no file", "decoded"):
        assert part in done.stdout, part
    assert stored(client, scene) == ["p00", *(f"p{i:02d}" for i in range(5, 12))]


def test_a_dry_run_needs_no_server_and_stores_nothing(folder: Path, tmp_path: Path) -> None:
    done = run("import", folder, "nowhere", "--dry-run", "--report", tmp_path / "report.json")
    assert done.exit_code == 0
    assert "12 references could be imported, 0 are refused" in done.stdout
    assert json.loads((tmp_path / "report.json").read_text())["dry_run"] is True


def write_wall(folder: Path) -> Path:
    """Photographs of a wall."""
    camera = Camera(480, 360, 420.0, 420.0, 239.5, 179.5)
    return write_cameras(folder, wall(camera, 5), camera)


def test_the_epipolar_error_of_rendered_photographs_is_printed(tmp_path: Path) -> None:
    done = run("import", write_wall(tmp_path / "wall"), "nowhere", "--dry-run")
    assert done.exit_code == 0, done.output
    assert "epipolar error of matched points under the given poses: median 0." in done.stderr
    assert "warning" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--format", "bundler"), "not 'bundler'"),
        (("--split", "holdout"), "split must be train or test"),
        (("--stride", 0), "stride and max"),
        (("--intrinsics", "1,2,3"), "intrinsics must be fx,fy,cx,cy"),
        (("--id-prefix", "../"), "an id is"),
        (("--label", "site"), "--label takes NAME=VALUE"),
        (("--label", "site=a", "--label", "site=b"), "--label site is given as 'a' and as 'b'"),
        (("--parallel", 0), "--parallel is the number of messages in flight, 1 to 64, not 0"),
        (("--report", "no/such/folder/report.json"), "cannot be written"),
        (("--token-file", "none"), "cannot be read"),
    ],
)
def test_arguments_that_are_wrong_are_named_in_one_line(
    server: RunningServer, folder: Path, arguments: tuple[object, ...], message: str
) -> None:
    done = run_import(server, folder, "refused", "--skip-check", *arguments)
    assert done.exit_code == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("mapless-server:")]
    assert message in line


def test_a_server_that_is_not_there_is_named(folder: Path) -> None:
    done = run("import", folder, "nowhere", "--skip-check", "--address", "127.0.0.1:1")
    assert done.exit_code == 1
    assert "12 not reached" in done.stdout
    assert "stopped:" in done.stdout
    assert "nothing is lost: the same command goes on once the server answers" in done.stdout


def test_a_folder_without_a_layout_is_named(tmp_path: Path) -> None:
    done = run("import", tmp_path, "nowhere", "--dry-run")
    assert done.exit_code == 2
    assert "no layout that is known" in done.stderr
    assert run("import", tmp_path, "not an id", "--dry-run").exit_code == 2


def test_poses_that_do_not_fit_need_an_option_to_be_stored(
    server: RunningServer, client: Client, scene: str, tmp_path: Path
) -> None:
    """A script sees it by the exit code."""
    folder = write_wall(tmp_path / "wall")
    file = folder / "cameras.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        pose = np.array(frame["world_from_camera"])
        frame["world_from_camera"] = (pose @ np.diag([1.0, -1.0, -1.0, 1.0])).tolist()
    file.write_text(json.dumps(content))
    refused = run_import(server, folder, scene)
    assert refused.exit_code == 1
    assert "axes" in refused.stderr
    assert "nothing is stored while the poses do not fit the photographs; --skip-check" in refused.stdout
    assert run_import(server, folder, scene, "--skip-check").exit_code == 0
    assert len(stored(client, scene)) == len(content["frames"])


@pytest.mark.nightly
def test_after_a_termination_the_next_run_continues(tmp_path: Path) -> None:
    """Without an address: a server of its own on the settings' store, which goes with the command."""
    folder = tmp_path / "many"
    count = 80
    images = []
    for i, pose in enumerate(truth(count).poses):
        write_image(folder / "images" / f"p{i:03d}.png", i, 160, 120)
        images.append(PosedImage(f"p{i:03d}.png", Camera(160, 120, 150.0, 150.0, 79.5, 59.5), pose))
    (folder / "cameras.json").write_text(LAYOUTS["cameras"].files(images, "a test")["cameras.json"])
    environment = os.environ | {"MAPLESS_DATA_DIR": str(tmp_path / "store")}
    report = tmp_path / "report.json"
    arguments = [sys.executable, "-m", "mapless_tools", "import", str(folder), "place", "--skip-check"]
    arguments += ["--report", str(report)]
    process = subprocess.Popen(arguments, env=environment, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        assert process.stderr is not None
        while not re.match(r"storing references: [1-9]\d* of", process.stderr.readline()):  # some are stored
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        output, _ = process.communicate(timeout=60)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == 128 + signal.SIGTERM
    assert "goes on from there" in output
    added = len(json.loads(report.read_text())["added"])
    again = subprocess.run(arguments, env=environment, capture_output=True, text=True, timeout=120, check=False)
    assert again.returncode == 0, again.stdout + again.stderr
    content = json.loads(report.read_text())
    # A message whose answer was cut off may be stored, so more can be there than the first run counts.
    assert added <= len(content["skipped"]) < count
    assert len(content["skipped"]) + len(content["added"]) == count


@pytest.mark.parametrize("command", ["import", "export"])
def test_the_store_may_be_named_by_its_folder(
    command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, folder: Path
) -> None:
    asked: list[Path] = []

    def child_server(store: Path, **_: Any) -> NoReturn:
        asked.append(store)
        raise ServerFailed("as asked")

    monkeypatch.setattr("mapless_tools.child.child_server", child_server)
    monkeypatch.delenv("MAPLESS_DATABASE_URL", raising=False)
    arguments = ["scene", str(tmp_path / "out")] if command == "export" else [str(folder), "scene", "--skip-check"]
    arguments = [command, *arguments, "--data-dir", str(tmp_path / "data")]
    assert "as asked" in run(*arguments).output
    assert asked == [tmp_path / "data"]
    both = run(*arguments, "--address", "127.0.0.1:1")
    assert (both.exit_code, "give one of them" in both.output, len(asked)) == (2, True, 1)


def without_metres(folder: Path, scale: float = 1.0, **properties: object) -> Path:
    """The folder as one of an arbitrary unit, its positions multiplied by a factor."""
    file = folder / "cameras.json"
    content = json.loads(file.read_text()) | {"metric": False} | properties
    for frame in content["frames"]:
        for row in frame["world_from_camera"][:3]:
            row[3] *= scale
    file.write_text(json.dumps(content))
    return folder


def test_a_folder_without_metres_marks_its_scene(
    server: RunningServer, client: Client, scene: str, folder: Path, tmp_path: Path
) -> None:
    done = run_import(server, without_metres(folder), scene, "--skip-check")
    assert done.exit_code == 0, done.output
    assert "its unit of length is arbitrary: --scale, --distance or --align gives metres" in done.stderr
    assert client.get_scene(scene).arbitrary_unit
    assert "12 skipped as duplicates" in run_import(server, folder, scene, "--skip-check").stdout
    mixed = run_import(server, folder, scene, "--skip-check", "--scale", 2)
    assert mixed.exit_code == 1
    assert "has 12 references in an arbitrary unit, and these are in metres" in mixed.stdout
    assert run("export", scene, tmp_path / "copy", "--address", server.address).exit_code == 0
    assert json.loads((tmp_path / "copy" / "cameras.json").read_text())["metric"] is False


def test_known_distances_and_positions_give_a_scene_metres(
    server: RunningServer, client: Client, scene: str, folder: Path, tmp_path: Path
) -> None:
    planted = truth(COUNT).poses
    without_metres(folder, 1 / 0.37)
    apart_m = np.linalg.norm(planted[0].translation - planted[7].translation)
    known = "\n".join(f"p{i:02d},{','.join(map(str, planted[i].translation))}" for i in (0, 4, 9))
    (tmp_path / "known.csv").write_text(known)
    ways: tuple[tuple[object, ...], ...] = (("--scale", 0.37), ("--distance", "p00", "p07.png", apart_m))
    for i, way in enumerate(ways):
        done = run_import(server, folder, f"{scene}-{i}", "--skip-check", *way)
        assert done.exit_code == 0, done.output
        assert "one unit of the folder is 0.37 m" in done.stderr
        assert not client.get_scene(f"{scene}-{i}").arbitrary_unit
        for reference, pose in zip(client.list_references(f"{scene}-{i}"), planted, strict=True):
            assert_same_pose(reference.world_from_camera, pose, 1e-6)
    done = run_import(server, folder, scene, "--skip-check", "--align", tmp_path / "known.csv")
    assert done.exit_code == 2
    assert "on one line" in done.stderr


def test_a_scene_made_before_gets_its_references_unit(
    server: RunningServer, client: Client, scene: str, folder: Path
) -> None:
    client.create_scene(scene)
    assert run_import(server, without_metres(folder), scene, "--skip-check").exit_code == 0
    assert client.get_scene(scene).arbitrary_unit
    client.update_scene(scene, arbitrary_unit=False)
    refused = run_import(server, folder, scene, "--skip-check", "--id-prefix", "other-")
    assert refused.exit_code == 1
    assert "--scale 1 if it is the metre" in refused.stdout
    for same in ((), ("--scale", 1)):  # the positions that both have show that the unit is the same
        assert "12 skipped as duplicates" in run_import(server, folder, scene, "--skip-check", *same).stdout


def test_a_datum_of_a_folder_without_metres_is_refused(folder: Path) -> None:
    without_metres(folder, datum={"latitude_deg": 47.0, "longitude_deg": 8.0, "height_m": 400.0})
    done = run("import", folder, "nowhere", "--dry-run", "--skip-check")
    assert done.exit_code == 2
    assert "the folder has a datum, which needs metres" in done.stderr
    assert run("import", folder, "nowhere", "--dry-run", "--skip-check", "--scale", 1).exit_code == 0


@pytest.mark.parametrize(
    ("factor", "properties", "warning"),
    [
        (1, {"down_in_world": [0, 1, 0]}, ""),
        (1, {"down_in_world": [0, -1, 0]}, "down_in_world (0, -1, 0) is 1"),
        (1, {"down_in_world": [0, 0, -1]}, "degrees off the down of 5 reference cameras"),
        (1, {"datum": {"latitude_deg": 47.0, "longitude_deg": 8.0, "height_m": 400.0}}, "the datum's down"),
        (1000, {}, "m away, in the median (0.05 to 500 m are plausible): are the poses in millimetres?"),
        (0.001, {}, "are the poses in kilometres?"),
    ],
)
def test_what_contradicts_the_photographs_is_warned_of(
    tmp_path: Path, factor: float, properties: dict[str, object], warning: str
) -> None:
    folder = without_metres(write_wall(tmp_path / "wall"), factor, metric=True, **properties)
    more = ["--skip-check"] if factor == 1 else []  # which alone finds how far away things are
    done = run("import", folder, "nowhere", "--dry-run", "--report", tmp_path / "report.json", *more)
    assert done.exit_code == 0, done.output
    warnings = json.loads((tmp_path / "report.json").read_text())["warnings"]
    assert [line.removeprefix("warning: ") for line in done.stderr.splitlines() if "warning: " in line] == warnings
    assert any(warning in text for text in warnings) if warning else (warnings == [])


def test_references_in_another_unit_are_warned_of(
    server: RunningServer, client: Client, scene: str, folder: Path
) -> None:
    assert run_import(server, folder, scene, "--skip-check", "--split", "train").exit_code == 0
    more = ("--skip-check", "--id-prefix", "mm-")
    done = run_import(server, without_metres(folder, 1000, metric=True), scene, *more)
    assert "are they in another unit" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--distance", "p00", "p07"), "--distance takes three values"),
        (("--distance", "p00", "p07", "far"), "--distance p00 p07 far: "),
        (("--distance", "p00", "nobody", 3), "no reference 'nobody'"),
        (("--distance", "p00", "p07", -2), "must be above 0 m"),
        *((("--scale", it), "--scale is metres per unit") for it in (0, -1, "nan", "inf")),
        (("--scale", 1e9), "m from the origin"),
        (("--scale", 2, "--align", "known.csv"), "give one of --scale, --distance and --align"),
        (("--align", "no-such.csv"), "no-such.csv cannot be read"),
    ],
)
def test_wrong_metres_are_named_in_one_line(folder: Path, arguments: tuple[object, ...], message: str) -> None:
    done = run("import", folder, "nowhere", "--dry-run", "--skip-check", *arguments)
    assert done.exit_code == 2
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("mapless-server:")]
    assert message in line
