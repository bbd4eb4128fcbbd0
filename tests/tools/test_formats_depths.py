"""Depth in `cameras.json`: what is said of one frame or of all, and wrong fields by their names."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.commands import run
from support.images import encode, textured
from support.scenes import CAMERA

from mapless import DepthNoise, DepthSensor
from mapless.geometry import RigidTransform
from mapless_tools.dataset import Dataset, DepthFile
from mapless_tools.ingest.formats import read_dataset
from mapless_tools.ingest.formats.writing import PosedImage, cameras_files

ALL = {"depth_unit_m": 0.001, "depth_sensor": "stereo"}


def read(path: Path, entry: dict[str, Any], beside: dict[str, Any]) -> Dataset:
    """A folder of one photograph, with these entries of its frame and beside the frames."""
    (text,) = cameras_files([PosedImage("1.png", CAMERA, RigidTransform.identity())], "test").values()
    content = json.loads(text) | beside
    content["frames"][0] |= entry
    for folder in ("images", "depth"):
        (path / folder).mkdir(exist_ok=True)
    (path / "images" / "1.png").write_bytes(encode(".png", textured(CAMERA.width_px, CAMERA.height_px)))
    (path / "depth" / "1.png").write_bytes(encode(".png", np.ones((60, 80), np.uint16)))
    (path / "depth" / "1.f32").write_bytes(bytes(4 * CAMERA.width_px * CAMERA.height_px))
    (path / "cameras.json").write_text(json.dumps(content))
    return read_dataset(path)


def depth_of(path: Path, entry: dict[str, Any], beside: dict[str, Any]) -> DepthFile:
    (frame,) = read(path, entry, beside).frames
    assert frame.depth is not None
    return frame.depth


def test_a_frame_says_more_than_what_is_beside_the_frames(tmp_path: Path) -> None:
    found = depth_of(tmp_path, {"depth": "depth/1.png", "depth_unit_m": 0.0002}, ALL)
    assert (found.unit_m, found.sensor, found.camera) == (0.0002, DepthSensor.STEREO, None)


def test_another_camera_has_its_own_size_and_pose(tmp_path: Path) -> None:
    k = [[80.0, 0, 40.0], [0, 81.0, 30.0], [0, 0, 1]]
    pose = [[1, 0, 0, -0.02], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]
    entry = {"depth": "depth/1.png", "depth_K": k, "depth_width": 80, "depth_height": 60}
    found = depth_of(tmp_path, entry | {"camera_from_depth_camera": pose, "depth_noise": {"linear": 0.02}}, ALL)
    assert found.camera is not None
    assert (found.camera.width_px, found.camera.focal_y_px) == (80, 81.0)
    assert found.camera_from_depth_camera is not None
    assert found.camera_from_depth_camera.translation[0] == -0.02
    assert found.noise == DepthNoise(linear=0.02)


@pytest.mark.parametrize(
    ("entry", "field"),
    [
        ({"depth": "depth/2.png"}, "^(?!.*image:).*depth: there is no file"),
        ({"depth": 1}, "depth:"),
        ({"depth": "depth/1.png", "depth_unit_m": None}, "depth_unit_m is missing: 0.001 for mill"),
        ({"depth": "depth/1.png", "depth_unit_m": "mm"}, "depth_unit_m must be a number, is 'mm'"),
        ({"depth": "depth/1.png", "depth_sensor": "sonar"}, "depth_sensor must be one of unknown, .*, is 'sonar'"),
        ({"depth": "depth/1.png", "depth_min_confidence": "much"}, "depth_min_confidence:"),
        ({"depth": "depth/1.f32", "depth_width": 80.5}, "depth_width:"),
        ({"depth": "depth/1.png", "depth_K": 5}, "depth_K:"),
        ({"depth": "depth/1.png", "camera_from_depth_camera": [1, 2]}, "camera_from_depth_camera:"),
        (
            {"depth": "depth/1.png", "depth_noise": {"bias": 1}},
            "depth_noise: must be an object of constant_m, linear, .*'bias'",
        ),
    ],
    ids=lambda it: it if isinstance(it, str) else "",
)
def test_a_wrong_field_is_named(tmp_path: Path, entry: dict[str, Any], field: str) -> None:
    with pytest.raises(ValueError, match=field):
        read(tmp_path, entry, ALL)


def test_a_number_that_is_null_is_missing(tmp_path: Path) -> None:
    entry = {"depth": "depth/1.f32", "depth_width": None, "depth_height": None, "depth_min_confidence": None}
    found = depth_of(tmp_path, entry, ALL)
    assert (found.size, found.min_confidence) == ((CAMERA.width_px, CAMERA.height_px), 1)


def test_a_dry_run_names_depth_that_a_server_would_refuse(tmp_path: Path) -> None:
    """A wrong depth of our own layout refuses its photograph; --no-depth imports that without it."""
    dataset = read(tmp_path, {"depth": "depth/1.png"}, ALL)
    file = tmp_path / "depth" / "1.png"
    file.write_bytes(file.read_bytes()[:-20])
    done = run("import", tmp_path, "nowhere", "--dry-run", "--skip-check")
    assert (done.exit_code, "the PNG is cut off" in done.output) == (1, True), done.output
    assert len(dataset.frames) == 1
    assert run("import", tmp_path, "nowhere", "--dry-run", "--skip-check", "--no-depth").exit_code == 0


@pytest.mark.parametrize(("unit", "is_wrong"), [("1", True), ("0.001", False)])
def test_an_import_says_that_a_unit_cannot_be_right(tmp_path: Path, unit: str, is_wrong: bool) -> None:
    read(tmp_path, {"depth": "depth/1.png"}, ALL)
    size = CAMERA.height_px, CAMERA.width_px
    (tmp_path / "depth" / "1.png").write_bytes(encode(".png", np.full(size, 1900, np.uint16)))
    done = run("import", tmp_path, "nowhere", "--dry-run", "--skip-check", "--depth-unit", unit)
    assert ("depth: 1 of 1 have a median of 1900 m" in done.output) is is_wrong, done.output
    assert "is not stated" not in done.output


def test_an_import_says_that_the_sensor_is_unknown(tmp_path: Path) -> None:
    read(tmp_path, {"depth": "depth/1.png"}, {"depth_unit_m": 0.001})
    done = run("import", tmp_path, "nowhere", "--dry-run", "--skip-check")
    assert "depth: the sensor of 1 of 1 is not stated, so 5 % of their scale" in done.output


def test_a_topic_of_depths_is_of_a_recording(tmp_path: Path) -> None:
    read(tmp_path, {"depth": "depth/1.png"}, ALL)
    done = run("import", tmp_path, "nowhere", "--dry-run", "--depth-topic", "/depth")
    assert (done.exit_code, "--depth-topic is of a recording" in done.output) == (2, True), done.output
