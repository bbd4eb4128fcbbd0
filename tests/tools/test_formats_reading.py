"""Recognizing layouts, reading cameras.json frame by frame, and writing folders that read back."""

import json
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.layouts import CAMERA, Truth, assert_reads, reasons, truth, write_image, write_layout

from mapless import read_cameras
from mapless.geometry import Camera, RigidTransform
from mapless.lenses import Fisheye, RadialTangential
from mapless_tools.dataset import image_file
from mapless_tools.ingest import FORMATS
from mapless_tools.ingest.formats import read_dataset, recognize
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.ingest.formats.writing import LAYOUTS, PosedImage, image_name
from mapless_tools.output_files import whole_file

TRUTH = truth()


@pytest.mark.parametrize("layout", list(LAYOUTS))
@pytest.mark.parametrize("lens", [None, RadialTangential(0.1, -0.2, k3=0.3), Fisheye(0.1, 0.2, 0.3, 0.4), Fisheye()])
def test_a_layout_that_is_written_is_recognized_and_reads_back(tmp_path: Path, layout: str, lens: Any) -> None:
    planted = Truth(TRUTH.poses, replace(CAMERA, distortion=lens))
    folder = write_layout(tmp_path, layout, planted)
    dataset = read_dataset(folder)
    assert dataset.format == layout
    assert_reads(dataset, planted)


def test_a_folder_of_two_layouts_is_not_guessed_at(tmp_path: Path) -> None:
    write_layout(write_layout(tmp_path, "cameras", TRUTH), "colmap", TRUTH)
    with pytest.raises(ValueError, match="cameras, colmap; name one with --format"):
        read_dataset(tmp_path)
    for layout in ("cameras", "colmap"):
        assert_reads(read_dataset(tmp_path, layout), TRUTH)


def test_folders_without_a_layout_and_layouts_without_a_name(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="no layout that is known"):
        recognize(tmp_path)
    with pytest.raises(ValueError, match="is not a folder"):
        read_dataset(tmp_path / "none")
    with pytest.raises(ValueError, match="not 'bundler'"):
        read_dataset(tmp_path, "bundler")
    for layout in FORMATS:
        with pytest.raises(ValueError, match=str(tmp_path)):
            read_dataset(tmp_path, layout)


def test_cameras_json_keeps_what_is_usable_and_names_the_rest(tmp_path: Path) -> None:
    file = write_layout(tmp_path, "cameras", TRUTH) / "cameras.json"
    content = json.loads(file.read_text())
    good = content["frames"][0]
    left_handed = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()
    content["frames"] += [
        dict(good),
        dict(good, image="../images/0.png"),
        dict(good, image=str(tmp_path / "images" / "0.png")),  # leads into the folder
        dict(good, image="images/none.png"),
        dict(content["frames"][1], image="images/4.png", world_from_camera=left_handed),
        dict(good, image="images/5.png", width=0),
        dict(good, image="images/6.png", split="holdout"),
        dict(good, image="images/7.png", lens="mirror ball"),
        dict(good, image="x" * 5000),
    ]
    for i in range(4, 8):
        write_image(tmp_path / "images" / f"{i}.png", seed=i)
    file.write_text(json.dumps(content))
    dataset = read_dataset(tmp_path)
    assert len(dataset.frames) == 4
    why = list(reasons(dataset).values())
    expected = [
        "named twice",
        "leads out",
        "named twice",
        "no file",
        "reflection",
        "width",
        "split",
        "lens",
        "name too",
    ]
    assert len(why) == len(expected)
    for reason, part in zip(why, expected, strict=True):
        assert part in reason
    assert "frames[4] (images/0.png)" in next(iter(reasons(dataset)))
    with pytest.raises(ValueError, match=r"cameras\.json: frames\[4\].*named twice"):
        read_folder(tmp_path)  # what we wrote ourselves is right, or not ours


def test_backslashes_separate_folders_unless_a_file_is_named_so(tmp_path: Path) -> None:
    file = write_layout(tmp_path / "scene", "cameras", TRUTH) / "cameras.json"
    content = json.loads(file.read_text())
    frames = content["frames"]
    frames[0]["image"] = "images\\0.png"
    frames[1]["image"] = "images\\1.png"
    write_image(file.parent / "images\\1.png", seed=9)
    write_image(tmp_path / "out.png", seed=9)
    frames += [
        dict(frames[0], image=it) for it in ("images/0.png", "..\\out.png", "images\\..\\..\\out.png", "C:\\0.png")
    ]
    file.write_text(json.dumps(content))
    dataset = read_dataset(file.parent)
    images = {it.image_path for it in dataset.frames}
    assert {file.parent / "images" / "0.png", file.parent / "images\\1.png"} <= images
    assert len(images) == 4
    expected = ["named twice", "leads out", "leads out", "no file"]
    assert [part for part, why in zip(expected, reasons(dataset).values(), strict=True) if part in why] == expected
    assert {*read_cameras(file)} >= images


def test_a_folder_with_nothing_usable_says_why_of_the_first(tmp_path: Path) -> None:
    file = write_layout(tmp_path, "cameras", TRUTH) / "cameras.json"
    content = json.loads(file.read_text())
    for frame in content["frames"]:
        del frame["K"]
    file.write_text(json.dumps(content))
    with pytest.raises(ValueError, match=r"none of 4 frames.*frames\[0\].*K is missing"):
        read_dataset(tmp_path)


def test_splits_and_ground_truth_of_cameras_json(tmp_path: Path) -> None:
    file = write_layout(tmp_path, "cameras", TRUTH) / "cameras.json"
    content = json.loads(file.read_text()) | {"ground_truth": "laser scan"}
    for frame, split in zip(content["frames"], ("train", "test", "", "train"), strict=True):
        frame["split"] = split
    file.write_text(json.dumps(content))
    for dataset in (read_dataset(tmp_path), read_folder(tmp_path)):
        assert dataset.ground_truth == "laser scan"
        assert [frame.split for frame in dataset.frames] == ["train", "test", "", "train"]


def test_long_ids_come_back_from_their_file_names(tmp_path: Path) -> None:
    name = image_name("r" * 128, b"\x89PNG")
    write_image(tmp_path / "images" / name)
    text = LAYOUTS["cameras"].files([PosedImage(name, CAMERA, TRUTH.poses[0])], "a test")["cameras.json"]
    (tmp_path / "cameras.json").write_text(text)
    (frame,) = read_dataset(tmp_path).frames
    assert frame.name == "r" * 128


def test_files_are_written_whole_or_not_at_all(tmp_path: Path) -> None:
    for text in ("first", "second, interrupted"):
        with suppress(KeyboardInterrupt), whole_file(tmp_path / "a") as file:
            file.write_text(text)
            if text != "first":
                raise KeyboardInterrupt
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("a", b"first")]


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
    assert [frame.name for frame in frames] == ["images_a", "left_a", "right_a", "frame-000001.color", "_a_b___"]


@pytest.mark.parametrize("named", ["a.jpg", "a", "{root}/images/a.jpg", "{root}/images/a", "a.JPG"])
@pytest.mark.parametrize("there", ["a.JPG", "a.jpg", "a.Jpg"])
def test_an_image_is_found_by_other_cases_and_absolute_paths(tmp_path: Path, named: str, there: str) -> None:
    write_image(tmp_path / "images" / "x.jpg")
    (tmp_path / "images" / "x.jpg").rename(tmp_path / "images" / there)
    found = image_file(tmp_path / "images", named.format(root=tmp_path))
    assert found == tmp_path / "images" / there


@pytest.mark.parametrize("ending", [".jpeg", ".JPEG", ".png", ".PNG", ".webp", ".WEBP"])
def test_a_path_without_an_ending_finds_every_ending(tmp_path: Path, ending: str) -> None:
    (tmp_path / f"a.1{ending}").write_bytes(b"it")
    assert image_file(tmp_path, "a.1").name == f"a.1{ending}"


@pytest.mark.parametrize("named", ["/etc/passwd", "../a.jpg", "images/../../a.jpg", "{root}/../a.jpg"])
def test_a_path_out_of_the_folder_is_refused(tmp_path: Path, named: str) -> None:
    with pytest.raises(ValueError, match="leads out of"):
        image_file(tmp_path, named.format(root=tmp_path))


def test_files_of_one_name_have_the_ids_of_their_folders(tmp_path: Path) -> None:
    names = ["images/cam1/1.png", "images/cam0/1.png", "images/cam0/2.png"]
    for name in names:
        write_image(tmp_path / name)
    write(tmp_path, *(entry(image=name) for name in names))
    assert [frame.name for frame in read_folder(tmp_path).frames] == ["cam1_1", "cam0_1", "2"]
    write(tmp_path, *(entry(image=name) for name in (names[1], names[0])))
    assert [frame.name for frame in read_folder(tmp_path).frames] == ["cam0_1", "cam1_1"]
    write(tmp_path, *(entry(image=name) for name in names[1:]))
    assert [frame.name for frame in read_folder(tmp_path).frames] == ["1", "2"]
