"""Our own layout: ``images/`` and ``cameras.json``.

`cameras.json` holds ``frames``, a list of objects with ``image`` (path from the folder), ``width`` and ``height``,
``K`` (3x3, pixels, (0, 0) the centre of the top-left one), ``dist`` (OpenCV's k1 k2 p1 p2 [k3], or null) and
``world_from_camera`` (4x4, camera axes x right, y down, z forward), perhaps also ``split`` ("train" or "test"),
``lens`` ("fisheye": dist is then OpenCV's fisheye k1 k2 k3 k4), ``mask`` (path of a PNG that is 0 at the pixels to
ignore), ``depth`` (see `depths`) and ``provenance`` (how the pose is known: ``source``, "given" or "placed", and the
radii of its errors, ``position_68_m``, ``position_95_m``, ``rotation_68_deg``, ``rotation_95_deg``); and beside them
``metric`` (false: the unit of length is arbitrary), ``source``, ``ground_truth``, ``datum`` (where the world is on the
Earth, `mapless.geodesy.Datum`: ``latitude_deg``, ``longitude_deg``, ``height_m``, perhaps ``enu_from_world`` with
``x y z w``) and ``down_in_world``.
"""

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mapless.cameras import FOLDER_FILE, camera_of_frame
from mapless.geometry import RigidTransform
from mapless.provenance import provenance_from_json
from mapless_tools.dataset import Dataset, finite_numbers, image_file, named, printable, read_json, read_place

from .collecting import Collector, ReadOptions
from .depths import depth_of_frame

_NOTHING: Mapping[Any, Any] = MappingProxyType({})


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return (path / FOLDER_FILE).is_file()


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`. Images are not opened."""
    file = path / FOLDER_FILE
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list) or not content["frames"]:
        raise ValueError(f"{file}: frames must be a list with at least one frame")
    metric = content.get("metric", True)
    if not isinstance(metric, bool):
        raise ValueError(f"{file}: metric must be true or false")
    collector = Collector(path, options.depths)
    names = _names(path, content["frames"])
    for index, entry in enumerate(content["frames"]):
        image = entry.get("image", "?") if isinstance(entry, dict) else "?"
        with collector.attempt(f"{FOLDER_FILE}: frames[{index}] ({image})"):
            add_frame(collector, entry, names, content)
    texts = {it: printable(str(content[it])) for it in ("source", "ground_truth") if isinstance(content.get(it), str)}
    dataset = collector.dataset(path.resolve().name, "cameras", metric=metric, **texts)
    datum, down_in_world = read_place(file, content)
    return replace(dataset, datum=datum, down_in_world=down_in_world)


def _names(folder: Path, entries: Sequence[Any]) -> dict[Path, str]:
    """Names of the frames by their files: those of the files, with the folders in which files of one name differ.

    `images/cam0/1.jpg` and `images/cam1/1.jpg` are `cam0_1` and `cam1_1`, in whatever order they are listed.
    """
    files = set()
    for entry in entries:
        with suppress(ValueError, TypeError, KeyError):  # what is wrong with it is said where it is added
            files.add(image_file(folder, entry["image"]))
    of_stem: dict[str, list[Path]] = {}
    for file in files:
        of_stem.setdefault(file.stem, []).append(file)
    names = {}
    for stem, same in of_stem.items():
        parents = [file.relative_to(folder).parent.parts for file in same]
        shared = sum(1 for _ in takewhile(lambda level: len(set(level)) == 1, zip(*parents, strict=False)))
        for file, parts in zip(same, parents, strict=True):
            names[file] = "_".join([*parts[shared:], stem]) if len(same) > 1 else stem
    return names


def read_folder(path: Path) -> Dataset:
    """Reads the frames of a folder, all of which must be right; ValueError names the frame and the wrong field."""
    dataset = read(path, ReadOptions())
    if dataset.refused:
        raise ValueError(f"{path}: {dataset.refused[0].frame}: {dataset.refused[0].reason}")
    return dataset


def add_frame(
    collector: Collector,
    entry: Any,
    names: Mapping[Path, str] = _NOTHING,
    beside: Mapping[str, Any] = _NOTHING,
) -> None:
    """Adds an entry of `frames`, named by its file, or as the file itself; ValueError names the wrong field.

    `beside` has what is said of the depths of all frames.
    """
    if not isinstance(entry, dict):
        raise ValueError("must be an object")
    image = entry.get("image")
    if not isinstance(image, str) or not image:
        raise ValueError("image must be a path")
    if "world_from_camera" not in entry:
        raise ValueError("world_from_camera is missing")
    with named("world_from_camera"):
        pose = RigidTransform.from_matrix(finite_numbers(entry["world_from_camera"], "it", (4, 4)))
    camera = camera_of_frame(entry)
    if not (camera.focal_x_px > 0 and camera.focal_y_px > 0):
        raise ValueError(f"K: focal lengths must be above 0, are {camera.focal_x_px:g} and {camera.focal_y_px:g}")
    with named("provenance"):
        provenance = provenance_from_json(entry.get("provenance"))
    file = collector.image(image)
    depth = None if collector.depths.no_depth else depth_of_frame(collector.folder, entry, beside)
    name = names.get(file, file.stem)
    collector.add(image, camera, pose, entry.get("split", ""), name, entry.get("mask"), provenance, depth)
