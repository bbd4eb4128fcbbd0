"""transforms.json of nerfstudio and instant-ngp (and of Blender's data sets: transforms_train.json, ..._test.json).

Read are `frames`, each with `file_path` (with or without ending) and `transform_matrix` (world_from_camera with
OpenGL's camera axes); in a frame or for all, `fl_x`, `fl_y`, `cx`, `cy`, `w`, `h`, `camera_angle_x`, `camera_angle_y`,
`camera_model`, `is_fisheye`, k1 to k4, p1 and p2; and for all `applied_transform` and `applied_scale`, which are
undone, and `train_filenames`, `val_filenames`, `test_filenames`. A frame's `mask_path` is its mask: black pixels are
ignored, as in nerfstudio. A frame's `depth_file_path` is its depth, of the same camera: a PNG of 16 bits or a .npy in
thousandths of the unit of the poses before `applied_scale`, nerfstudio's `depth_unit_scale_factor`; or its `depth_path`
is, a PNG in `integer_depth_scale` of that unit, as instant-ngp's nerfcapture2nerf.py writes it.

Pixels: nerfstudio shoots the ray of pixel (0, 0) through (0.5, 0.5), so principal points count from the corner.
"""

import math
from collections.abc import Mapping
from pathlib import Path, PurePosixPath
from typing import Any

from mapless.geometry import Camera, RigidTransform, nearest_rotation
from mapless.lenses import Distortion, Fisheye, RadialTangential
from mapless_tools.dataset import Dataset, DepthFile, finite_numbers, named, read_json

from .collecting import Collector, ReadOptions, from_corner, from_opengl, natural_order, size_of
from .depth_files import decode_npy

FILE_NAME = "transforms.json"
SPLIT_FILES = {"transforms_train.json": "train", "transforms_val.json": "test", "transforms_test.json": "test"}
DEPTH_UNIT = 0.001
"""nerfstudio's `depth_unit_scale_factor`, if it is not set otherwise: millimetres."""
_PINHOLES = ("PINHOLE", "SIMPLE_PINHOLE")


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return any((path / name).is_file() for name in (FILE_NAME, *SPLIT_FILES))


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    collector = Collector(path, options.depths)
    names = [FILE_NAME] if (path / FILE_NAME).is_file() else [n for n in SPLIT_FILES if (path / n).is_file()]
    if not names:
        raise ValueError(f"{path} holds no {FILE_NAME}")
    for name in names:
        _read_file(path / name, SPLIT_FILES.get(name, ""), collector)
    return collector.dataset(path.resolve().name, "nerf", metric=False, source=", ".join(names))


def _read_file(file: Path, split: str, collector: Collector) -> None:
    content = read_json(file)
    if not isinstance(content, dict) or not isinstance(content.get("frames"), list) or not content["frames"]:
        raise ValueError(f"{file}: frames must be a list with at least one frame")
    frames = content["frames"]
    with named(str(file)):
        scale, transform = _applied(content)
        splits = _splits(content)
    if scale != 1:
        collector.notes.append(f"{file.name}: applied_scale {scale:g} is undone")
    labels = [str(frame.get("file_path", "?")) if isinstance(frame, dict) else "?" for frame in frames]
    for index in sorted(range(len(frames)), key=lambda i: natural_order(labels[i])):
        frame = frames[index]
        with collector.attempt(f"{file.name}: frames[{index}] ({labels[index]})"):
            if not isinstance(frame, dict):
                raise ValueError("must be an object")
            image = _image(collector, frame)
            pose = _world_from_camera(frame, scale, transform)
            camera = _camera(collector, image, content | frame)
            its_split = splits.get(str(frame["file_path"]), split)
            depth = _depth(collector, content | frame, camera)
            collector.add(image, camera, pose, its_split, mask=frame.get("mask_path"), depth=depth)


def _image(collector: Collector, frame: Mapping[str, Any]) -> str:
    path = frame.get("file_path")
    if not isinstance(path, str) or not path:
        raise ValueError("file_path must be a path")
    return collector.image(str(PurePosixPath(path))).relative_to(collector.folder).as_posix()


def _depth(collector: Collector, frame: Mapping[str, Any], camera: Camera) -> DepthFile | None:
    path, unit = frame.get("depth_file_path"), DEPTH_UNIT
    if path is None and frame.get("depth_path") is not None:
        path = frame["depth_path"]
        try:
            unit = _number(frame, "integer_depth_scale", 0.0)
        except ValueError as error:
            collector.leave_out_depth(str(path), error)
            return None
    if path is None:
        return None
    decode = decode_npy if str(path).endswith(".npy") else None
    return collector.depth(DepthFile(Path(str(path)), unit, decode=decode), (camera.width_px, camera.height_px))


def _world_from_camera(frame: Mapping[str, Any], scale: float, world_from_original: RigidTransform) -> RigidTransform:
    matrix = finite_numbers(frame.get("transform_matrix"), "transform_matrix")
    with named("transform_matrix"):
        pose = RigidTransform.from_matrix(matrix)
    unscaled = RigidTransform(pose.rotation, pose.translation / scale)
    return from_opengl(world_from_original.inverse().compose(unscaled))


def _camera(collector: Collector, image: str, value: Mapping[str, Any]) -> Camera:
    if "w" in value and "h" in value:
        size = _whole(value, "w"), _whole(value, "h")
    else:
        size = size_of(collector.folder / image)
    focal_x = _focal(value, "fl_x", "camera_angle_x", size[0])
    focal_y = _focal(value, "fl_y", "camera_angle_y", size[1])
    if focal_x is None and focal_y is None:
        raise ValueError("fl_x and camera_angle_x are missing")
    centre = _number(value, "cx", size[0] / 2), _number(value, "cy", size[1] / 2)
    focal = focal_x or focal_y or 0.0, focal_y or focal_x or 0.0
    return from_corner(Camera(*size, *focal, *centre, _distortion(value)))


def _focal(value: Mapping[str, Any], length: str, angle: str, side_px: int) -> float | None:
    if length in value:
        return _number(value, length, 0.0)
    if angle not in value:
        return None
    radians = _number(value, angle, 0.0)
    if not 0 < radians < math.pi:
        raise ValueError(f"{angle} must be between 0 and pi, is {radians:g}")
    return side_px / 2 / math.tan(radians / 2)


def _distortion(value: Mapping[str, Any]) -> Distortion | None:
    model = "OPENCV_FISHEYE" if value.get("is_fisheye") else value.get("camera_model", "OPENCV")
    k1, k2, k3, k4, p1, p2 = (_number(value, name, 0.0) for name in ("k1", "k2", "k3", "k4", "p1", "p2"))
    if model == "OPENCV_FISHEYE":
        return Fisheye(k1, k2, k3, k4)
    if model in _PINHOLES:
        return None
    if model not in ("OPENCV", "SIMPLE_RADIAL", "RADIAL"):
        raise ValueError(f"camera_model {model!r} has no counterpart here; known: OPENCV, OPENCV_FISHEYE, PINHOLE")
    if k4:
        raise ValueError(f"k4 = {k4:g} has no counterpart here with camera_model {model}")
    lens = RadialTangential(k1, k2, p1, p2, k3)
    return None if lens == RadialTangential() else lens


def _applied(content: Mapping[str, Any]) -> tuple[float, RigidTransform]:
    """Scale and motion that were applied to the original poses, the motion first."""
    scale = _number(content, "applied_scale", 1.0)
    if not scale > 0:
        raise ValueError(f"applied_scale must be above 0, is {scale:g}")
    if "applied_transform" not in content:
        return scale, RigidTransform.identity()
    matrix = finite_numbers(content["applied_transform"], "applied_transform")
    if matrix.shape not in ((3, 4), (4, 4)):
        raise ValueError(f"applied_transform must be 3x4, is {'x'.join(map(str, matrix.shape))}")
    with named("applied_transform"):
        return scale, RigidTransform(nearest_rotation(matrix[:3, :3]), matrix[:3, 3])


def _splits(content: Mapping[str, Any]) -> dict[str, str]:
    splits: dict[str, str] = {}
    for field, split in (("train_filenames", "train"), ("val_filenames", "test"), ("test_filenames", "test")):
        names = content.get(field, [])
        if not isinstance(names, list):
            raise ValueError(f"{field} must be a list")
        for name in names:  # the same images are often both for validation and for testing
            if splits.setdefault(str(name), split) != split:
                raise ValueError(f"{field}: {name} is in both splits")
    return splits


def _number(value: Mapping[str, Any], field: str, default: float) -> float:
    number = value.get(field, default)
    if isinstance(number, bool) or not isinstance(number, int | float):
        raise ValueError(f"{field} must be a number, is {number!r}")
    try:
        number = float(number)
    except OverflowError as error:  # JSON's integers have any number of digits
        raise ValueError(f"{field} is too large") from error
    if not math.isfinite(number):
        raise ValueError(f"{field} must be a number, is {number!r}")
    return number


def _whole(value: Mapping[str, Any], field: str) -> int:
    number = _number(value, field, 0)
    if number != int(number) or number < 1:
        raise ValueError(f"{field} must be a whole number of pixels, is {number!r}")
    return int(number)
