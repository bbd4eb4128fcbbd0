"""Depth in the layouts of others: the planted surface comes out in metres, and what is unusable is left out."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from support.depth_layouts import LAYOUTS, TRUTH, colmap_map, write_exr
from support.depths import assert_planted, planted_depth_m, png
from support.images import textured
from support.layouts import CAMERA, assert_same_pose

from mapless.depth import DepthSensor
from mapless_tools.ingest.depth_options import DepthOptions
from mapless_tools.ingest.formats import ReadOptions, read_dataset
from mapless_tools.ingest.formats.colmap.depth_maps import MAX_PIXELS

ALL = pytest.mark.parametrize("layout", LAYOUTS)


def depth_file(folder: Path) -> Path:
    """The depth that a written layout has."""
    dataset = read_dataset(folder)
    assert dataset.frames[0].depth is not None
    return dataset.frames[0].depth.path


@ALL
def test_the_planted_surface_comes_out_in_metres(tmp_path: Path, layout: str) -> None:
    dataset = read_dataset(LAYOUTS[layout](tmp_path))
    assert (dataset.format, len(dataset.frames), dataset.refused) == (layout, 2, ())
    first, second = dataset.frames
    assert_planted(first)
    assert second.depth is None
    for frame, pose in zip(dataset.frames, TRUTH.poses, strict=True):
        assert_same_pose(frame.world_from_camera, pose)
    assert "depth: 1 of 2 photographs have one" in dataset.notes


@ALL
@pytest.mark.parametrize("wrong", ["truncated", "8 bits", "another aspect", "no value", "empty", "text"])
def test_unusable_depth_is_left_out_with_a_note(tmp_path: Path, layout: str, wrong: str) -> None:
    folder = LAYOUTS[layout](tmp_path)
    file = depth_file(folder)
    whole = file.read_bytes()
    contents = {
        "truncated": whole[: len(whole) // 2],
        "8 bits": png(np.ones((48, 64), np.uint8)),
        "another aspect": png(np.ones((70, 50), np.uint16)),
        "no value": png(np.zeros((64, 96), np.uint16)),
        "empty": b"",
        "text": b"depth",
    }
    file.write_bytes(contents[wrong])
    dataset = read_dataset(folder)
    assert (len(dataset.frames), dataset.refused) == (2, ())
    assert all(frame.depth is None for frame in dataset.frames)
    assert any(file.name in note and "left out" in note for note in dataset.notes)


@ALL
def test_no_depth_leaves_depth_out_without_a_note(tmp_path: Path, layout: str) -> None:
    dataset = read_dataset(LAYOUTS[layout](tmp_path), options=ReadOptions(depths=DepthOptions(no_depth=True)))
    assert [frame.depth for frame in dataset.frames] == [None, None]
    assert not any("depth" in note and "photographs have" in note for note in dataset.notes)


def test_sensor_and_unit_that_are_given_replace_the_layouts(tmp_path: Path) -> None:
    options = ReadOptions(depths=DepthOptions(depth_sensor="stereo", depth_unit=0.002))
    depth = read_dataset(LAYOUTS["icl"](tmp_path), options=options).frames[0].depth
    assert depth is not None
    assert (depth.sensor, depth.unit_m) == (DepthSensor.STEREO, 0.002)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"depth_sensor": "sonar"}, "phone_lidar"),
        ({"depth_unit": 0.0}, "--depth-unit"),
        ({"no_depth": True, "depth_unit": 0.001}, "one of them"),
    ],
)
def test_wrong_options_of_depth_are_named(options: dict[str, str | float | bool], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        DepthOptions(**options)  # type: ignore[arg-type]


def test_twelve_scenes_without_a_depth_camera_has_no_depth(tmp_path: Path) -> None:
    room = LAYOUTS["12scenes"](tmp_path)
    text = (room / "info.txt").read_text()
    (room / "info.txt").write_text(text.replace("m_calibrationDepthIntrinsic", "m_other"))
    dataset = read_dataset(room)
    assert [frame.depth for frame in dataset.frames] == [None, None]
    assert any("m_calibrationDepthIntrinsic is missing" in note for note in dataset.notes)


def test_twelve_scenes_of_colour_in_depth_is_turned_round(tmp_path: Path) -> None:
    room = LAYOUTS["12scenes"](tmp_path)
    lines = (room / "info.txt").read_text().splitlines()
    at = {line.split(" = ")[0]: i for i, line in enumerate(lines)}
    colour, depth = (at[f"m_calibration{it}Extrinsic"] for it in ("Color", "Depth"))
    matrix = np.array(lines[depth].split(" = ")[1].split(), float).reshape(4, 4)
    inverse = " ".join(map(repr, np.linalg.inv(matrix).ravel().tolist()))
    lines[depth] = lines[colour].replace("Color", "Depth")
    lines[colour] = f"m_calibrationColorExtrinsic = {inverse}"
    (room / "info.txt").write_text("\n".join(lines))
    assert_planted(read_dataset(room).frames[0])


def test_icl_photographs_without_a_pose_are_refused(tmp_path: Path) -> None:
    folder = LAYOUTS["icl"](tmp_path)
    file = folder / "livingRoom0.gt.freiburg"
    file.write_text(file.read_text().splitlines()[0] + "\n")
    dataset = read_dataset(folder)
    assert (len(dataset.frames), len(dataset.refused)) == (1, 1)


def test_large_maps_of_colmap_are_reduced(tmp_path: Path) -> None:
    """Values stay those of the pixels in the middle of the new ones, to half a pixel."""
    folder = LAYOUTS["colmap"](tmp_path)
    large = CAMERA.resized(1440, 960)
    depth_file(folder).write_bytes(colmap_map(planted_depth_m(large)))
    depth = read_dataset(folder).frames[0].depth
    assert depth is not None
    image = depth.read()
    assert image.size is not None
    width, height = image.size
    assert 0.98 * MAX_PIXELS < width * height <= MAX_PIXELS
    values = np.frombuffer(image.data, "<f4").reshape(height, width)
    np.testing.assert_allclose(values, planted_depth_m(CAMERA.resized(width, height)), rtol=0.003)


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "does not begin"),
        (b"48x32x1x", "does not begin"),
        (b"48&32&3&" + bytes(3 * 4 * 48 * 32), "3 channels"),
        (b"48&32&1&" + bytes(100), "100 bytes are there"),
        (b"0&0&1&", "0x0 values"),
        (b"999999&999999&1&", "999999x999999 values"),
        (b"48&32&1&" + np.full((32, 48), np.nan, "<f4").tobytes(), "no pixel"),
        (b"48&32&1&" + np.full((32, 48), -1.0, "<f4").tobytes(), "below 0"),
    ],
)
def test_what_is_no_map_of_colmap_is_left_out(tmp_path: Path, content: bytes, said: str) -> None:
    folder = LAYOUTS["colmap"](tmp_path)
    depth_file(folder).write_bytes(content)
    dataset = read_dataset(folder)
    assert dataset.frames[0].depth is None
    assert any(said in note for note in dataset.notes)


def test_colmaps_library_writes_what_we_read(tmp_path: Path) -> None:
    pycolmap = pytest.importorskip("pycolmap")
    folder = LAYOUTS["colmap"](tmp_path)
    depth = planted_depth_m(CAMERA.resized(48, 32)).astype(np.float32)
    depth[0, 0] = 0
    pycolmap.DepthMap.from_array(depth, 0.1, 10.0).write(depth_file(folder))
    assert_planted(read_dataset(folder).frames[0])


@pytest.mark.parametrize(
    ("table", "line", "said"),
    [
        ("records_depth", "noon, reg, 0.depth.reg", "noon"),
        ("records_depth", "0, other, 0.depth.reg", "no depth sensor"),
        ("records_depth", "0, reg, ../../0.depth.reg", "leads out of"),
        ("records_depth", "0, reg, 1.depth.reg", "there is no file"),
        ("sensors", "reg, , depth, EUCM, 96, 64, 80, 81, 48, 32, 0.5, 1", "EUCM"),
        ("rigs", "rig, other, 1, 0, 0, 0, 0, 0, 0", "has none of 'reg'"),
    ],
)
def test_kaptures_that_contradict_themselves_lose_the_depth(tmp_path: Path, table: str, line: str, said: str) -> None:
    folder = LAYOUTS["kapture"](tmp_path)
    for name in ("records_depth", table):
        file = folder / "sensors" / f"{name}.txt"
        kept = [it for it in file.read_text().splitlines() if "raw" not in it or name == "sensors"]
        if name == table:
            kept = [*(it for it in kept if "reg" not in it), line]
        file.write_text("\n".join(kept) + "\n")
    dataset = read_dataset(folder)
    assert [frame.depth for frame in dataset.frames] == [None, None]
    assert any(said in note for note in dataset.notes), dataset.notes


def test_of_several_depths_of_kapture_the_nearest_is_taken(tmp_path: Path) -> None:
    folder = LAYOUTS["kapture"](tmp_path)
    assert depth_file(folder).name == "0.depth.reg"
    records = folder / "sensors" / "records_depth.txt"
    records.write_text("0, raw, 0.depth\n")
    assert depth_file(folder).name == "0.depth"
    assert_planted(read_dataset(folder).frames[0])


def test_half_floats_of_record3d_are_metres(tmp_path: Path) -> None:
    """1 mm at 1 to 2 m, 2 mm beyond."""
    folder = LAYOUTS["record3d"](tmp_path)
    depth = planted_depth_m(CAMERA.resized(48, 32))
    depth[0, 0] = 0
    write_exr(folder / "depth" / "0.exr", {"R": depth.astype(np.float16)})
    assert_planted(read_dataset(folder).frames[0], 0.002)


def test_an_exr_with_colours_is_no_depth(tmp_path: Path) -> None:
    folder = LAYOUTS["record3d"](tmp_path)
    depth = planted_depth_m(CAMERA.resized(48, 32)).astype(np.float32)
    write_exr(folder / "depth" / "0.exr", {"R": depth, "A": depth})
    dataset = read_dataset(folder)
    assert dataset.frames[0].depth is None
    assert any("channels A, R" in note for note in dataset.notes)


def test_record3d_without_intrinsics_per_frame_has_k(tmp_path: Path) -> None:
    folder = LAYOUTS["record3d"](tmp_path)
    content = json.loads((folder / "metadata.json").read_text())
    del content["perFrameIntrinsicCoeffs"]
    content["K"] = [80.0, 0, 0, 0, 81.0, 0, 47.75, 31.25, 1]
    (folder / "metadata.json").write_text(json.dumps(content))
    assert_planted(read_dataset(folder).frames[0])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"poses": []}, "none of 0"),
        ({"poses": [[0, 0, 0, 1, 0, 0]] * 3}, r"poses\[0\] must be 7 numbers"),
        ({"w": 64, "h": 96}, "w and h are 64x96, the image is 96x64"),
        ({"w": None}, "w and h"),
        ({"perFrameIntrinsicCoeffs": None, "K": None}, "K must be"),
        ({"poses": None}, "poses must be a list"),
    ],
)
def test_wrong_metadata_of_record3d_is_named(tmp_path: Path, change: dict[str, object], said: str) -> None:
    folder = LAYOUTS["record3d"](tmp_path)
    content = json.loads((folder / "metadata.json").read_text())
    (folder / "metadata.json").write_text(json.dumps(content | change))
    with pytest.raises(ValueError, match=said):
        read_dataset(folder)


def test_files_of_record3d_name_the_export_that_is_read(tmp_path: Path) -> None:
    (tmp_path / "scan.r3d").write_bytes(b"PK")
    with pytest.raises(ValueError, match="EXR"):
        read_dataset(tmp_path / "scan.r3d")


@pytest.mark.parametrize(
    ("file", "content", "said"),
    [
        ("odometry.csv", "timestamp, frame, x, y\n0, 0, 0, 0\n", "z, qx, qy, qz, qw is missing"),
        ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n0, 0, 0\n", "csv:2: expected 9 values"),
        ("odometry.csv", "timestamp, frame, x, y, z, qx, qy, qz, qw\n0, 0, 0, 0, 0, 0, 0, 0, nan\n", "not finite"),
        ("camera_matrix.csv", "1, 2\n3, 4\n", "K must be 3x3"),
        ("camera_matrix.csv", "1600, 0, 960\n0, 1600, 720\n0, 0, 1\n", "not near the middle"),
        ("rgb.mp4", "", "it is empty"),
    ],
)
def test_what_is_wrong_with_all_of_stray_scanner_is_named(tmp_path: Path, file: str, content: str, said: str) -> None:
    folder = LAYOUTS["stray"](tmp_path)
    (folder / file).write_text(content)
    with pytest.raises(ValueError, match=said):
        read_dataset(folder)


def test_stray_scanner_may_have_intrinsics_per_frame(tmp_path: Path) -> None:
    folder = LAYOUTS["stray"](tmp_path)
    header, *rows = (folder / "odometry.csv").read_text().splitlines()
    rows = [f"{row}, 90.0, 91.0, 48.5, 32.5" for row in rows]
    (folder / "odometry.csv").write_text("\n".join([f"{header}, fx, fy, cx, cy", *rows]))
    camera = read_dataset(folder).frames[1].camera
    assert (camera.focal_x_px, camera.focal_y_px, camera.principal_x_px) == (90.0, 91.0, 48.0)


def test_frames_of_stray_scanner_are_joined_by_number(tmp_path: Path) -> None:
    """The third frame of the video is the second of the odometry."""
    folder = LAYOUTS["stray"](tmp_path)
    dataset = read_dataset(folder)
    assert [frame.name for frame in dataset.frames] == ["000000", "000002"]
    shown = [np.asarray(cv2.imread(str(frame.image_path)), float) for frame in dataset.frames]
    off = [[np.abs(it[..., ::-1] - textured(seed=seed)).mean() for seed in range(3)] for it in shown]
    assert np.argmin(off, axis=1).tolist() == [0, 2]


def test_a_depth_camera_too_far_from_the_photographs_is_left_out(tmp_path: Path) -> None:
    """A server would refuse the reference: it is more than 1 m off."""
    room = LAYOUTS["12scenes"](tmp_path)
    far = np.eye(4)
    far[0, 3] = 20.0
    info = room / "info.txt"
    kept = [line for line in info.read_text().splitlines() if "DepthExtrinsic" not in line]
    info.write_text("\n".join([*kept, f"m_calibrationDepthExtrinsic = {' '.join(map(str, far.ravel()))}"]))
    dataset = read_dataset(room)
    assert [frame.depth for frame in dataset.frames] == [None, None]
    assert any("millimetres" in note for note in dataset.notes)


@pytest.mark.parametrize("path", ["../outside.png", "/etc/hostname", "depth", "a" * 300, "loop.png", "no\0name.png"])
def test_paths_of_depth_that_lead_nowhere_are_left_out(tmp_path: Path, path: str) -> None:
    folder = LAYOUTS["icl"](tmp_path / "set")
    (tmp_path / "outside.png").write_bytes((folder / "depth" / "0.png").read_bytes())
    (folder / "loop.png").symlink_to("loop.png")
    file = folder / "associations.txt"
    file.write_text(file.read_text().replace("0 depth/0.png 0 rgb/0.png", f"0 rgb/0.png 0 {path}"))
    dataset = read_dataset(folder)
    assert (len(dataset.frames), dataset.frames[0].depth, dataset.refused) == (2, None, ())


def test_linked_depth_is_read_as_linked_photographs_are(tmp_path: Path) -> None:
    folder = LAYOUTS["icl"](tmp_path / "set")
    file = folder / "depth" / "0.png"
    file.rename(tmp_path / "elsewhere.png")
    file.symlink_to(tmp_path / "elsewhere.png")
    assert_planted(read_dataset(folder).frames[0])
