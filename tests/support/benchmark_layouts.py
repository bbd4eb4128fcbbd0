"""7-Scenes, 12-Scenes and Cambridge Landmarks as their authors lay them out, from photographs and their poses."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform
from support.images import encode

Shots = Sequence[tuple[NDArray[np.uint8], RigidTransform]]


def write_seven_scenes(scene: Path, references: Shots, queries: Shots) -> Path:
    """References are sequence 1, queries sequence 2."""
    for number, shots in enumerate((references, queries), 1):
        for i, shot in enumerate(shots):
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
