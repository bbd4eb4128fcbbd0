"""COLMAP models: cameras and images, in text or binary; points are not needed.

`images` gives camera_from_world for every image, also in the models of COLMAP 3.12 and later, which have rigs and
frames beside it; so those two are not read. Principal points count from the corner of the top-left pixel: half a
pixel is taken off here, and put back by `writing`.
"""

import os
from pathlib import Path

from mapless_tools.dataset import Dataset

from ..collecting import Collector, natural_order, read_text
from ..options import ReadOptions
from .model import Model, find_models, read_model

__all__ = ["fits", "read"]

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
    collector = Collector(images)
    queries = folders[0] / "list_test.txt"  # hloc's name
    lines = read_text(queries).splitlines() if queries.is_file() else []
    tests = {line.strip() for line in lines} - {""}  # one a line: COLMAP's names may have spaces
    for name in sorted(model.images, key=natural_order):
        with collector.attempt(name):
            camera, pose = model.camera_and_pose(name)
            collector.add(name, camera, pose, ("test" if name in tests else "train") if tests else "")
    for name, reason in model.refused:
        with collector.attempt(name):
            raise ValueError(reason)
    return collector.dataset(
        path.resolve().name, "colmap", metric=False, source=f"COLMAP model {folders[0]}", ground_truth="SfM (COLMAP)"
    )


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
    found = {place: sum(os.path.isfile(place / name) for name in names) for place in places}
    best = max(found, key=lambda place: found[place])
    if names and not found[best]:
        raise ValueError(
            f"{path}: the images that the model names ({names[0]} and so on) are not in {places[0]}; give their folder "
            "with --images"
        )
    return best
