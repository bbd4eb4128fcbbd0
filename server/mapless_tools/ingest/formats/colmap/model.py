"""A COLMAP model in memory, and where models are on the disk."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.geometry import Array, Camera, Quaternion, RigidTransform

from .cameras import ColmapCamera
from .files import ImageRecord, read_cameras, read_images


@dataclass(frozen=True, eq=False)
class Model:
    """Cameras by COLMAP's id, images by name, and names that occur twice, each with the reason."""

    file: Path
    cameras: Mapping[int | str, ColmapCamera]
    images: Mapping[str, ImageRecord]
    refused: Sequence[tuple[str, str]]

    def camera_and_pose(self, name: str) -> tuple[Camera, RigidTransform]:
        """Camera and world_from_camera of an image; ValueError if they cannot be used."""
        if name not in self.images:
            raise ValueError(f"{self.file} has no image {name}")
        image = self.images[name]
        if image.camera_id not in self.cameras:
            raise ValueError(f"image {image.image_id}: there is no camera {image.camera_id}")
        return self.cameras[image.camera_id].camera(), _world_from_camera(image)


def find_models(path: Path) -> list[Path]:
    """Finds folders with models: the folder itself, or the usual places in it."""
    for places in ([path], [path / "sparse"], _numbered(path / "sparse"), _numbered(path / "colmap" / "sparse")):
        found = [place for place in places if find_model(place) is not None]
        if found:
            return found
    return []


def find_model(folder: Path) -> str | None:
    """The ending of the model's files in a folder, None without a model; binary if both exist, as in COLMAP."""
    for ending in (".bin", ".txt"):
        if all((folder / f"{name}{ending}").is_file() for name in ("cameras", "images")):
            return ending
    return None


def read_model(folder: Path) -> Model:
    """Reads a model; ValueError, naming file and record, if it is malformed."""
    ending = find_model(folder)
    if ending is None:
        raise ValueError(f"{folder} holds no COLMAP model")
    cameras_file, images_file = folder / f"cameras{ending}", folder / f"images{ending}"
    cameras: dict[int | str, ColmapCamera] = {}
    for camera in read_cameras(cameras_file):
        if camera.camera_id in cameras:
            raise ValueError(f"{cameras_file}: camera {camera.camera_id} occurs twice")
        cameras[camera.camera_id] = camera
    images: dict[str, ImageRecord] = {}
    refused: list[tuple[str, str]] = []
    for record in read_images(images_file):
        if record.name in images:
            refused.append((record.name, f"{images_file}: image {record.image_id}: its name occurs twice"))
        else:
            images[record.name] = record
    return Model(images_file, cameras, images, refused)


def _numbered(folder: Path) -> list[Path]:
    return sorted(place for place in folder.iterdir() if place.name.isdecimal()) if folder.is_dir() else []


def _world_from_camera(image: ImageRecord) -> RigidTransform:
    w, x, y, z, *translation = image.pose
    q: Array = np.array([x, y, z, w])
    norm = float(np.linalg.norm(q))
    if not (np.isfinite(image.pose).all() and norm > 0.5):
        raise ValueError(f"image {image.image_id}: its pose {tuple(image.pose)} is none")
    # COLMAP normalizes what it reads, so quaternions need not have norm one.
    rotation = Quaternion(*(q / norm).tolist()).matrix()
    return RigidTransform(rotation, np.array(translation)).inverse()
