"""nerfstudio's transforms.json, TUM RGB-D and phones' captures: planted poses come back in our axes."""

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.images import encode
from support.layouts import (
    CAMERA,
    Truth,
    assert_reads,
    assert_same_camera,
    assert_same_pose,
    opengl,
    reasons,
    truth,
    write_image,
)

from mapless.depth import DepthSensor
from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless.lenses import Fisheye, RadialTangential
from mapless_tools.ingest.formats import Intrinsics, ReadOptions, read_dataset
from mapless_tools.ingest.metres import MetreOptions, in_metres

TRUTH = truth()
SHARED = {"fl_x": 80.0, "fl_y": 81.0, "cx": 47.75, "cy": 31.25, "w": 96, "h": 64}


def write_transforms(
    folder: Path, change: Callable[[np.ndarray], np.ndarray] = lambda m: m, planted: Truth = TRUTH, **about: Any
) -> Path:
    frames = []
    for i, pose in enumerate(planted.poses):
        write_image(folder / "images" / f"{i}.png", seed=i)
        frames.append({"file_path": f"./images/{i}.png", "transform_matrix": change(opengl(pose)).tolist()})
    (folder / "transforms.json").write_text(json.dumps(SHARED | about | {"frames": frames}))
    return folder


def edit(file: Path, change: Callable[[Any], None]) -> None:
    content = json.loads(file.read_text())
    change(content)
    file.write_text(json.dumps(content))


def test_transforms_come_back_with_our_axes_and_pixels(tmp_path: Path) -> None:
    dataset = read_dataset(write_transforms(tmp_path, k1=0.1, k2=-0.2, p1=0.01, p2=0.02))
    lens = RadialTangential(0.1, -0.2, 0.01, 0.02)
    assert_reads(dataset, replace(TRUTH, camera=replace(CAMERA, distortion=lens)))
    assert (dataset.format, dataset.metric) == ("nerf", False)


def test_depths_of_transforms_are_scaled_with_the_poses(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path)
    (folder / "depth.png").write_bytes(encode(".png", np.ones((64, 96), np.uint16)))
    edit(folder / "transforms.json", lambda it: it["frames"][0].update(depth_file_path="depth.png"))
    dataset = read_dataset(folder)
    depth = dataset.frames[0].depth
    assert depth is not None
    assert (depth.path.name, depth.unit_m, dataset.frames[1].depth) == ("depth.png", 0.001, None)
    scaled = in_metres(dataset, MetreOptions(scale=0.5)).frames[0].depth
    assert scaled is not None
    assert scaled.unit_m == 0.0005


@pytest.mark.parametrize("kind", [np.float32, np.float64, np.uint16])
def test_depths_of_transforms_may_be_arrays(tmp_path: Path, kind: type) -> None:
    folder = write_transforms(tmp_path)
    values = np.arange(64 * 96).reshape(64, 96, 1)
    np.save(folder / "depth.npy", np.asfortranarray(values.astype(kind)))
    edit(folder / "transforms.json", lambda it: it["frames"][0].update(depth_file_path="depth.npy"))
    depth = read_dataset(folder).frames[0].depth
    assert depth is not None
    image = depth.read()
    assert (image.size, image.unit_m) == ((96, 64), 0.001)
    np.testing.assert_array_equal(np.frombuffer(image.data, "<f4"), np.arange(64 * 96))


@pytest.mark.parametrize("array", [np.ones((64, 96, 3)), np.ones(96), np.array([["a"]]), np.ones((64, 96), complex)])
def test_arrays_that_are_no_depth_are_left_out(tmp_path: Path, array: np.ndarray) -> None:
    folder = write_transforms(tmp_path)
    np.save(folder / "depth.npy", array)
    edit(folder / "transforms.json", lambda it: it["frames"][0].update(depth_file_path="depth.npy"))
    dataset = read_dataset(folder)
    assert (dataset.frames[0].depth, "is no depth" in dataset.notes[-1]) == (None, True)


def test_depths_of_nerfcapture_have_their_own_unit(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path, integer_depth_scale=0.0005)
    (folder / "depth.png").write_bytes(encode(".png", np.ones((64, 96), np.uint16)))
    edit(folder / "transforms.json", lambda it: it["frames"][0].update(depth_path="depth.png"))
    depth = read_dataset(folder).frames[0].depth
    assert depth is not None
    assert depth.unit_m == 0.0005
    edit(folder / "transforms.json", lambda it: it.pop("integer_depth_scale"))
    dataset = read_dataset(folder)
    assert (dataset.frames[0].depth, "1 depths are left out" in dataset.notes[-1]) == (None, True)


@pytest.mark.parametrize("path", ["none.png", "depth.npy", "colours.png", 5])
def test_photographs_whose_depth_is_unusable_are_kept(tmp_path: Path, path: object) -> None:
    folder = write_transforms(tmp_path)
    count = len(read_dataset(folder).frames)
    (folder / "depth.npy").write_bytes(b"\x93NUMPY")
    (folder / "colours.png").write_bytes(encode(".png", np.ones((64, 96, 3), np.uint8)))
    edit(folder / "transforms.json", lambda it: it["frames"][0].update(depth_file_path=path))
    dataset = read_dataset(folder)
    assert (len(dataset.frames), dataset.refused, dataset.frames[0].depth) == (count, (), None)
    assert any(it.startswith(f"1 depths are left out; the first, {path}: ") for it in dataset.notes)


def test_an_applied_transform_and_scale_are_undone(tmp_path: Path) -> None:
    turn = np.eye(4)
    turn[:3, :3] = rotation_from_vector([0.3, -1.0, 0.5])
    turn[:3, 3] = [1.0, 2.0, 3.0]

    def applied(matrix: np.ndarray) -> np.ndarray:
        moved: np.ndarray = turn @ matrix
        moved[:3, 3] *= 0.25
        return np.asarray(moved)

    folder = write_transforms(tmp_path, applied, applied_transform=turn[:3].tolist(), applied_scale=0.25)
    dataset = read_dataset(folder)
    assert_reads(dataset, TRUTH)
    assert any("0.25" in note for note in dataset.notes)


def test_intrinsics_may_be_per_frame_and_endings_missing(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path)

    def change(content: Any) -> None:
        shared = {name: content.pop(name) for name in SHARED}
        for frame in content["frames"]:
            frame |= shared
            frame["file_path"] = frame["file_path"].removesuffix(".png")

    edit(folder / "transforms.json", change)
    assert_reads(read_dataset(folder), TRUTH)


@pytest.mark.parametrize("written", [".\\images\\{}.png", "./images\\{}.png", "images\\{}"])
def test_paths_written_on_windows_are_read(tmp_path: Path, written: str) -> None:
    folder = write_transforms(tmp_path)

    def change(content: Any) -> None:
        for i, frame in enumerate(content["frames"]):
            frame["file_path"] = written.format(i)

    edit(folder / "transforms.json", change)
    dataset = read_dataset(folder)
    assert_reads(dataset, TRUTH)
    assert [it.name for it in dataset.frames] == [f"images_{i}" for i in range(4)]


def test_an_angle_of_view_and_the_file_size_give_the_focal(tmp_path: Path) -> None:
    """instant-ngp's and Blender's: the whole width is seen under the angle."""
    folder = write_transforms(tmp_path)

    def change(content: Any) -> None:
        for name in SHARED:
            del content[name]
        content["camera_angle_x"] = 2 * math.atan(48 / 80)

    edit(folder / "transforms.json", change)
    assert_same_camera(read_dataset(folder).frames[0].camera, Camera(96, 64, 80.0, 80.0, 47.5, 31.5))


def test_blenders_files_of_splits(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path)
    content = json.loads((folder / "transforms.json").read_text())
    (folder / "transforms.json").unlink()
    frames = content.pop("frames")
    (folder / "transforms_train.json").write_text(json.dumps(content | {"frames": frames[:3]}))
    (folder / "transforms_test.json").write_text(json.dumps(content | {"frames": frames[3:]}))
    dataset = read_dataset(folder)
    assert_reads(dataset, TRUTH)
    assert [frame.split for frame in dataset.frames] == ["train", "train", "train", "test"]


def test_lists_of_names_are_the_split(tmp_path: Path) -> None:
    names = [f"./images/{i}.png" for i in range(4)]
    folder = write_transforms(tmp_path, train_filenames=names[:2], val_filenames=names[2:], test_filenames=names[2:])
    assert [frame.split for frame in read_dataset(folder).frames] == ["train", "train", "test", "test"]


@pytest.mark.parametrize("about", [{"camera_model": "OPENCV_FISHEYE"}, {"is_fisheye": True}])
def test_fisheye_lenses(tmp_path: Path, about: dict[str, Any]) -> None:
    folder = write_transforms(tmp_path, k1=0.1, k2=0.2, k3=0.3, k4=0.4, **about)
    assert read_dataset(folder).frames[0].camera.distortion == Fisheye(0.1, 0.2, 0.3, 0.4)


def test_wrong_frames_of_transforms_are_refused_by_name(tmp_path: Path) -> None:
    folder = write_transforms(tmp_path)

    def change(content: Any) -> None:
        frames = content["frames"]
        frames[0]["transform_matrix"] = np.diag([1.0, 1.0, -1.0, 1.0]).tolist()  # a mirror
        frames[1]["camera_model"] = "EQUIRECTANGULAR"
        frames[2]["file_path"] = "images/none.png"
        frames.append(dict(frames[3]))
        frames.append(dict(frames[3], file_path="/images/3.png"))
        frames.append("3.png")

    edit(folder / "transforms.json", change)
    dataset = read_dataset(folder)
    assert len(dataset.frames) == 1
    why = " | ".join(f"{frame}: {reason}" for frame, reason in reasons(dataset).items())
    for part in ("frames[0]", "reflection", "EQUIRECTANGULAR", "no file", "named twice", "leads out", "an object"):
        assert part in why


def test_numbers_that_no_double_holds_refuse_their_frame(tmp_path: Path) -> None:
    """JSON's integers have any number of digits, and so have the names of files."""
    folder = write_transforms(tmp_path)

    def change(content: Any) -> None:
        frames = content["frames"]
        frames[0]["fl_x"] = 10**400
        frames[1]["transform_matrix"][0][0] = 10**400
        frames[2]["file_path"] = "1" * 5000

    edit(folder / "transforms.json", change)
    dataset = read_dataset(folder)
    assert len(dataset.frames) == 1
    why = sorted(reasons(dataset).values())
    for reason, part in zip(
        why, ("fl_x is too large", "File name too long", "transform_matrix must be num"), strict=True
    ):
        assert part in reason


@pytest.mark.parametrize(
    ("about", "message"),
    [
        ({"applied_scale": 10**400}, "applied_scale is too large"),
        ({"applied_transform": [[10**400, 0, 0, 0]] * 3}, "applied_transform must be numbers"),
        ({"applied_transform": np.diag([1.0, -1.0, 1.0, 1.0])[:3].tolist()}, "applied_transform: .*reflection"),
        ({"applied_scale": 0}, "applied_scale must be above 0"),
        ({"frames": []}, "frames must be a list"),
    ],
)
def test_what_is_wrong_with_all_of_transforms_ends_the_reading(
    tmp_path: Path, about: dict[str, Any], message: str
) -> None:
    folder = write_transforms(tmp_path)
    edit(folder / "transforms.json", lambda content: content.update(about))
    with pytest.raises(ValueError, match=rf"transforms\.json: {message}"):
        read_dataset(folder)


TUM_CAMERA = Camera(640, 480, 535.4, 539.2, 320.1, 247.6)


def write_tum(folder: Path, count: int = 3) -> tuple[Path, list[float]]:
    """Frames between the samples of a motion with constant velocities, in translation and rotation."""
    times = [100.0 + 0.033 * i for i in range(count)]
    rgb = ["# color images", "# timestamp filename"]
    for i, time_s in enumerate(times):
        write_image(folder / "rgb" / f"{time_s:.6f}.png", i, 640, 480)
        rgb.append(f"{time_s:.6f} rgb/{time_s:.6f}.png")
    (folder / "rgb.txt").write_text("\n".join(rgb) + "\n")
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    for time_s in np.arange(99.99, 100.2, 0.01):
        pose = tum_pose(float(time_s))
        q = pose.quaternion()
        numbers = [*pose.translation.tolist(), q.x, q.y, q.z, q.w]
        rows.append(" ".join([f"{time_s:.4f}", *(f"{number:.9f}" for number in numbers)]))
    (folder / "groundtruth.txt").write_text("\n".join(rows) + "\n")
    return folder, times


def tum_pose(time_s: float) -> RigidTransform:
    t = time_s - 100.0
    return RigidTransform(rotation_from_vector([0.3, 5.0 * t, 0.0]), np.array([10.0 * t, 1.0, -3.0 * t]))


def test_tum_interpolates_between_the_motion_captures_samples(tmp_path: Path) -> None:
    folder, times = write_tum(tmp_path / "rgbd_dataset_freiburg3_office")
    dataset = read_dataset(folder)
    assert (dataset.format, dataset.ground_truth, dataset.refused) == ("tum", "motion capture", ())
    for frame, time_s in zip(dataset.frames, times, strict=True):
        assert_same_pose(frame.world_from_camera, tum_pose(time_s), 1e-4)
        assert_same_camera(frame.camera, TUM_CAMERA)
    assert dataset.frames[1].name == "100.033000"


def test_tum_photographs_have_the_depth_nearest_in_time(tmp_path: Path) -> None:
    folder, times = write_tum(tmp_path / "rgbd_dataset_freiburg3_office")
    (folder / "depth").mkdir()
    lines = ["# depth maps"]
    for time_s in (times[0] + 0.004, times[1] - 0.015, times[1] + 0.01):
        (folder / "depth" / f"{time_s:.6f}.png").write_bytes(encode(".png", np.ones((480, 640), np.uint16)))
        lines.append(f"{time_s:.6f} depth/{time_s:.6f}.png")
    (folder / "depth.txt").write_text("\n".join(lines) + "\n")
    depths = [frame.depth for frame in read_dataset(folder).frames]
    names = [None if it is None else it.path.name for it in depths]
    assert names == [f"{times[0] + 0.004:.6f}.png", f"{times[1] + 0.01:.6f}.png", None]
    assert depths[0] is not None
    assert (depths[0].unit_m, depths[0].sensor) == (0.0002, DepthSensor.STRUCTURED_LIGHT)


@pytest.mark.parametrize("line", ["{time:.6f} depth/1.png", "{time:.6f}", "noon depth/1.png"])
def test_tum_without_the_depth_it_lists_is_read(tmp_path: Path, line: str) -> None:
    folder, times = write_tum(tmp_path / "rgbd_dataset_freiburg3_office")
    (folder / "depth.txt").write_text(line.format(time=times[0]) + "\n")
    dataset = read_dataset(folder)
    assert (len(dataset.frames), dataset.refused, dataset.frames[0].depth) == (len(times), (), None)
    assert "1 depths are left out" in dataset.notes[-1]


def test_tum_frames_without_ground_truth_nearby_are_refused(tmp_path: Path) -> None:
    folder, _ = write_tum(tmp_path / "rgbd_dataset_freiburg3_office")
    file = folder / "groundtruth.txt"
    rows = file.read_text().splitlines()
    file.write_text("\n".join(row for row in rows if not row.startswith(("100.02", "100.03", "100.04"))) + "\n")
    dataset = read_dataset(folder)
    assert len(dataset.frames) == 2
    (reason,) = reasons(dataset).values()
    assert "within 20 ms" in reason


def test_tum_needs_to_know_the_camera(tmp_path: Path) -> None:
    folder, _ = write_tum(tmp_path / "office")
    with pytest.raises(ValueError, match="--intrinsics"):
        read_dataset(folder)
    given = Intrinsics(500.0, 500.0, 320.0, 240.0)
    assert_same_camera(
        read_dataset(folder, options=ReadOptions(intrinsics=given)).frames[0].camera, given.camera(640, 480)
    )


def write_scanner(folder: Path) -> Path:
    """As 3D Scanner App writes it; of some frames only the .json."""
    k = [80.0, 0.0, 47.75, 0.0, 81.0, 31.25, 0.0, 0.0, 1.0]
    for i, pose in enumerate(TRUTH.poses):
        write_image(folder / f"frame_{10 * i:05d}.jpg", seed=i)
        content = {"cameraPoseARFrame": opengl(pose).reshape(-1).tolist(), "intrinsics": k, "time": 0.1 * i}
        (folder / f"frame_{10 * i:05d}.json").write_text(json.dumps(content))
        (folder / f"frame_{10 * i + 1:05d}.json").write_text(json.dumps(content))
    write_image(folder / "thumb_00.jpg", seed=77)
    return folder


def write_polycam(folder: Path, prefix: str = "corrected_", offset: float = 0.0) -> Path:
    for i, pose in enumerate(TRUTH.poses):
        write_image(folder / "keyframes" / f"{prefix}images" / f"{1000 + i}.jpg", seed=i)
        matrix = opengl(pose.shifted([offset, 0, 0]))
        content: dict[str, Any] = {f"t_{r}{c}": matrix[r, c] for r in range(3) for c in range(4)}
        content |= {"fx": 80.0, "fy": 81.0, "cx": 47.75, "cy": 31.25, "width": 96, "height": 64, "blur_score": 3.0}
        file = folder / "keyframes" / f"{prefix}cameras" / f"{1000 + i}.json"
        file.parent.mkdir(exist_ok=True)
        file.write_text(json.dumps(content))
    return folder


@pytest.mark.parametrize("write", [write_scanner, write_polycam])
def test_captures_of_phones(tmp_path: Path, write: Callable[[Path], Path]) -> None:
    dataset = read_dataset(write(tmp_path))
    assert_reads(dataset, TRUTH)
    assert (dataset.format, dataset.metric, dataset.ground_truth) == ("arkit", True, "device tracking")


def test_corrected_poses_are_preferred(tmp_path: Path) -> None:
    write_polycam(tmp_path, prefix="", offset=0.5)
    assert "drift" in read_dataset(tmp_path).notes[0]
    write_polycam(tmp_path)
    assert_reads(read_dataset(tmp_path), TRUTH)


def test_frames_of_captures_that_are_wrong_are_refused_by_name(tmp_path: Path) -> None:
    write_polycam(tmp_path)
    cameras = tmp_path / "keyframes" / "corrected_cameras"
    whole = (cameras / "1003.json").read_bytes()
    edit(cameras / "1000.json", lambda content: content.update(width=640))
    edit(cameras / "1001.json", lambda content: content.pop("t_12"))
    (cameras / "1002.json").write_text("{")
    edit(cameras / "1003.json", lambda content: content.update(fx=10**400))
    write_image(tmp_path / "keyframes" / "corrected_images" / "1004.jpg")
    (cameras / "1004.json").write_bytes(whole)
    dataset = read_dataset(tmp_path)
    assert [frame.name for frame in dataset.frames] == ["1004"]
    why = " | ".join(reasons(dataset).values())
    for part in (
        "640x64, the image is 96x64",
        "1001.json: t_12 is missing",
        "1002.json is not JSON",
        "1003.json: intrinsics must",
    ):
        assert part in why
