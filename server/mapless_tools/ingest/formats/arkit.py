"""Captures of ARKit (and of ARCore apps that write the same), in two layouts that apps export.

3D Scanner App ("all data"): frame_00000.jpg beside frame_00000.json, which has `cameraPoseARFrame` (16 numbers, a
4x4 world_from_camera row by row) and `intrinsics` (9 numbers, K row by row). Only some of the .json files have a
photograph.

Polycam (raw data): keyframes/images/*.jpg and keyframes/cameras/*.json of the same names, or, where the app has
improved the poses, keyframes/corrected_images and keyframes/corrected_cameras, which are then taken. The .json has
`t_00` to `t_23` (rows of world_from_camera), `fx`, `fy`, `cx`, `cy`, `width`, `height`. keyframes/depth/*.png of the
same names has the depth of a phone with LiDAR, 192x256 values in millimetres of the same camera, and
keyframes/confidence/*.png how certain they are: 0, 127 or 255.

Camera axes are OpenGL's, x along the longer side of the sensor: poses and intrinsics belong to the stored landscape
raster whichever way the phone was held. Apple counts principal points from the corner of the top-left pixel.
"""

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from mapless.depth import DepthSensor
from mapless.geometry import Array, Camera, RigidTransform
from mapless_tools.dataset import Dataset, DepthFile, finite_numbers, named, read_json

from .collecting import Collector, ReadOptions, from_corner, from_opengl, natural_order, size_of

_POLYCAM = (("corrected_images", "corrected_cameras"), ("images", "cameras"))
_IMAGE_ENDS = (".jpg", ".jpeg", ".png")
_CASES = tuple(written for end in _IMAGE_ENDS for written in (end, end.upper()))
POLYCAM_MIN_CONFIDENCE = 127
"""The middle of three values: 0, 127, 255."""
_SCANNER_FRAME = re.compile(r"frame_\d+")


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return _polycam(path) is not None or next(_scanner_images(path), None) is not None


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    collector = Collector(path, options.depths)
    folders = _polycam(path)
    if folders is not None:
        images, cameras = (path / "keyframes" / name for name in folders)
        files = [(image, cameras / f"{image.stem}.json") for image in _images(images)]
        parse = _polycam_frame
        if folders == _POLYCAM[-1]:
            collector.notes.append("these are the phone's own poses, which drift; there are no corrected ones")
    else:
        files = [(image, image.with_suffix(".json")) for image in _images(path) if _SCANNER_FRAME.fullmatch(image.stem)]
        parse = _scanner_frame
        collector.notes.append("these are the phone's own poses, which drift")
    for image, file in files:
        relative = image.relative_to(path).as_posix()
        with collector.attempt(relative):
            camera, pose = _frame(file, size_of(image), parse)
            depth = None if folders is None else _polycam_depth(collector, image)
            collector.add(relative, camera, from_opengl(pose), name=image.stem, depth=depth)
    return collector.dataset(path.resolve().name, "arkit", metric=True, source="ARKit", ground_truth="device tracking")


Parse = Callable[[Mapping[str, Any], tuple[int, int]], tuple[Camera, RigidTransform]]
"""Camera and pose, with OpenGL's axes, of what a .json holds and the image's size."""


def _frame(file: Path, size: tuple[int, int], parse: Parse) -> tuple[Camera, RigidTransform]:
    if not file.is_file():
        raise ValueError(f"pose: there is no file {file}")
    content = read_json(file)
    if not isinstance(content, dict):
        raise ValueError(f"{file} must hold an object")
    with named(f"{file.name}"):
        camera, pose = parse(content, size)
    return from_corner(camera), pose


def _polycam(path: Path) -> tuple[str, str] | None:
    keyframes = path / "keyframes"
    return next((pair for pair in _POLYCAM if all((keyframes / name).is_dir() for name in pair)), None)


def _polycam_depth(collector: Collector, image: Path) -> DepthFile | None:
    depth, confidence = (Path(f"keyframes/{folder}/{image.stem}.png") for folder in ("depth", "confidence"))
    if not (collector.folder / depth).is_file():
        return None
    certain = confidence if (collector.folder / confidence).is_file() else None
    file = DepthFile(
        depth, 0.001, DepthSensor.PHONE_LIDAR, confidence_path=certain, min_confidence=POLYCAM_MIN_CONFIDENCE
    )
    return collector.depth(file, size_of(image))


def _images(folder: Path) -> list[Path]:
    found = [file for file in folder.iterdir() if file.suffix.lower() in _IMAGE_ENDS]
    return sorted(found, key=lambda file: natural_order(file.name))


def _scanner_images(path: Path) -> Any:
    return (
        file
        for file in path.glob("frame_*.json")
        if _SCANNER_FRAME.fullmatch(file.stem) and any(file.with_suffix(end).is_file() for end in _CASES)
    )


def _scanner_frame(content: Mapping[str, Any], size: tuple[int, int]) -> tuple[Camera, RigidTransform]:
    k = _numbers(content, "intrinsics", 9).reshape(3, 3)
    with named("cameraPoseARFrame"):
        pose = RigidTransform.from_matrix(_numbers(content, "cameraPoseARFrame", 16).reshape(4, 4))
    return Camera(*size, *k[[0, 1, 0, 1], [0, 1, 2, 2]].tolist()), pose


def _polycam_frame(content: Mapping[str, Any], size: tuple[int, int]) -> tuple[Camera, RigidTransform]:
    names = [f"t_{row}{column}" for row in range(3) for column in range(4)]
    fields = ("fx", "fy", "cx", "cy", "width", "height")
    for name in (*names, *fields):
        if name not in content:
            raise ValueError(f"{name} is missing")
    *k, width, height = finite_numbers([content[name] for name in fields], "intrinsics", (6,)).tolist()
    if (width, height) != size:
        raise ValueError(f"width and height are {width:g}x{height:g}, the image is {size[0]}x{size[1]}")
    matrix = finite_numbers([content[name] for name in names], "pose", (12,)).reshape(3, 4)
    with named("t_00 to t_23"):
        return Camera(*size, *k), RigidTransform.from_matrix(matrix)


def _numbers(content: Mapping[str, Any], field: str, count: int) -> Array:
    if field not in content:
        raise ValueError(f"{field} is missing")
    values = finite_numbers(content[field], field)
    return finite_numbers(values.reshape(-1), field, (count,))
