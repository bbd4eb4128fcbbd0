"""COLMAP models: cameras and images, in text or binary; points are not needed.

`images` gives camera_from_world for every image, also in the models of COLMAP 3.12 and later, which have rigs and
frames beside it; so those two are not read. Principal points count from the corner of the top-left pixel: half a
pixel is taken off here, and put back by `writing`.
"""

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from mapless.cameras import with_slashes
from mapless.geometry import Array, Camera, Quaternion, RigidTransform
from mapless.masks import FOLDER as MASKS
from mapless.names import shown
from mapless_tools.dataset import Dataset

from ..collecting import Collector, ReadOptions, natural_order, text_lines
from ..masks import with_own_masks
from .cameras import ColmapCamera
from .depth_maps import depth_of_image, find_depths
from .files import ImageRecord, announced, read_cameras, read_images


@dataclass(frozen=True, eq=False)
class Model:
    """Cameras by COLMAP's id, images by name, and names that occur twice, each with the reason.

    `notes` say where the counts in the files' comments are not those of their lines.
    """

    file: Path
    cameras: Mapping[int | str, ColmapCamera]
    images: Mapping[str, ImageRecord]
    refused: Sequence[tuple[str, str]]
    notes: Sequence[str] = ()

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
    notes: list[str] = []
    if ending == ".txt":
        counted = ((cameras_file, len(cameras)), (images_file, len(images) + len(refused)))
        notes = [
            f"{file} announces {number} in its comments, and holds {count}: is a part missing?"
            for file, count in counted
            if (number := announced(file)) not in (None, count)
        ]
    return Model(images_file, cameras, images, refused, notes)


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


_SAMPLE = 50


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return bool(find_models(path))


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    folders = find_models(path)
    if not folders:
        raise ValueError(f"{path} holds no COLMAP model: cameras and images, .bin or .txt, here or in sparse/")
    if len(folders) > 1:
        raise ValueError(f"{path} holds several COLMAP models: {', '.join(map(str, folders))}; name one")
    model = read_model(folders[0])
    images = _images_folder(path, folders[0], model, options.images)
    collector = Collector(images, options.depths)
    queries = folders[0] / "list_test.txt"  # hloc's name
    lines = text_lines(queries) if queries.is_file() else ()
    tests = {line.strip() for _, line in lines} - {""}  # one a line: COLMAP's names may have spaces
    if unknown := sorted(tests - set(model.images)):
        first = shown(unknown[0])
        collector.notes.append(f"{len(unknown)} names of {queries} are no images of the model, such as {first}")
    collector.notes += model.notes
    depths = find_depths(path, images.parent)
    for name in sorted(model.images, key=natural_order):
        with collector.attempt(name):
            camera, pose = model.camera_and_pose(name)
            depth = depth_of_image(collector, depths, name, (camera.width_px, camera.height_px))
            collector.add(name, camera, pose, ("test" if name in tests else "train") if tests else "", depth=depth)
    for name, reason in model.refused:
        with collector.attempt(name):
            raise ValueError(reason)
    dataset = collector.dataset(
        path.resolve().name, "colmap", metric=False, source=f"COLMAP model {folders[0]}", ground_truth="SfM (COLMAP)"
    )
    return with_own_masks(dataset, images, images.parent / MASKS)


def _images_folder(path: Path, model_folder: Path, model: Model, given: Path | None) -> Path:
    """The folder of the images: of the usual places, the one that has most of them."""
    if given is not None:
        if not given.is_dir():
            raise ValueError(f"images: there is no folder {given}")
        return given
    names = sorted(model.images)[:: max(1, len(model.images) // _SAMPLE)]
    places = [path / "images", *(parent / "images" for parent in (model_folder, *model_folder.resolve().parents[:2]))]
    places += [path, model_folder]
    # Not Path.is_file, which raises where a name is longer than any file's.
    found = {place: sum(os.path.isfile(place / with_slashes(place, name)) for name in names) for place in places}
    best = max(found, key=lambda place: found[place])
    if names and not found[best]:
        raise ValueError(
            f"{path}: the images that the model names ({names[0]} and so on) are not in {places[0]}; give their folder "
            "with --images"
        )
    return best
