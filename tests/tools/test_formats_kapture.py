"""kapture 1.1 and LaMAR's sessions: hand-built tables, rigs, cameras, damage; and kapture's own library both ways."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.layouts import (
    CAMERA,
    Truth,
    assert_reads,
    assert_same_camera,
    by_name,
    reasons,
    truth,
    write_image,
    write_layout,
)

from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless.lenses import Fisheye, RadialTangential
from mapless_tools.dataset import Dataset
from mapless_tools.ingest.formats import read_dataset
from mapless_tools.ingest.formats.colmap.cameras import PARAMETERS

TRUTH = truth()
LIBRARY = Path(sys.prefix) / "kapture"
"""Where `make setup` puts kapture's own library, without the compiler that it asks for."""
HEADER = "# kapture format: 1.1\n"


def row(pose: RigidTransform) -> str:
    q = pose.quaternion()
    return ", ".join(map(repr, [q.w, q.x, q.y, q.z, *pose.translation.tolist()]))


def pinhole(name: str) -> str:
    k = CAMERA
    numbers = f"{k.focal_x_px}, {k.focal_y_px}, {k.principal_x_px + 0.5}, {k.principal_y_px + 0.5}"
    return f"{name}, , camera, PINHOLE, {k.width_px}, {k.height_px}, {numbers}\n"


def write_rig(folder: Path, is_capture: bool) -> list[RigidTransform]:
    """Two cameras in a head, the head on a cart with a trajectory; the true poses of both cameras, frame by frame."""
    cart_from_head = RigidTransform(rotation_from_vector([0.1, 0.5, -0.2]), np.array([0.3, -0.2, 1.1]))
    head_from_camera = [
        RigidTransform(rotation_from_vector([0.02, -0.4, 0.3]), np.array([0.1, 0.05, 0.0])),
        RigidTransform(rotation_from_vector([-0.3, 0.6, 0.1]), np.array([-0.12, 0.0, 0.02])),
    ]
    tables, records, data = folder / "sensors", "records_camera.txt", "records_data"
    if is_capture:
        tables, records, data = folder, "images.txt", "raw_data"

    def written(pose: RigidTransform) -> str:
        return row(pose if is_capture else pose.inverse())

    rigs = [f"cart, head, {written(cart_from_head)}"]
    rigs += [f"head, cam{i}, {written(pose)}" for i, pose in enumerate(head_from_camera)]
    trajectory, images, expected = [], [], []
    for time, world_from_cart in enumerate(TRUTH.poses):
        trajectory.append(f"{time:04}, cart, {written(world_from_cart)}")
        for i, mount in enumerate(head_from_camera):
            images.append(f"{time:04},cam{i} ,  map/cam{i}/{time}.png")
            write_image(tables / data / "map" / f"cam{i}" / f"{time}.png", seed=2 * time + i)
            expected.append(world_from_cart.compose(cart_from_head).compose(mount))
    tables.mkdir(exist_ok=True)
    sensors = pinhole("cam0") + pinhole("cam1") + "wifi0, phone, wifi\ndepth0, , depth, PINHOLE, 4, 3, 1, 1, 2, 1.5\n"
    (tables / "sensors.txt").write_text(HEADER + sensors)
    for name, lines in (("rigs.txt", rigs), ("trajectories.txt", trajectory), (records, images)):
        (tables / name).write_text("\n".join([HEADER, *lines, ""]))
    return expected


@pytest.mark.parametrize("is_capture", [False, True])
def test_cameras_on_rigs_on_rigs_have_poses(tmp_path: Path, is_capture: bool) -> None:
    """The tables of kapture have sensors from the world, LaMAR's the inverse."""
    expected = write_rig(tmp_path, is_capture)
    dataset = read_dataset(tmp_path)
    assert (dataset.format, dataset.metric, dataset.refused) == ("kapture", is_capture, ())
    frames = by_name(dataset)
    for index, pose in enumerate(expected):
        frame = frames[f"map_cam{index % 2}_{index // 2}"]
        np.testing.assert_allclose(frame.world_from_camera.matrix(), pose.matrix(), atol=1e-12)
        assert_same_camera(frame.camera, CAMERA)


def test_sessions_have_the_poses_that_all_share(tmp_path: Path) -> None:
    write_rig(tmp_path, True)
    (tmp_path / "proc").mkdir()
    moved = RigidTransform(rotation_from_vector([0, 0.3, 0]), np.array([5.0, 6.0, 7.0]))
    aligned = "0, cam1, " + row(moved) + ", 0.1, 0, 0\n"  # covariances may follow
    (tmp_path / "proc" / "alignment_trajectories.txt").write_text(aligned)
    dataset = read_dataset(tmp_path)
    np.testing.assert_allclose(dataset.frames[0].world_from_camera.matrix(), moved.matrix(), atol=1e-12)
    assert "proc/alignment_trajectories.txt" in dataset.notes[0]
    assert len(dataset.refused) == 2 * len(TRUTH.poses) - 1
    assert "has none of 'cam0' at 0000, nor do its rigs (head)" in dataset.refused[0].reason


CAMERAS = {
    "SIMPLE_PINHOLE": ("80, 48, 32", Camera(96, 64, 80, 80, 47.5, 31.5)),
    "PINHOLE": ("80, 81, 48, 32", Camera(96, 64, 80, 81, 47.5, 31.5)),
    "SIMPLE_RADIAL": ("80, 48, 32, 0.1", Camera(96, 64, 80, 80, 47.5, 31.5, RadialTangential(0.1))),
    "RADIAL": ("80, 48, 32, 0.1, -0.2", Camera(96, 64, 80, 80, 47.5, 31.5, RadialTangential(0.1, -0.2))),
    "OPENCV": (
        "80, 81, 48, 32, 0.1, -0.2, 0.01, 0.02",
        Camera(96, 64, 80, 81, 47.5, 31.5, RadialTangential(0.1, -0.2, 0.01, 0.02)),
    ),
    "OPENCV_FISHEYE": (
        "80, 81, 48, 32, 0.1, 0.2, 0.3, 0.4",
        Camera(96, 64, 80, 81, 47.5, 31.5, Fisheye(0.1, 0.2, 0.3, 0.4)),
    ),
    "FULL_OPENCV": (
        "80, 81, 48, 32, 0.1, -0.2, 0.01, 0.02, 0.3, 0, 0, 0",
        Camera(96, 64, 80, 81, 47.5, 31.5, RadialTangential(0.1, -0.2, 0.01, 0.02, 0.3)),
    ),
    "SIMPLE_RADIAL_FISHEYE": ("80, 48, 32, 0.1", Camera(96, 64, 80, 80, 47.5, 31.5, Fisheye(0.1))),
    "RADIAL_FISHEYE": ("80, 48, 32, 0.1, 0.2", Camera(96, 64, 80, 80, 47.5, 31.5, Fisheye(0.1, 0.2))),
    "FOV": ("80, 81, 48, 32, 0.9", None),
    "THIN_PRISM_FISHEYE": ("80, 81, 48, 32, 0, 0, 0, 0, 0, 0, 0, 0.1", None),
    "UNKNOWN_CAMERA": ("", None),
}


def write_models(folder: Path) -> Path:
    """A photograph for each of kapture's camera models."""
    tables = folder / "sensors"
    sensors, poses, records = "", "", ""
    for time, (model, (parameters, _)) in enumerate(CAMERAS.items()):
        write_image(tables / "records_data" / f"{model}.png", seed=time)
        sensors += f"c-{model}, , camera, {model}, 96, 64, {parameters}".rstrip(", ") + "\n"
        poses += f"{time}, c-{model}, {row(TRUTH.poses[0])}\n"
        records += f"{time}, c-{model}, {model}.png\n"
    for name, text in (("sensors", sensors), ("trajectories", poses), ("records_camera", records)):
        (tables / f"{name}.txt").write_text(HEADER + text)
    return folder


def test_each_camera_model_is_read_or_named(tmp_path: Path) -> None:
    dataset = read_dataset(write_models(tmp_path))
    frames = by_name(dataset)
    for model, (_, camera) in CAMERAS.items():
        if camera is not None:
            assert_same_camera(frames[model].camera, camera)
    refused = [it.reason for it in dataset.refused]
    for model in ("FOV", "THIN_PRISM_FISHEYE", "UNKNOWN_CAMERA"):
        assert any(f"camera c-{model}: its model {model} has no counterpart here" in reason for reason in refused)
    assert len(refused) == 3


def damaged(folder: Path, table: str, old: str, new: str) -> Path:
    file = folder / "sensors" / f"{table}.txt"
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new, 1))
    return folder


@pytest.mark.parametrize(
    ("table", "old", "new", "message"),
    [
        ("trajectories", "\n0, camera1, ", "\n0, camera1, , , , , ", "pose is not complete"),
        ("trajectories", "\n0, ", "\n9, ", "trajectories.txt has none of 'camera1' at 0"),
        ("trajectories", "\n0, camera1, ", "\n0, camera1, 7", "quaternion"),
        ("records_camera", "\n0, camera1", "\n0, nothing", "sensor 'nothing' is no camera of sensors.txt"),
        ("records_camera", "\n0, ", "\nnoon, ", "a timestamp is a whole number, is 'noon'"),
        ("records_camera", "0.png", "../../0.png", "leads out of"),
        ("records_camera", "0.png", "lost.png", "there is no file"),
    ],
)
def test_what_is_wrong_with_one_photograph_refuses_it_alone(
    tmp_path: Path, table: str, old: str, new: str, message: str
) -> None:
    folder = damaged(write_layout(tmp_path, "kapture", TRUTH), table, old, new)
    dataset = read_dataset(folder)
    (refused,) = dataset.refused
    assert refused.frame.startswith("records_camera.txt:")
    assert message in refused.reason
    assert len(dataset.frames) == len(TRUTH.poses) - 1


@pytest.mark.parametrize(
    ("table", "old", "new", "message"),
    [
        ("sensors", "format: 1.1", "format: 2.0", "sensors.txt:1: kapture format 2.0 is not known"),
        ("sensors", "PINHOLE, 96", "PINHOLE, wide", "sensors.txt:5: parameters of the camera must be numbers"),
        ("sensors", "PINHOLE, 96", "PINHOLE, 3, 96", "PINHOLE has parameters w h fx fy cx cy, found 7 numbers"),
        ("trajectories", "\n0, camera1,", "\n0 camera1", "expected at least 9 values with commas, found 7"),
        ("trajectories", "\n0, ", "\nnoon, ", "a timestamp is a whole number"),
    ],
)
def test_a_table_that_is_malformed_is_named(tmp_path: Path, table: str, old: str, new: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_dataset(damaged(write_layout(tmp_path, "kapture", TRUTH), table, old, new))


def test_rigs_that_hold_each_other_end(tmp_path: Path) -> None:
    folder = write_layout(tmp_path, "kapture", TRUTH)
    mounts = f"a, b, {row(TRUTH.poses[0])}\nb, a, {row(TRUTH.poses[0])}\na, camera1, {row(TRUTH.poses[0])}\n"
    (folder / "sensors" / "rigs.txt").write_text(mounts)
    damaged(folder, "trajectories", "\n0, camera1", "\n0, c")
    (reason,) = reasons(read_dataset(folder)).values()
    assert reason == "pose: trajectories.txt has none of 'camera1' at 0, nor do its rigs (a)"


ORACLE = """
import json, sys
import kapture
from kapture.io.csv import kapture_from_dir, kapture_to_dir
folder, copy = sys.argv[1:]
read = kapture_from_dir(folder)
if read.rigs:
    kapture.rigs_remove_inplace(read.trajectories, read.rigs)
found = {}
for time, sensor, name in kapture.flatten(read.records_camera):
    camera, pose = read.sensors[sensor], read.trajectories.get(time, {}).get(sensor)
    world_from_camera = pose.inverse()
    found[name] = {
        "model": camera.camera_type.name,
        "numbers": camera.camera_params,
        "q": list(map(float, world_from_camera.r_raw)),
        "t": [float(it) for it in world_from_camera.t_raw],
    }
kapture_to_dir(copy, read)
print(json.dumps(found))
"""


def by_library(folder: Path, copy: Path, stand_ins: Path) -> dict[str, dict[str, object]]:
    """Read by kapture's own library, its rigs resolved, by image; and a copy of the tables as it writes them."""
    if not (LIBRARY / "kapture").is_dir():
        pytest.skip(f"kapture's library is not in {LIBRARY}: make setup")
    stand_ins.mkdir()  # for a compiler of 200 MB, which speeds up one function
    (stand_ins / "numba.py").write_text("njit = lambda *given, **_: given[0] if given else lambda it: it\n")
    code = f"import sys; sys.path[:0] = [{str(stand_ins)!r}, {str(LIBRARY)!r}]\n{ORACLE}"
    done = subprocess.run([sys.executable, "-c", code, folder, copy], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    found: dict[str, dict[str, object]] = json.loads(done.stdout.splitlines()[-1])
    return found


def assert_agrees(dataset: Dataset, found: dict[str, dict[str, object]]) -> None:
    for frame in dataset.frames:
        name = next(it for it in found if frame.image_path.as_posix().endswith(f"/{it}"))
        pose = frame.world_from_camera
        q = pose.quaternion()
        given = np.array(found[name]["q"])
        np.testing.assert_allclose(given * np.sign(given[0]), [q.w, q.x, q.y, q.z], atol=1e-12)
        np.testing.assert_allclose(np.array(found[name]["t"]), pose.translation, atol=1e-12)


@pytest.mark.nightly
def test_kaptures_library_reads_what_we_write_and_we_its_copy(tmp_path: Path) -> None:
    planted = Truth(TRUTH.poses, replace(CAMERA, distortion=Fisheye(0.1, 0.2, 0.3, 0.4)))
    folder = write_layout(tmp_path / "ours", "kapture", planted)
    found = by_library(folder, tmp_path / "copy", tmp_path / "stand-ins")
    assert {it["model"] for it in found.values()} == {"OPENCV_FISHEYE"}
    assert_agrees(read_dataset(folder), found)
    (tmp_path / "copy" / "sensors" / "records_data").symlink_to(folder / "sensors" / "records_data")
    copy = read_dataset(tmp_path / "copy")
    assert not copy.metric  # kapture has no unit, and its library drops our comment
    assert_reads(copy, planted)


@pytest.mark.nightly
def test_rigs_are_resolved_as_by_kaptures_library(tmp_path: Path) -> None:
    write_rig(tmp_path / "rig", False)
    found = by_library(tmp_path / "rig", tmp_path / "copy", tmp_path / "stand-ins")
    assert len(found) == 2 * len(TRUTH.poses)
    assert_agrees(read_dataset(tmp_path / "rig"), found)


@pytest.mark.nightly
def test_camera_models_and_their_parameters_are_kaptures(tmp_path: Path) -> None:
    found = by_library(write_models(tmp_path / "models"), tmp_path / "copy", tmp_path / "stand-ins")
    for name, camera in found.items():
        model = name.removesuffix(".png")
        assert camera["model"] == model
        assert len(camera["numbers"]) == 2 + len(PARAMETERS.get(model, ()))  # type: ignore[arg-type]
