"""COLMAP models, text and binary: the half pixel, every camera model, files that are cut off or damaged."""

import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from support.layouts import CAMERA, Truth, assert_reads, assert_same_camera, reasons, truth, write_image

from mapless.geometry import RigidTransform
from mapless.lenses import Fisheye, RadialTangential
from mapless_tools.ingest.formats import ReadOptions, read_dataset
from mapless_tools.ingest.formats.colmap.cameras import MODEL_NAMES, ColmapCamera

TRUTH = truth()
PINHOLE = (1, 1, 96, 64, (80.0, 81.0, 47.75, 31.25))
"""Camera id, model number, size, parameters: TRUTH's camera, from the corner of the first pixel."""


def cameras_bin(*cameras: tuple[int, int, int, int, tuple[float, ...]]) -> bytes:
    parts = [struct.pack("<Q", len(cameras))]
    for camera_id, model, width, height, parameters in cameras:
        parts.append(struct.pack(f"<IiQQ{len(parameters)}d", camera_id, model, width, height, *parameters))
    return b"".join(parts)


def image_bin(image_id: int, pose: RigidTransform, camera_id: int, name: bytes, observations: int) -> bytes:
    camera_from_world = pose.inverse()
    q = camera_from_world.quaternion()
    head = struct.pack("<I7dI", image_id, q.w, q.x, q.y, q.z, *camera_from_world.translation, camera_id)
    points = b"".join(struct.pack("<ddq", 1.5 * i, 2.5, -1) for i in range(observations))
    return head + name + b"\0" + struct.pack("<Q", observations) + points


def images_bin(poses: tuple[RigidTransform, ...], names: list[str], camera_id: int = 1) -> bytes:
    records = [image_bin(7 * i + 3, pose, camera_id, names[i].encode(), i) for i, pose in enumerate(poses)]
    return struct.pack("<Q", len(records)) + b"".join(records)


def write_binary(folder: Path, planted: Truth = TRUTH) -> Path:
    names = [f"cam0/{i:04d}.png" for i in range(len(planted.poses))]
    for i, name in enumerate(names):
        write_image(folder / "images" / name, seed=i)
    model = folder / "sparse" / "0"
    model.mkdir(parents=True)
    (model / "cameras.bin").write_bytes(cameras_bin(PINHOLE))
    (model / "images.bin").write_bytes(images_bin(planted.poses, names))
    return folder


def write_text(folder: Path, planted: Truth = TRUTH) -> Path:
    names = [f"{i:04d}.png" for i in range(len(planted.poses))]
    for i, name in enumerate(names):
        write_image(folder / "images" / name, seed=i)
    lines = ["# a comment"]
    for i, pose in enumerate(planted.poses):
        camera_from_world = pose.inverse()
        q = camera_from_world.quaternion()
        numbers = [q.w, q.x, q.y, q.z, *camera_from_world.translation.tolist()]
        lines.append(f"{i + 1} {' '.join(map(repr, numbers))} 1 {names[i]}")
        lines.append("" if i % 2 else "10.5 20.5 -1 30.5 40.5 12")
    (folder / "cameras.txt").write_text("# a comment\n1 PINHOLE 96 64 80 81 47.75 31.25\n")
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    return folder


@pytest.mark.parametrize("write", [write_binary, write_text])
def test_planted_poses_and_intrinsics_come_back(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    dataset = read_dataset(write(tmp_path))
    assert_reads(dataset, TRUTH)
    assert (dataset.format, dataset.metric, dataset.ground_truth) == ("colmap", False, "SfM (COLMAP)")


def test_names_in_folders_give_ids_of_the_whole_path(tmp_path: Path) -> None:
    assert [frame.name for frame in read_dataset(write_binary(tmp_path)).frames][:2] == ["cam0_0000", "cam0_0001"]


def test_files_of_rigs_and_frames_beside_a_model_change_nothing(tmp_path: Path) -> None:
    folder = write_binary(tmp_path)
    for name in ("rigs.bin", "frames.bin", "points3D.bin"):
        (folder / "sparse" / "0" / name).write_bytes(b"\0" * 8)
    assert_reads(read_dataset(folder), TRUTH)


def test_hlocs_list_of_queries_is_the_split_even_with_spaces(tmp_path: Path) -> None:
    folder = write_binary(tmp_path)
    images = folder / "sparse" / "0" / "images.bin"
    images.write_bytes(images.read_bytes().replace(b"cam0/0001.png\0", b"cam0/00 1.png\0"))
    (folder / "images" / "cam0" / "0001.png").rename(folder / "images" / "cam0" / "00 1.png")
    (folder / "sparse" / "0" / "list_test.txt").write_text("cam0/00 1.png\r\n\ncam0/0003.png\n")
    dataset = read_dataset(folder)
    tests = [frame.image_path.name for frame in dataset.frames if frame.split == "test"]
    assert (sorted(tests), len(dataset.frames)) == (["00 1.png", "0003.png"], 4)


def test_images_may_lie_anywhere(tmp_path: Path) -> None:
    folder = write_text(tmp_path / "model")
    (folder / "images").rename(tmp_path / "elsewhere")
    with pytest.raises(ValueError, match=r"0000\.png.*--images"):
        read_dataset(folder)
    assert_reads(read_dataset(folder, options=ReadOptions(images=tmp_path / "elsewhere")), TRUTH)
    with pytest.raises(ValueError, match="there is no folder"):
        read_dataset(folder, options=ReadOptions(images=tmp_path / "none"))


@pytest.mark.parametrize(
    ("model", "coefficients", "lens"),
    [
        ("SIMPLE_PINHOLE", (), None),
        ("PINHOLE", (), None),
        ("SIMPLE_RADIAL", (0.1,), RadialTangential(0.1)),
        ("SIMPLE_RADIAL", (0,), None),
        ("RADIAL", (0.1, -0.2), RadialTangential(0.1, -0.2)),
        ("OPENCV", (0.1, -0.2, 0.01, 0.02), RadialTangential(0.1, -0.2, 0.01, 0.02)),
        ("FULL_OPENCV", (0.1, -0.2, 0.01, 0.02, 0.3, 0, 0, 0), RadialTangential(0.1, -0.2, 0.01, 0.02, 0.3)),
        ("OPENCV_FISHEYE", (0.1, -0.2, 0.3, 0.4), Fisheye(0.1, -0.2, 0.3, 0.4)),
        ("SIMPLE_RADIAL_FISHEYE", (0.1,), Fisheye(0.1)),
        ("RADIAL_FISHEYE", (0.1, 0.2), Fisheye(0.1, 0.2)),
        ("SIMPLE_FISHEYE", (), Fisheye()),
        ("FISHEYE", (), Fisheye()),
    ],
)
def test_camera_models_that_are_cameras_of_ours(
    model: str, coefficients: tuple[float, ...], lens: RadialTangential | Fisheye | None
) -> None:
    focals = (80.0,) if model.startswith(("SIMPLE", "RADIAL")) else (80.0, 81.0)
    camera = ColmapCamera(1, model, 96, 64, (*focals, 47.75, 31.25, *coefficients)).camera()
    assert_same_camera(camera, replace(CAMERA, focal_y_px=focals[-1], distortion=lens))


@pytest.mark.parametrize(
    ("model", "count"),
    [("FOV", 5), ("THIN_PRISM_FISHEYE", 12), ("RAD_TAN_THIN_PRISM_FISHEYE", 16), ("DIVISION", 5), ("EUCM", 6)],
)
def test_unknown_camera_models_are_refused_by_name(model: str, count: int) -> None:
    with pytest.raises(ValueError, match=model):
        ColmapCamera(3, model, 96, 64, (80.0,) * count).camera()


def test_a_rational_distortion_is_refused() -> None:
    with pytest.raises(ValueError, match=r"k5 = 0\.1"):
        ColmapCamera(3, "FULL_OPENCV", 96, 64, (80, 81, 47, 31, 0, 0, 0, 0, 0, 0, 0.1, 0)).camera()


def test_the_numbers_of_models_are_colmaps() -> None:
    """As in src/colmap/sensor/models.h of COLMAP 4.2."""
    numbers = {"SIMPLE_PINHOLE": 0, "OPENCV": 4, "OPENCV_FISHEYE": 5, "FULL_OPENCV": 6, "FOV": 7, "RADIAL_FISHEYE": 9}
    numbers |= {"THIN_PRISM_FISHEYE": 10, "RAD_TAN_THIN_PRISM_FISHEYE": 11, "SIMPLE_DIVISION": 12, "FISHEYE": 15}
    assert {name: MODEL_NAMES.index(name) for name in numbers} == numbers


def test_every_cut_of_a_binary_is_noticed_and_named(tmp_path: Path) -> None:
    folder = write_binary(tmp_path)
    for name in ("cameras.bin", "images.bin"):
        file = folder / "sparse" / "0" / name
        whole = file.read_bytes()
        for length in (0, 5, 8, 20, len(whole) // 2, len(whole) - 1):
            file.write_bytes(whole[:length])
            with pytest.raises(ValueError, match=rf"{name}: .*byte \d+.*cut off or damaged"):
                read_dataset(folder)
        file.write_bytes(whole + b"\0\0")
        with pytest.raises(ValueError, match=rf"{name}: end, byte \d+: 2 bytes are left over"):
            read_dataset(folder)
        file.write_bytes(whole)
    assert_reads(read_dataset(folder), TRUTH)


def test_an_unknown_camera_model_number_is_named(tmp_path: Path) -> None:
    folder = write_binary(tmp_path)
    (folder / "sparse" / "0" / "cameras.bin").write_bytes(cameras_bin((1, 99, 96, 64, (80.0,))))
    with pytest.raises(ValueError, match=r"cameras\.bin: camera record 0.*no camera model 99"):
        read_dataset(folder)


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("cameras.txt", "1 PINHOLE 96 64 80 81 47", r"cameras\.txt:1: PINHOLE has parameters fx fy cx cy, found 3"),
        ("cameras.txt", "1 BOX 96 64 80", r"cameras\.txt:1: expected CAMERA_ID"),
        ("cameras.txt", "1 PINHOLE 96 x 80 81 47 31", r"cameras\.txt:1: "),
        ("cameras.txt", "1 PINHOLE 96 64 80 81 47 31\n" * 2, r"cameras\.txt: camera 1 occurs twice"),
        ("images.txt", "1 1 0 0 0 0 0 1 0000.png\n\n", r"images\.txt:1: expected IMAGE_ID"),
        ("images.txt", "1 1 0 0 0 0 y 0 1 0000.png\n\n", r"images\.txt:1: "),
    ],
)
def test_text_that_is_malformed_is_named_with_its_line(tmp_path: Path, file: str, text: str, message: str) -> None:
    folder = write_text(tmp_path)
    (folder / file).write_text(text)
    with pytest.raises(ValueError, match=message):
        read_dataset(folder)


def test_single_images_are_refused_and_the_rest_is_read(tmp_path: Path) -> None:
    folder = write_text(tmp_path)
    (folder / "images" / "0001.png").unlink()
    extra = [
        "8 1 0 0 0 0 0 0 1 ../0000.png\n",
        f"9 1 0 0 0 0 0 0 1 {tmp_path}/images/0000.png\n",
        "10 1 0 0 0 0 0 0 1 0000.png\n",
        "11 0 0 0 0 0 0 0 1 zero.png\n",
        "12 1 0 0 0 nan 0 0 1 nan.png\n",
        "13 1 0 0 0 0 0 0 5 camera.png\n",
    ]
    for name in ("zero", "nan", "camera"):
        write_image(folder / "images" / f"{name}.png", seed=3)
    file = folder / "images.txt"
    file.write_text(file.read_text() + "\n".join(extra) + "\n")
    dataset = read_dataset(folder)
    assert len(dataset.frames) == 3
    why = reasons(dataset)
    assert "there is no file" in why["0001.png"]
    assert "leads out" in why["../0000.png"]
    assert "named twice" in why[f"{tmp_path}/images/0000.png"]  # an absolute path into the folder is one of it
    assert "occurs twice" in why["0000.png"]
    assert "image 11: its pose" in why["zero.png"]
    assert "image 12: its pose" in why["nan.png"]
    assert "no camera 5" in why["camera.png"]


def test_several_models_are_named_rather_than_one_guessed(tmp_path: Path) -> None:
    folder = write_binary(tmp_path)
    (folder / "sparse" / "1").mkdir()
    for name in ("cameras.bin", "images.bin"):
        (folder / "sparse" / "1" / name).write_bytes((folder / "sparse" / "0" / name).read_bytes())
    with pytest.raises(ValueError, match=r"several COLMAP models: .*sparse/0.*sparse/1"):
        read_dataset(folder)
    assert_reads(read_dataset(folder / "sparse" / "1"), TRUTH)
