"""Importers: our own cameras.json, nerfstudio's transforms.json, captures of phones, TUM RGB-D, ICL-NUIM, kapture.

Some have depth; what is read of it must be usable.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
from support.depths import png
from support.layouts import opengl

from mapless.geometry import RigidTransform
from mapless_tools.ingest.formats import Intrinsics, ReadOptions
from mapless_tools.ingest.formats.writing import PosedImage, cameras_files, kapture_files

from .importing import CAMERA, TRUTH, Layout, image_of, numbers, target

_IMAGES = [f"images/{i}.png" for i in range(3)]
_K = (CAMERA.focal_x_px, CAMERA.focal_y_px, CAMERA.principal_x_px + 0.5, CAMERA.principal_y_px + 0.5)


def _json(content: Any) -> bytes:
    return json.dumps(content).encode()


def _ours() -> bytes:
    images = [PosedImage(f"{i}.png", CAMERA, pose) for i, pose in enumerate(TRUTH.poses)]
    (text,) = cameras_files(images, "a test").values()
    content = json.loads(text)
    datum = {
        "latitude_deg": 48,
        "longitude_deg": 11.5,
        "height_m": 520,
        "enu_from_world": {"x": 0, "y": 0, "z": 0, "w": 1},
    }
    content |= {"datum": datum, "down_in_world": [0, 0, -1], "ground_truth": "SfM"}
    content["frames"][0] |= {"split": "test", "dist": [0.1, 0, 0, 0, 0.1]}
    content["frames"][1] |= {"lens": "fisheye", "dist": [0.1, 0, 0, 0]}
    return _json(content)


def _transforms(**about: Any) -> bytes:
    matrices = [opengl(pose).tolist() for pose in TRUTH.poses]
    frames = [{"file_path": f"./images/{i}.png", "transform_matrix": matrix} for i, matrix in enumerate(matrices)]
    return _json(about | {"frames": frames})


_SHARED = {"fl_x": _K[0], "fl_y": _K[1], "cx": _K[2], "cy": _K[3], "w": 32, "h": 33, "k1": 0.1, "p2": -0.01}
_APPLIED = {"applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 0.25, "test_filenames": ["./images/0.png"]}


def _scanner(number: int) -> bytes:
    k = [_K[0], 0, _K[2], 0, _K[1], _K[3], 0, 0, 1]
    return _json({"cameraPoseARFrame": opengl(TRUTH.poses[number]).ravel().tolist(), "intrinsics": k})


def _polycam(number: int) -> bytes:
    matrix = opengl(TRUTH.poses[number])
    pose = {f"t_{row}{column}": matrix[row, column] for row in range(3) for column in range(4)}
    return _json(pose | dict(zip(("fx", "fy", "cx", "cy", "width", "height"), (*_K, 32, 33), strict=True)))


def _trajectory() -> bytes:
    rows = ["# timestamp tx ty tz qx qy qz qw"]
    for i, pose in enumerate(TRUTH.poses):
        q = pose.quaternion()
        rows.append(f"{100 + 0.01 * i} {numbers(pose.translation)} {numbers([q.x, q.y, q.z, q.w])}")
    return "\n".join(rows).encode()


def _kapture() -> dict[str, bytes]:
    images = [PosedImage(f"{i}.png", CAMERA, pose) for i, pose in enumerate(TRUTH.poses)]
    tables = {name: text.encode() for name, text in kapture_files(images, "a test").items()}
    trajectories = tables["sensors/trajectories.txt"].replace(b"1, camera1", b"1, rig")
    rigs = b"# kapture format: 1.1\nrig, camera1, 1, 0, 0, 0, 0.1, 0, 0\n"
    return tables | {"sensors/trajectories.txt": trajectories, "sensors/rigs.txt": rigs}


def _with_intrinsics(folder: Path) -> ReadOptions:
    return ReadOptions(intrinsics=Intrinsics(30.0, 31.0, 15.25, 16.75))


def _values(unit_m: float) -> np.ndarray:
    """Depths of 1 to 2 m of a photograph of 32x33 pixels, in a unit."""
    return np.linspace(1 / unit_m, 2 / unit_m, 33 * 32).reshape(33, 32)


def _associations() -> dict[str, bytes]:
    rows = []
    for i, pose in enumerate(TRUTH.poses):
        q = pose.quaternion()
        rows.append(f"{i} {numbers(pose.translation)} {numbers([q.x, q.y, q.z, q.w])}")
    lines = [f"{i} depth.png {i} images/{i}.png" for i in range(3)]
    return {
        "associations.txt": "\n".join(lines).encode(),
        "livingRoom0.gt.freiburg": "\n".join(rows).encode(),
        "depth.png": png(_values(1 / 5000).astype(np.uint16)),
    }


def _record3d() -> bytes:
    poses = []
    for pose in TRUTH.poses:
        q = RigidTransform.from_matrix(opengl(pose)).quaternion()
        poses.append([q.x, q.y, q.z, q.w, *pose.translation.tolist()])
    k = [_K[0], 0, 0, 0, _K[1], 0, _K[2], _K[3], 1]
    return _json({"w": 32, "h": 33, "K": k, "poses": poses, "perFrameIntrinsicCoeffs": [list(_K)]})


def _kapture_depth() -> dict[str, bytes]:
    tables = _kapture()
    depth = b"depth1, structured_light, depth, PINHOLE, 32, 33, 30, 31, 16, 17\n"
    (at_first,) = (row for row in tables["sensors/trajectories.txt"].splitlines() if row.startswith(b"0, camera1"))
    return {
        "sensors/sensors.txt": tables["sensors/sensors.txt"] + depth,
        "sensors/trajectories.txt": tables["sensors/trajectories.txt"] + at_first.replace(b"camera1", b"depth1"),
        "sensors/records_camera.txt": tables["sensors/records_camera.txt"],
        "sensors/records_depth.txt": b"# kapture format: 1.1\n0, depth1, 0.depth\n",
        "sensors/records_data/0.depth": _values(1.0).astype("<f4").tobytes(),
    }


_FRAMES = ("frame_00000", "frame_00010")
_KEYFRAMES = "keyframes/corrected_cameras", "keyframes/corrected_images"
LAYOUTS = (
    Layout("cameras", "ours", {"cameras.json": _ours()}, _IMAGES),
    Layout("nerf", "nerfstudio", {"transforms.json": _transforms(**_SHARED, **_APPLIED)}, _IMAGES),
    Layout(
        "nerf",
        "blender",
        {f"transforms_{split}.json": _transforms(camera_angle_x=0.7) for split in ("train", "test")},
        _IMAGES,
    ),
    Layout(
        "arkit", "scanner", {f"{it}.json": _scanner(i) for i, it in enumerate(_FRAMES)}, [f"{it}.jpg" for it in _FRAMES]
    ),
    Layout(
        "arkit",
        "polycam",
        {f"{_KEYFRAMES[0]}/{i}.json": _polycam(i) for i in range(2)},
        [f"{_KEYFRAMES[1]}/{i}.jpg" for i in range(2)],
    ),
    Layout(
        "tum",
        "freiburg1",
        {
            "rgb.txt": b"# time, path\n100.005 images/0.png\n100.01 images/1.png\n100.0 rgb.png",
            "groundtruth.txt": _trajectory(),
            "rgb.png": image_of(".png", 0),
        },
        _IMAGES,
        _with_intrinsics,
    ),
    Layout("kapture", "rig", _kapture(), [f"sensors/records_data/{i}.png" for i in range(3)]),
    Layout("kapture", "depth", _kapture_depth(), [f"sensors/records_data/{i}.png" for i in range(3)]),
    Layout("icl", "traj0", _associations(), _IMAGES),
    Layout("record3d", "EXR_RGBD", {"metadata.json": _record3d()}, [f"rgb/{i}.jpg" for i in range(3)]),
)

TARGET = target(
    LAYOUTS,
    tuple(f'"{it}": '.encode() for it in ("split", "lens", "dist", "K", "width", "datum", "enu_from_world", "metric"))
    + tuple(f'"{it}": '.encode() for it in ("is_fisheye", "camera_model", "train_filenames", "k4", "camera_angle_y"))
    + (b'"OPENCV_FISHEYE"', b'"PINHOLE"', b'"fisheye"', b'"train"', b"NaN", b"Infinity", b"null", b"true"),
)
