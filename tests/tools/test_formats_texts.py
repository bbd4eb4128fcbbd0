"""Folders whose text files an editor has written again: byte order marks, CRLF, comments, other encodings."""

import re
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import pytest
from support.images import textured
from support.layouts import (
    CAMERA,
    reasons,
    truth,
    write_cambridge,
    write_image,
    write_layout,
    write_seven_scenes,
    write_twelve_scenes,
)

from mapless_tools.dataset import Dataset
from mapless_tools.ingest.formats import Intrinsics, ReadOptions, read_dataset
from mapless_tools.ingest.formats.writing import LAYOUTS

TRUTH = truth()
SHOTS = [(textured(96, 64, seed=i), pose) for i, pose in enumerate(TRUTH.poses)]
TEXTS = (".txt", ".json", ".nvm")
INTRINSICS = Intrinsics(CAMERA.focal_x_px, CAMERA.focal_y_px, CAMERA.principal_x_px, CAMERA.principal_y_px)


def write_tum(folder: Path) -> Path:
    rgb, rows = ["# time path"], ["# time tx ty tz qx qy qz qw"]
    for i, pose in enumerate(TRUTH.poses):
        write_image(folder / "rgb" / f"{i}.png", seed=i)
        q = pose.quaternion()
        rgb.append(f"{i}.0 rgb/{i}.png")
        rows.append(" ".join(map(repr, [float(i), *pose.translation.tolist(), q.x, q.y, q.z, q.w])))
    (folder / "rgb.txt").write_text("\n".join(rgb))
    (folder / "groundtruth.txt").write_text("\n".join(rows))
    return folder


WRITERS: dict[str, Callable[[Path], Path]] = {
    **{layout: partial(write_layout, layout=layout, planted=TRUTH) for layout in LAYOUTS},
    "tum": write_tum,
    "7scenes": lambda folder: write_seven_scenes(folder / "chess", SHOTS[:2], SHOTS[2:]),
    "12scenes": lambda folder: write_twelve_scenes(folder / "apt" / "room", CAMERA, SHOTS[:1], SHOTS[1:]),
    "cambridge": lambda folder: write_cambridge(folder, SHOTS[:2], SHOTS[2:], [70, 71, 72, 73]),
}


def texts(folder: Path) -> Iterator[Path]:
    return (file for file in folder.rglob("*") if file.suffix in TEXTS)


def read(folder: Path) -> Dataset:
    return read_dataset(folder, options=ReadOptions(intrinsics=INTRINSICS))


@pytest.mark.parametrize("layout", list(WRITERS))
@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16"])
def test_folders_that_an_editor_marked_are_read_alike(tmp_path: Path, layout: str, encoding: str) -> None:
    folder = WRITERS[layout](tmp_path)
    before = read(folder)
    for file in texts(folder):
        file.write_bytes(file.read_text().replace("\n", "\r\n").encode(encoding))
    after = read(folder)
    assert before.refused == after.refused == ()
    for one, other in zip(before.frames, after.frames, strict=True):
        assert (one.name, one.camera, one.split) == (other.name, other.camera, other.split)
        assert (one.world_from_camera.matrix() == other.world_from_camera.matrix()).all()


@pytest.mark.parametrize("layout", [it for it in WRITERS if it not in ("cameras", "nerf")])
def test_trailing_spaces_and_comments_change_nothing(tmp_path: Path, layout: str) -> None:
    folder = WRITERS[layout](tmp_path)
    before = read(folder)
    for file in texts(folder):
        lines = file.read_text().splitlines()
        if not file.name.endswith(".pose.txt") and layout != "cambridge":
            lines.insert(0, "  # a comment")
        file.write_text("".join(f"{line} \t\n" for line in lines))
    assert [frame.name for frame in read(folder).frames] == [frame.name for frame in before.frames]


def test_a_name_in_latin_1_is_named_with_file_and_line(tmp_path: Path) -> None:
    folder = write_layout(tmp_path, "colmap", TRUTH)
    (file,) = folder.rglob("images.txt")
    lines = file.read_bytes().splitlines()
    number = next(i for i, line in enumerate(lines) if line.endswith(b" 2.png"))
    lines[number] = lines[number].replace(b"2.png", b"r\xe9f.png")
    file.write_bytes(b"\n".join(lines))
    with pytest.raises(ValueError, match=rf"images\.txt:{number + 1}: is not text in UTF-8"):
        read_dataset(folder)


def test_images_without_empty_second_lines_are_an_error(tmp_path: Path) -> None:
    folder = write_layout(tmp_path, "colmap", TRUTH)
    (file,) = folder.rglob("images.txt")
    lines = [line for line in file.read_text().splitlines() if line and not line.startswith("#")]
    file.write_text("\n".join(lines))
    says = r"images\.txt:2: expected the points of the image of line 1, .* found ten words that are an image"
    with pytest.raises(ValueError, match=says):
        read_dataset(folder)


@pytest.mark.parametrize("points", ["1.5 2.5", "1.5 2.5 x", "1.5 2.5 0.5", "# none"])
def test_second_lines_that_are_no_points_are_an_error(tmp_path: Path, points: str) -> None:
    folder = write_layout(tmp_path, "colmap", TRUTH)
    (file,) = folder.rglob("images.txt")
    file.write_text(re.sub(r"1\.png\n\n", f"1.png\n{points}\n", file.read_text()))
    with pytest.raises(ValueError, match="expected the points of the image of line"):
        read_dataset(folder)


def test_a_count_that_a_comment_announces_is_compared(tmp_path: Path) -> None:
    folder = write_layout(tmp_path, "colmap", TRUTH)
    (file,) = folder.rglob("images.txt")
    lines = "\n".join(line for line in file.read_text().splitlines() if not line.startswith("#"))
    file.write_text(f"# Number of images: 4, mean observations per image: 0\n{lines}\n")
    assert read_dataset(folder).notes == ()
    file.write_text(f"# Number of images: 9, mean observations per image: 0\n{lines}\n")
    (note,) = read_dataset(folder).notes
    assert "images.txt announces 9 in its comments, and holds 4" in note


def test_cambridge_without_the_header_loses_no_pose(tmp_path: Path) -> None:
    folder = write_cambridge(tmp_path, SHOTS[:2], SHOTS[2:], [70, 71, 72, 73])
    file = folder / "dataset_train.txt"
    file.write_text("\n".join(file.read_text().splitlines()[3:]))
    assert len(read_dataset(folder).frames) == 4


def test_a_reconstruction_with_more_cameras_than_it_says(tmp_path: Path) -> None:
    folder = write_cambridge(tmp_path, SHOTS[:2], SHOTS[2:], [70, 71, 72, 73])
    file = folder / "reconstruction.nvm"
    file.write_text(file.read_text().replace("\n4\n", "\n3\n"))
    with pytest.raises(ValueError, match="another camera, 3 are announced"):
        read_dataset(folder)
    assert reasons(read(folder)) == {}
