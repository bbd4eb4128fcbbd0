"""Folders of photographs in the layouts of others, hand-built from one planted truth.

The planted cameras stand on a circle and look at its middle; nothing of theirs is round, so that a sign, an order of
axes or half a pixel that is wrong shows.
"""

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.ingest.formats.seven_scenes import CAMERA_FROM_DEPTH_CAMERA
from mapless_tools.ingest.formats.writing import LAYOUTS, PosedImage
from support.images import encode, textured

CAMERA = Camera(96, 64, 80.0, 81.0, 47.25, 30.75)


@dataclass(frozen=True, eq=False)
class Truth:
    """The content that a layout is built from, and that must come back."""

    poses: tuple[RigidTransform, ...]
    camera: Camera = CAMERA


def truth(count: int = 4, camera: Camera = CAMERA) -> Truth:
    """Poses that differ in everything."""
    poses = tuple(
        RigidTransform(rotation_from_vector([0.2 + 0.1 * i, -0.7 * i, 0.15]), np.array([1.5 * i, -0.25, 2.0 - 0.3 * i]))
        for i in range(count)
    )
    return Truth(poses, camera)


def write_image(file: Path, seed: int = 0, width: int = 96, height: int = 64) -> None:
    """A small photograph that no other has the pixels of."""
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(encode(file.suffix, textured(width, height, seed=seed)))


def write_cameras(
    folder: Path, shots: Iterable[tuple[NDArray[np.uint8], RigidTransform]], camera: Camera, suffix: str = ".png"
) -> Path:
    """A folder of photographs images/0.png, images/1.png and so on, with a cameras.json in metres."""
    (folder / "images").mkdir(parents=True)
    frames = []
    for i, (image, pose) in enumerate(shots):
        (folder / f"images/{i}{suffix}").write_bytes(encode(suffix, image))
        size = {"width": camera.width_px, "height": camera.height_px, "K": camera.matrix().tolist(), "dist": None}
        frames.append({"image": f"images/{i}{suffix}", "world_from_camera": pose.matrix().tolist()} | size)
    (folder / "cameras.json").write_text(json.dumps({"metric": True, "source": "planted", "frames": frames}))
    return folder


def write_layout(folder: Path, layout: str, planted: Truth) -> Path:
    """A folder in one of the layouts that are written; the folder."""
    images = []
    for i, pose in enumerate(planted.poses):
        write_image(folder / LAYOUTS[layout].images / f"{i}.png", seed=i)
        images.append(PosedImage(f"{i}.png", planted.camera, pose))
    for path, text in LAYOUTS[layout].files(images, "a test").items():
        (folder / path).parent.mkdir(parents=True, exist_ok=True)
        (folder / path).write_text(text)
    return folder


def opengl(pose: RigidTransform) -> np.ndarray:
    """The 4x4 of a pose with OpenGL's camera axes."""
    return pose.matrix() @ np.diag([1.0, -1.0, -1.0, 1.0])


def assert_same_camera(camera: Camera, expected: Camera, px: float = 1e-9) -> None:
    """Sizes exactly, intrinsics to `px`."""
    assert (camera.width_px, camera.height_px) == (expected.width_px, expected.height_px)
    np.testing.assert_allclose(camera.matrix(), expected.matrix(), atol=px)
    assert type(camera.distortion) is type(expected.distortion)
    if camera.distortion is not None and expected.distortion is not None:
        np.testing.assert_allclose(
            list(vars(camera.distortion).values()), list(vars(expected.distortion).values()), atol=1e-12
        )


def assert_same_pose(pose: RigidTransform, expected: RigidTransform, tolerance: float = 1e-9) -> None:
    """Equal to rounding, or to the digits that a layout writes."""
    np.testing.assert_allclose(pose.matrix(), expected.matrix(), atol=tolerance)


def assert_reads(dataset: Dataset, planted: Truth, tolerance: float = 1e-9) -> None:
    """The dataset is the planted truth, in order, and nothing was refused."""
    assert dataset.refused == ()
    assert len(dataset.frames) == len(planted.poses)
    for frame, pose in zip(dataset.frames, planted.poses, strict=True):
        assert_same_pose(frame.world_from_camera, pose, tolerance)
        assert_same_camera(frame.camera, planted.camera)
        assert frame.image_path.is_file()


def reasons(dataset: Dataset) -> dict[str, str]:
    """Why frames were refused."""
    return {refusal.frame: refusal.reason for refusal in dataset.refused}


def by_name(dataset: Dataset) -> dict[str, Frame]:
    """Frames by their ids."""
    return {frame.name: frame for frame in dataset.frames}


Shots = Sequence[tuple[NDArray[np.uint8], RigidTransform]]


def write_seven_scenes(scene: Path, references: Shots, queries: Shots) -> Path:
    """References are sequence 1, queries sequence 2; poses are those of the depth camera."""
    for number, shots in enumerate((references, queries), 1):
        for i, (image, pose) in enumerate(shots):
            shot = image, pose.compose(CAMERA_FROM_DEPTH_CAMERA)
            _write_posed(scene / f"seq-{number:02d}" / f"frame-{i:06d}", ".png", shot)
    (scene / "TrainSplit.txt").write_text("sequence1\n")
    (scene / "TestSplit.txt").write_text("sequence2\n\n")
    return scene


def write_twelve_scenes(room: Path, camera: Camera, queries: Shots, references: Shots) -> Path:
    """The first sequence is that of the queries."""
    for i, shot in enumerate([*queries, *references]):
        _write_posed(room / "data" / f"frame-{i:06d}", ".jpg", shot)
    first, end = len(queries), len(queries) + len(references)
    (room / "split.txt").write_text(
        f"sequence0 [frames={first}]  [start=0 ; end={first - 1}]\n"
        f"sequence1 [frames={end - first}]  [start={first} ; end={end - 1}]\n"
    )
    k = np.eye(4)
    k[:3, :3] = camera.matrix()
    (room / "info.txt").write_text(
        "m_versionNumber = 4\nm_sensorName = StructureSensor\n"
        f"m_colorWidth = {camera.width_px}\nm_colorHeight = {camera.height_px}\n"
        f"m_calibrationColorIntrinsic = {' '.join(map(str, k.ravel()))} \n"
    )
    return room


def write_cambridge(
    scene: Path, references: Shots, queries: Shots, focals_px: Sequence[float], distortion: float = 0.0
) -> Path:
    """References are sequence 1, queries sequence 2; VisualSFM's model has a focal length for each photograph."""
    cameras: list[str] = []
    for number, (split, shots) in enumerate({"train": references, "test": queries}.items(), 1):
        rows = ["Visual Landmark Dataset V1", "ImageFile, Camera Position [X Y Z W P Q R]", ""]
        for image, pose in shots:
            name = f"seq{number}/frame{len(cameras):05d}"
            (scene / name).parent.mkdir(parents=True, exist_ok=True)
            (scene / f"{name}.png").write_bytes(encode(".png", image))
            q, centre = pose.inverse().quaternion(), " ".join(map(str, pose.translation))
            rotation = f"{q.w:.9f} {q.x:.9f} {q.y:.9f} {q.z:.9f}"
            rows.append(f"{name}.png {centre} {rotation}")
            cameras.append(f"{name}.jpg\t{focals_px[len(cameras)]} {rotation} {centre} {distortion} 0")
        (scene / f"dataset_{split}.txt").write_text("\n".join(rows) + "\n")
    (scene / "reconstruction.nvm").write_text("\n".join(["NVM_V3 ", "", str(len(cameras)), *cameras, "", "0", ""]))
    return scene


def _write_posed(file: Path, ending: str, shot: tuple[NDArray[np.uint8], RigidTransform]) -> None:
    image, pose = shot
    file.parent.mkdir(parents=True, exist_ok=True)
    file.with_name(f"{file.name}.color{ending}").write_bytes(encode(ending, image))
    rows = ("\t".join(f"{x: .10e}" for x in row) + "\t" for row in pose.matrix())
    file.with_name(f"{file.name}.pose.txt").write_text("\n".join(rows) + "\n")
