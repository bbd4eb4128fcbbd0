"""The folder format: what is read back, and what is refused with the frame and the field named."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mapless.geometry import Camera, RadialTangential, RigidTransform
from mapless_tools.ingest.formats.cameras import read_folder


def entry(**changed: Any) -> dict[str, Any]:
    good = {
        "image": "images/a.jpg",
        "width": 64,
        "height": 48,
        "K": [[50, 0, 31.5], [0, 51, 23.5], [0, 0, 1]],
        "dist": None,
        "world_from_camera": np.eye(4).tolist(),
    }
    return {**good, **changed}


def write(folder: Path, *frames: object, **about: object) -> Path:
    (folder / "images").mkdir(exist_ok=True)
    (folder / "images" / "a.jpg").write_bytes(b"not opened")
    (folder / "cameras.json").write_text(json.dumps({**about, "frames": frames}))
    return folder


def test_a_frame_is_read_as_it_is_written(tmp_path: Path) -> None:
    pose = RigidTransform.from_matrix([[0.0, -1.0, 0.0, 1.5], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.25]])
    dataset = read_folder(write(tmp_path, entry(world_from_camera=pose.matrix().tolist()), source="a test"))
    assert (dataset.metric, dataset.source, dataset.name) == (True, "a test", tmp_path.name)
    (frame,) = dataset.frames
    assert frame.camera == Camera(64, 48, 50.0, 51.0, 31.5, 23.5)
    assert (frame.name, frame.image_path) == ("a", tmp_path / "images" / "a.jpg")
    np.testing.assert_allclose(frame.world_from_camera.matrix(), pose.matrix(), atol=1e-12)


@pytest.mark.parametrize("count", [4, 5])
def test_distortion_with_four_and_five_coefficients(tmp_path: Path, count: int) -> None:
    dist = [0.1, -0.2, 0.001, -0.002, 0.05][:count]
    (frame,) = read_folder(write(tmp_path, entry(dist=dist), metric=False)).frames
    assert frame.camera.distortion == RadialTangential(*dist)


@pytest.mark.parametrize(
    ("changed", "field"),
    [
        ({"image": 3}, "image"),
        ({"image": "images/none.jpg"}, "image"),
        ({"width": "64"}, "width"),
        ({"height": 0}, "height"),
        ({"K": [[50, 0], [0, 50]]}, "K"),
        ({"K": [[50, 1, 31], [0, 50, 23], [0, 0, 1]]}, "K"),
        ({"K": [["x", 0, 31], [0, 50, 23], [0, 0, 1]]}, "K"),
        ({"width": 10**400}, "width"),
        ({"K": [[10**400, 0, 31], [0, 50, 23], [0, 0, 1]]}, "K"),
        ({"dist": [10**400, 0, 0, 0]}, "dist"),
        ({"K": [[-50, 0, 31], [0, 50, 23], [0, 0, 1]]}, "K"),
        ({"dist": [1, 2, 3]}, "dist"),
        ({"dist": [1, 2, 3, float("nan")]}, "dist"),
        ({"world_from_camera": np.diag([1, 1, 2, 1]).tolist()}, "world_from_camera"),
        ({"world_from_camera": None}, "world_from_camera"),
    ],
)
def test_names_the_frame_and_the_field(tmp_path: Path, changed: dict[str, Any], field: str) -> None:
    with pytest.raises(ValueError, match=rf"frames\[1\].*{field}"):
        read_folder(write(tmp_path, entry(), entry(**changed)))


def test_refuses_a_folder_without_frames(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"cameras\.json cannot be read"):
        read_folder(tmp_path)
    with pytest.raises(ValueError, match="at least one frame"):
        read_folder(write(tmp_path))
    (tmp_path / "cameras.json").write_text("{")
    with pytest.raises(ValueError, match="not JSON"):
        read_folder(tmp_path)
    with pytest.raises(ValueError, match=r"frames\[0\].*object"):
        read_folder(write(tmp_path, 7))


def test_names_are_legal_and_unique(tmp_path: Path) -> None:
    images = ["images/a.jpg", "left/a.jpg", "right/a.jpg", "left/frame-000001.color.jpg", "left/.a b..é-.png"]
    for image in images:
        (tmp_path / image).parent.mkdir(exist_ok=True)
        (tmp_path / image).write_bytes(b"not opened")
    frames = read_folder(write(tmp_path, *(entry(image=image) for image in images))).frames
    assert [frame.name for frame in frames] == ["a", "a_2", "a_3", "frame-000001.color", "_a_b___"]
