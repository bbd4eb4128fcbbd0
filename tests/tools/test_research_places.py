"""Scenes of a folder, those of other places, turned rasters, and the list and tables of doubtful photographs."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from mapless import Camera, RadialTangential, RigidTransform
from mapless.geometry import rotation_from_vector
from mapless_tools.output_files import write_json
from research.contradictions.cases import quarter_turn
from research.doubt.cases import doubtful, write_list
from research.doubt.tables import by, by_turn
from research.evidence.turning import turned, turned_pixels
from research.other_places import crossed
from research.places import Scenes, own_and_other

LENS = RadialTangential(-0.1, 0.02, 0.001, -0.002)
CAMERA = Camera(160, 120, 150.0, 160.0, 76.0, 63.0, LENS)
POSE = RigidTransform(rotation_from_vector([0.1, 0.2, 0.3]), np.array([0.1, 0.0, 0.2]))
X_IN_WORLD = POSE.apply([[0.6, -0.4, 3.0], [-0.9, 0.5, 3.0], [0.7, 0.6, 2.5]])


def dots(pixels: np.ndarray, camera: Camera) -> np.ndarray:
    """An image (H, W, 1) with a smooth dot around each pixel."""
    columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    squared = [(columns - x) ** 2 + (rows - y) ** 2 for x, y in pixels]
    brightness = (255 * np.exp(-np.array(squared) / 8).sum(axis=0)).round().clip(0, 255)
    return np.asarray(brightness[..., None], np.uint8)


@pytest.mark.parametrize("angle_deg", [0, 30, 45, 90, 135, 180, -70])
def test_turned_raster_shows_points_where_its_camera_does(angle_deg: int) -> None:
    image = dots(CAMERA.project(POSE.inverse().apply(X_IN_WORLD)), CAMERA)
    camera, pose = turned(CAMERA, POSE, angle_deg)
    raster = turned_pixels(image, CAMERA, angle_deg)
    assert raster.shape[:2] == (camera.height_px, camera.width_px)
    for x, y in camera.project(pose.inverse().apply(X_IN_WORLD)):
        left, top = round(x) - 8, round(y) - 8
        patch = raster[top : top + 17, left : left + 17].astype(float)
        rows, columns = np.indices(patch.shape)
        centre = np.array([(columns * patch).sum(), (rows * patch).sum()]) / patch.sum() + [left, top]
        assert np.abs(centre - [x, y]).max() < 0.1


def test_quarter_turns_keep_the_pixels_of_a_square_pinhole() -> None:
    camera, pose = Camera(16, 10, 20.0, 20.0, 7.3, 4.1), POSE
    image = np.random.default_rng(1).integers(0, 256, (10, 16, 3), dtype=np.uint8)
    for quarters in range(4):
        found_camera, found_pose = turned(Camera(16, 10, 20.0, 20.0, 7.3, 4.1), POSE, 90 * quarters)
        assert np.array_equal(
            turned_pixels(image, Camera(16, 10, 20.0, 20.0, 7.3, 4.1), 90 * quarters), np.rot90(image, quarters)
        )
        assert np.allclose(found_camera.matrix(), camera.matrix(), atol=1e-5)
        assert np.allclose(found_pose.rotation, pose.rotation)
        camera, pose = quarter_turn(camera, pose)


def test_corners_that_the_photograph_does_not_show_are_black() -> None:
    raster = turned_pixels(np.full((120, 160, 1), 200, np.uint8), CAMERA, 45)
    assert raster[[0, 0, -1, -1], [0, -1, 0, -1]].max() == 0
    assert raster[raster.shape[0] // 2, raster.shape[1] // 2] == 200


def planted_folder(folder: Path, name: str, count: int = 6) -> None:
    (folder / name / "images").mkdir(parents=True)
    frames = []
    for i in range(count):
        cv2.imwrite(str(folder / name / f"images/{i}.png"), np.zeros((4, 4), np.uint8))
        k = [[5, 0, 1.5], [0, 5, 1.5], [0, 0, 1]]
        pose = RigidTransform(np.eye(3), np.array([0.1 * i, 0, 0])).matrix().tolist()
        frames.append({"image": f"images/{i}.png", "width": 4, "height": 4, "K": k, "world_from_camera": pose})
    write_json(folder / name / "cameras.json", {"frames": frames, "metric": True})


def test_crossed_scenes_are_never_of_one_place(tmp_path: Path) -> None:
    for name in ("shelf", "depth/tum-teddy", "tum-fr3-office"):
        planted_folder(tmp_path, name)
    scenes = Scenes(tmp_path)
    assert scenes.names == ["depth/tum-teddy", "shelf", "tum-fr3-office"]
    pairs = crossed(scenes, 4)
    assert len(set(pairs)) == 4
    assert {frozenset(it) for it in pairs} == {frozenset(("shelf", it)) for it in ("depth/tum-teddy", "tum-fr3-office")}
    assert len(crossed(scenes, 10)) == 10
    assert scenes.present([("shelf", 1), ("absent", 2)]) == [("shelf", 1)]


def test_a_place_is_asked_with_photographs_of_its_own_and_another(tmp_path: Path) -> None:
    for name in ("hall", "shelf"):
        planted_folder(tmp_path, name, 9)
    (hall, shelf) = own_and_other(Scenes(tmp_path), 2)
    for (name, place, own, others), other in ((hall, "shelf"), (shelf, "hall")):
        assert len(place.reference_frames) == 5
        assert len(own) == 2
        assert not {it.image_path for it in own} & {it.image_path for it in place.reference_frames}
        assert [name in str(it.image_path) for it in own] == [True, True]
        assert [f"/{other}/" in str(it.image_path) for it in others] == [True]


def test_list_names_what_was_expensive_and_is_asked_again(tmp_path: Path) -> None:
    planted_folder(tmp_path, "shelf")
    rows = [
        {"folder": "shelf", "references_stored": 3, "photograph": name, "processor_s": spent_s}
        for name, spent_s in (("1", 2.5), ("3", 1.5), ("4", 9.0))
    ]
    write_list(rows, tmp_path / "list.json")
    asked = list(doubtful(Scenes(tmp_path), tmp_path / "list.json"))
    assert [(it.case.name, it.fields["references_stored"]) for it in asked] == [
        ("1 in shelf-3", 3),
        ("4 in shelf-3", 3),
    ]
    write_list([rows[0] | {"photograph": "gone"}], tmp_path / "list.json")
    with pytest.raises(ValueError, match="shelf has no photograph gone"):
        list(doubtful(Scenes(tmp_path), tmp_path / "list.json"))


def turned_row(photograph: str, angle_deg: int, outcome: str, processor_s: float) -> dict[str, Any]:
    return {
        "folder": "shelf",
        "photograph": photograph,
        "angle_deg": angle_deg,
        "outcome": outcome,
        "processor_s": processor_s,
        "attempts": [{}],
    }


def test_turned_photographs_are_compared_with_themselves_upright() -> None:
    rows = [turned_row("a", 0, "right", 0.5), turned_row("b", 0, "LOW_OVERLAP", 9.0), turned_row("c", 0, "right", 1.0)]
    rows += [turned_row("a", 90, "right", 1.0), turned_row("b", 90, "right", 1.0), turned_row("c", 90, "wrong", 4.0)]
    assert by_turn(rows, "angle_deg")[2:] == [
        "| 0 | 2 | 2 (100 %) | 0 | 0 | 0.75 | 0.97 | 1.00 | 1.00 |",
        "| 90 | 2 | 1 (50 %) | 1 | 0 | 2.50 | 3.85 | 3.00 | 3.33 |",
    ]
    assert by("degrees", lambda row: row["angle_deg"], rows)[-1] == "| all | 6 | 4 | 1 | 1 | 1.00 | 7.75 | 1.0 |"
