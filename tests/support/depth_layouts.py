"""Folders with depth in the layouts of others, by their documents: the first of two photographs has the planted one."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path

import av
import numpy as np
import OpenEXR

from mapless.geometry import Array, Camera, RigidTransform, rotation_from_vector
from mapless_tools.ingest.formats.icl_nuim import CAMERA as ICL_CAMERA
from mapless_tools.ingest.formats.seven_scenes import CAMERA_FROM_DEPTH_CAMERA, DEPTH_CAMERA
from mapless_tools.ingest.formats.writing import PosedImage, model_texts
from support.depths import planted_depth_m, planted_png, png
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


def colmap_dense(folder: Path) -> Path:
    """The workspace of a dense reconstruction: undistorted images, their model, and maps of half their size."""
    for i in range(len(TRUTH.poses)):
        write_image(folder / "images" / f"cam/{i}.png", seed=i)
    images = [PosedImage(f"cam/{i}.png", CAMERA, pose) for i, pose in enumerate(TRUTH.poses)]
    (folder / "sparse").mkdir()
    for name, text in model_texts(images).items():
        (folder / "sparse" / name).write_text(text)
    maps = folder / "stereo" / "depth_maps" / "cam"
    maps.mkdir(parents=True)
    (maps / "0.png.geometric.bin").write_bytes(colmap_map(_with_hole(planted_depth_m(CAMERA.resized(48, 32)))))
    return folder


def colmap_map(depth: Array) -> bytes:
    """A depth map as COLMAP writes it."""
    return f"{depth.shape[1]}&{depth.shape[0]}&1&".encode() + depth.astype("<f4").tobytes()


def kapture(folder: Path) -> Path:
    """A rig with a camera and, beside it, a depth sensor, whose depth is there raw and registered to the camera."""
    sensors = folder / "sensors"
    raw = Camera(64, 48, 57.2, 57.5, 31.5, 23.5)
    poses = [pose.compose(BESIDE) for pose in TRUTH.poses]  # the rig's are the depth sensor's
    for i in range(len(poses)):
        write_image(sensors / "records_data" / f"{i}.png", seed=i)
    rows = {
        "sensors": [
            f"colour, , camera, {_pinhole(CAMERA)}",
            f"raw, kinect, depth, {_pinhole(raw)}",
            f"reg, , depth, {_pinhole(CAMERA)}",
        ],
        "rigs": [f"rig, {it}, {_inverse_words(BESIDE.inverse())}" for it in ("colour", "reg")]
        + [f"rig, raw, {_inverse_words(RigidTransform.identity())}"],
        "trajectories": [f"{i}, rig, {_inverse_words(pose)}" for i, pose in enumerate(poses)],
        "records_camera": [f"{i}, colour, {i}.png" for i in range(len(poses))],
        "records_depth": ["0, raw, 0.depth", "0, reg, 0.depth.reg"],
    }
    for name, lines in rows.items():
        (sensors / f"{name}.txt").write_text("\n".join(["# kapture format: 1.1", *lines]) + "\n")
    for path, depth in (("0.depth.reg", planted_depth_m(CAMERA)), ("0.depth", planted_depth_m(raw, BESIDE))):
        (sensors / "records_data" / path).write_bytes(_with_hole(depth).astype("<f4").tobytes())
    return folder


def record3d(folder: Path) -> Path:
    """Numbers 0 and 2 of three; the pixel without a value is NaN."""
    poses = [TRUTH.poses[0], RigidTransform.identity(), TRUTH.poses[1]]
    content: dict[str, object] = {"w": 96, "h": 64, "K": [99.0, 0, 0, 0, 99.0, 0, 9.0, 9.0, 1]}
    content["perFrameIntrinsicCoeffs"] = [[80.0, 81.0, 47.75, 31.25]] * 3
    rows = []
    for pose in poses:
        turned = RigidTransform.from_matrix(opengl(pose))
        q = turned.quaternion()
        rows.append([q.x, q.y, q.z, q.w, *turned.translation.tolist()])
    for number in (0, 2):
        write_image(folder / "rgb" / f"{number}.jpg", seed=number)
    (folder / "metadata.json").write_text(json.dumps(content | {"poses": rows}))
    depth = planted_depth_m(CAMERA.resized(48, 32))
    depth[0, 0] = np.nan
    write_exr(folder / "depth" / "0.exr", {"R": depth.astype(np.float32)})
    return folder


def write_exr(file: Path, channels: Mapping[str, np.ndarray]) -> None:
    """An EXR of these channels, compressed as Record3D's."""
    file.parent.mkdir(exist_ok=True)
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    OpenEXR.File(header, dict(channels)).write(str(file))


def stray_scanner(folder: Path) -> Path:
    """A video of three frames, of which the odometry has numbers 0 and 2."""
    folder.mkdir(exist_ok=True)
    with av.open(str(folder / "rgb.mp4"), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.width, stream.height, stream.pix_fmt = 96, 64, "yuv420p"
        for i in range(3):
            frame = av.VideoFrame.from_ndarray(textured(seed=i), format="rgb24")
            container.mux(stream.encode(frame))
        container.mux(stream.encode())
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for number, pose in zip((0, 2), TRUTH.poses, strict=True):
        q, t = pose.quaternion(), pose.translation.tolist()
        rows.append(", ".join([f"{100 + number / 30}", f"{number:06d}", *map(repr, [*t, q.x, q.y, q.z, q.w])]))
    (folder / "odometry.csv").write_text("\n".join(rows) + "\n")
    (folder / "camera_matrix.csv").write_text("80.0, 0.0, 47.75\n0.0, 81.0, 31.25\n0.0, 0.0, 1.0\n")
    camera = CAMERA.resized(48, 32)
    for name, file in (("depth", planted_png(camera, hole=9999)), ("confidence", png(_confidence(camera, (0, 1, 2))))):
        (folder / name).mkdir()
        (folder / name / "000000.png").write_bytes(file)
    return folder


LAYOUTS: Mapping[str, Callable[[Path], Path]] = {
    "7scenes": seven_scenes,
    "12scenes": twelve_scenes,
    "icl": icl_nuim,
    "arkit": polycam,
    "colmap": colmap_dense,
    "record3d": record3d,
    "stray": stray_scanner,
    "kapture": kapture,
}


def _with_hole(depth: Array) -> Array:
    depth = depth.copy()
    depth[0, 0] = 0
    return depth


def _pinhole(camera: Camera) -> str:
    k = camera
    numbers = f"{k.focal_x_px}, {k.focal_y_px}, {k.principal_x_px + 0.5}, {k.principal_y_px + 0.5}"
    return f"PINHOLE, {k.width_px}, {k.height_px}, {numbers}"


def _inverse_words(pose: RigidTransform) -> str:
    q, t = pose.inverse().quaternion(), pose.inverse().translation.tolist()
    return ", ".join(map(repr, [q.w, q.x, q.y, q.z, *t]))


def _confidence(camera: Camera, kinds: tuple[int, int, int]) -> np.ndarray:
    values = np.full((camera.height_px, camera.width_px), kinds[2], np.uint8)
    values[::2] = kinds[1]
    values[0, 0] = kinds[0]
    return values


def _words(numbers: Array) -> str:
    return " ".join(map(repr, np.asarray(numbers, float).ravel().tolist()))
