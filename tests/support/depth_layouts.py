"""Folders with depth in the layouts of others, by their documents: the first of two photographs has the planted one."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector
from mapless_tools.ingest.formats.icl_nuim import CAMERA as ICL_CAMERA
from mapless_tools.ingest.formats.seven_scenes import CAMERA_FROM_DEPTH_CAMERA, DEPTH_CAMERA
from support.depths import planted_png, png
from support.images import encode, textured
from support.layouts import CAMERA, opengl, truth, write_image, write_seven_scenes, write_twelve_scenes

TRUTH = truth(2)
KINECT_PHOTO = textured(640, 480)
BESIDE = RigidTransform(rotation_from_vector([0.01, -0.02, 0.03]), np.array([0.02, -0.01, 0.003]))
"""Where a depth camera is beside its photograph's."""


def seven_scenes(folder: Path) -> Path:
    shots = [(KINECT_PHOTO, pose) for pose in TRUTH.poses]
    write_seven_scenes(folder, shots[:1], shots[1:])
    depth = planted_png(DEPTH_CAMERA, CAMERA_FROM_DEPTH_CAMERA, hole=65535)
    (folder / "seq-01" / "frame-000000.depth.png").write_bytes(depth)
    return folder


def twelve_scenes(folder: Path) -> Path:
    """A depth camera of its own size, K and place."""
    room = folder / "apt" / "kitchen"
    shots = [(textured(), pose) for pose in TRUTH.poses]
    write_twelve_scenes(room, CAMERA, shots[:1], shots[1:])
    camera = Camera(64, 48, 57.2, 57.5, 32.0, 24.0)
    (room / "data" / "frame-000000.depth.png").write_bytes(planted_png(camera, BESIDE))
    k = np.eye(4)
    k[:3, :3] = camera.matrix()
    fields = {"ColorExtrinsic": np.eye(4), "DepthIntrinsic": k, "DepthExtrinsic": BESIDE.matrix()}
    lines = [f"m_depthWidth = {camera.width_px}", f"m_depthHeight = {camera.height_px}"]
    lines += [f"m_calibration{name} = {_words(matrix)}" for name, matrix in fields.items()]
    with (room / "info.txt").open("a") as file:
        file.write("\n".join(lines) + "\n")
    return room


def icl_nuim(folder: Path) -> Path:
    """Mirrored: the planted poses, seen in a mirror that exchanges up and down."""
    mirror = np.diag([1.0, -1.0, 1.0])
    associations, rows = [], []
    for i, pose in enumerate(TRUTH.poses):
        (folder / "rgb").mkdir(parents=True, exist_ok=True)
        (folder / "rgb" / f"{i}.png").write_bytes(encode(".png", KINECT_PHOTO))
        associations.append(f"{i} depth/{i}.png {i} rgb/{i}.png")
        mirrored = RigidTransform(mirror @ pose.rotation @ mirror, mirror @ pose.translation)
        q = mirrored.quaternion()
        rows.append(f"{i} {_words(mirrored.translation)} {_words(np.array([q.x, q.y, q.z, q.w]))}")
    (folder / "depth").mkdir()
    (folder / "depth" / "0.png").write_bytes(planted_png(ICL_CAMERA.camera(640, 480), unit_m=1 / 5000))
    (folder / "associations.txt").write_text("\n".join(associations) + "\n")
    (folder / "livingRoom0.gt.freiburg").write_text("\n".join(rows) + "\n")
    return folder


def polycam(folder: Path) -> Path:
    """Confidence 0 at the first pixel, 127 and 255 elsewhere; the depth has a value everywhere."""
    keyframes = folder / "keyframes"
    for i, pose in enumerate(TRUTH.poses):
        write_image(keyframes / "images" / f"{i}.jpg", seed=i)
        content = {f"t_{r}{c}": opengl(pose)[r, c] for r in range(3) for c in range(4)}
        content |= {"fx": 80.0, "fy": 81.0, "cx": 47.75, "cy": 31.25, "width": 96, "height": 64}
        (keyframes / "cameras").mkdir(exist_ok=True)
        (keyframes / "cameras" / f"{i}.json").write_text(json.dumps(content))
    camera = CAMERA.resized(48, 32)
    (keyframes / "depth").mkdir()
    (keyframes / "depth" / "0.png").write_bytes(planted_png(camera, hole=9999))
    (keyframes / "confidence").mkdir()
    (keyframes / "confidence" / "0.png").write_bytes(png(_confidence(camera, (0, 127, 255))))
    return folder


LAYOUTS: Mapping[str, Callable[[Path], Path]] = {
    "7scenes": seven_scenes,
    "12scenes": twelve_scenes,
    "icl": icl_nuim,
    "arkit": polycam,
}


def _confidence(camera: Camera, kinds: tuple[int, int, int]) -> np.ndarray:
    values = np.full((camera.height_px, camera.width_px), kinds[2], np.uint8)
    values[::2] = kinds[1]
    values[0, 0] = kinds[0]
    return values


def _words(numbers: Array) -> str:
    return " ".join(map(repr, np.asarray(numbers, float).ravel().tolist()))
