"""Cameras and poses from files: what is written is read, and what is wrong is named."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import json_format
from support.images import encode

from mapless import Camera, RadialTangential, read_camera, read_cameras, read_pose, wire
from mapless.geometry import RigidTransform, rotation_from_vector

CAMERA = Camera(640, 480, 500.0, 501.0, 319.0, 239.0, RadialTangential(0.1, 0.2, 0.3, 0.4, 0.5))


def test_a_camera_and_a_pose_as_the_interface_writes_them(tmp_path: Path) -> None:
    text = json_format.MessageToJson(wire.camera_to_message(CAMERA))
    (tmp_path / "camera.json").write_text(text)
    assert read_camera(text) == read_camera(tmp_path / "camera.json") == CAMERA
    pose = RigidTransform(rotation_from_vector([0.1, 0.2, 0.3]), np.array([1.0, 2.0, 3.0]))
    read = read_pose(json_format.MessageToJson(wire.transform_to_message(pose)))
    np.testing.assert_allclose(read.matrix(), pose.matrix(), atol=1e-12)


def test_four_numbers_take_the_size_of_the_photograph(tmp_path: Path) -> None:
    photo = tmp_path / "photo.jpg"
    photo.write_bytes(encode(".jpg", np.zeros((480, 640, 3), np.uint8)))
    assert read_camera("500,501,319,239", photo) == Camera(640, 480, 500.0, 501.0, 319.0, 239.0)
    with pytest.raises(ValueError, match="needs a photograph"):
        read_camera("500,501,319,239")
    with pytest.raises(ValueError, match="focal_x_px"):
        read_camera("-500,501,319,239", photo)


def frame(**changes: Any) -> dict[str, Any]:
    k = [[500.0, 0, 319.0], [0, 501.0, 239.0], [0, 0, 1]]
    return {"image": "images/a.jpg", "width": 640, "height": 480, "K": k, "dist": [0.1, 0.2, 0.3, 0.4, 0.5]} | changes


def test_the_cameras_of_a_folder(tmp_path: Path) -> None:
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"frames": [frame(), frame(image="b.jpg", dist=None)]}))
    assert read_cameras(file) == {tmp_path / "images" / "a.jpg": CAMERA, tmp_path / "b.jpg": CAMERA.pinhole()}


@pytest.mark.parametrize("wrong", [{"K": [[1]]}, {"width": 3}, {"dist": [1, 2, 3, 4, 5, 6]}, {"image": None}])
def test_a_frame_that_is_none_is_named(tmp_path: Path, wrong: dict[str, Any]) -> None:
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps({"frames": [frame(), frame(**wrong)]}))
    with pytest.raises(ValueError, match=r"cameras.json: frames\[1\]"):
        read_cameras(file)


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"frames": 3}', "nonsense"])
def test_a_file_that_is_none_is_named(tmp_path: Path, text: str) -> None:
    file = tmp_path / "cameras.json"
    file.write_text(text)
    with pytest.raises(ValueError, match=r"cameras.json: no cameras"):
        read_cameras(file)


@pytest.mark.parametrize("fov_deg", [20.0, 66.0, 120.0])
def test_edges_of_a_camera_span_its_field_of_view(fov_deg: float) -> None:
    camera = Camera.from_fov(640, 480, fov_deg)
    left, right = camera.rays([[-0.5, 239.5], [639.5, 239.5]])
    assert math.degrees(math.atan(right[0]) - math.atan(left[0])) == pytest.approx(fov_deg)
    assert left[1] == right[1] == 0
    with pytest.raises(ValueError, match="horizontal_fov_deg"):
        Camera.from_fov(640, 480, 180)
