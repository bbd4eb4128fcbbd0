"""A folder of photographs with known poses: ``images/`` and ``cameras.json``.

`cameras.json` holds ``frames``, a list of objects with ``image`` (path from the folder), ``width`` and ``height``,
``K`` (3x3, pixels, (0, 0) the centre of the top-left one), ``dist`` (OpenCV's k1 k2 p1 p2 [k3], or null) and
``world_from_camera`` (4x4, camera axes x right, y down, z forward); and beside them ``metric`` (false: the unit of
length is arbitrary) and ``source``.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mapless.geometry import Array, Camera, RadialTangential, RigidTransform

MAX_NAME_LENGTH = 128


@dataclass(frozen=True, eq=False)
class Frame:
    """A photograph whose pose is known.

    Attributes:
        name: unique in its dataset, and a legal reference id.
        image_path: the file; its EXIF orientation is not to be applied.
        camera: with the distortion of the file's pixels.
        world_from_camera: metres, or the dataset's unit when it is not metric.
    """

    name: str
    image_path: Path
    camera: Camera
    world_from_camera: RigidTransform


@dataclass(frozen=True)
class Dataset:
    """Frames of one place, in one world frame.

    Attributes:
        name: of the folder.
        frames: in the order of the file.
        metric: whether lengths are metres.
        source: where the photographs come from; empty if the file does not say.
    """

    name: str
    frames: tuple[Frame, ...]
    metric: bool
    source: str


def read_folder(path: Path) -> Dataset:
    """Read the frames of a folder; images are not opened.

    Raises:
        ValueError: no `cameras.json`, or something in it is missing or malformed; the message names frame and field.
    """
    file = path / "cameras.json"
    try:
        content = json.loads(file.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"{file} cannot be read: {error.strerror}") from error
    except ValueError as error:
        raise ValueError(f"{file} is not JSON: {error}") from error
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list) or not content["frames"]:
        raise ValueError(f"{file}: frames must be a list with at least one frame")
    if not isinstance(content.get("metric", True), bool):
        raise ValueError(f"{file}: metric must be true or false")
    frames: list[Frame] = []
    taken: set[str] = set()
    for index, entry in enumerate(content["frames"]):
        try:
            frame = _frame(path, entry, taken)
        except ValueError as error:
            label = entry.get("image", "?") if isinstance(entry, dict) else "?"
            raise ValueError(f"{file}: frames[{index}] ({label}): {error}") from error
        taken.add(frame.name)
        frames.append(frame)
    name = path.resolve().name
    return Dataset(name, tuple(frames), content.get("metric", True), str(content.get("source", "")))


def reference_id(image: str, taken: set[str]) -> str:
    """The image path's stem as a legal reference id that is not `taken` yet."""
    stem = re.sub(r"\.{2,}|[^A-Za-z0-9._-]", "_", Path(image).stem)
    stem = re.sub(r"^[.-]|[.-]$", "_", stem[: MAX_NAME_LENGTH - 8])
    name, copy = stem, 2
    while name in taken:
        name, copy = f"{stem}_{copy}", copy + 1
    return name


def _frame(folder: Path, entry: object, taken: set[str]) -> Frame:
    if not isinstance(entry, dict):
        raise ValueError("must be an object")
    image = entry.get("image")
    if not isinstance(image, str) or not image:
        raise ValueError("image must be a path")
    if not (folder / image).is_file():
        raise ValueError(f"image: there is no file {folder / image}")
    try:
        pose = RigidTransform.from_matrix(_numbers(entry, "world_from_camera", (4, 4)))
    except ValueError as error:
        raise ValueError(f"world_from_camera: {error}") from error
    return Frame(reference_id(image, taken), folder / image, _camera(entry), pose)


def _camera(entry: Mapping[str, Any]) -> Camera:
    for side in ("width", "height"):
        if not isinstance(entry.get(side), int) or isinstance(entry[side], bool) or entry[side] < 1:
            raise ValueError(f"{side} must be a whole number of pixels")
    k = _numbers(entry, "K", (3, 3))
    if not (k[0, 0] > 0 and k[1, 1] > 0):
        raise ValueError("K: focal lengths must be above 0")
    if abs(k[0, 1]) > 1e-6 or abs(k[1, 0]) > 1e-6 or not np.allclose(k[2], [0, 0, 1]):
        raise ValueError("K must be [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]")
    distortion = None
    if entry.get("dist") is not None:
        coefficients = _numbers(entry, "dist", None)
        if coefficients.shape not in ((4,), (5,)):
            raise ValueError("dist must be null or have 4 or 5 coefficients (k1 k2 p1 p2 [k3])")
        if coefficients.any():
            distortion = RadialTangential(*coefficients.tolist())
    focal_x, focal_y, principal_x, principal_y = k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()
    return Camera(entry["width"], entry["height"], focal_x, focal_y, principal_x, principal_y, distortion)


def _numbers(entry: Mapping[str, Any], field: str, shape: tuple[int, ...] | None) -> Array:
    if field not in entry:
        raise ValueError(f"{field} is missing")
    try:
        values = np.array(entry[field], dtype=float)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{field} must be numbers") from error
    if shape is not None and values.shape != shape:
        raise ValueError(
            f"{field} must be {'x'.join(map(str, shape))}, is {'x'.join(map(str, values.shape)) or 'a scalar'}"
        )
    if not np.isfinite(values).all():
        raise ValueError(f"{field} is not finite")
    return values
