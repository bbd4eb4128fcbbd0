"""Stray Scanner's recordings with an iPhone: rgb.mp4, odometry.csv, camera_matrix.csv, depth/ and confidence/.

Rows of odometry.csv are a time in seconds, the number of a frame of the video, x y z and qx qy qz qw of
world_from_camera, with camera axes x right, y down, z forward, and perhaps fx fy cx cy; the first row names them.
camera_matrix.csv is K, row by row, of the video's raster as it is stored (1920x1440), whichever way the phone was held.
depth/000000.png has the millimetres of the frame with this number, 192x256 values of the same camera, and
confidence/000000.png how certain they are: 0, 1 or 2. Principal points count from the corner of the top-left pixel, as
Apple's. (The app's docs/format.md, and the conventions of its tool StrayVisualizer.)

Keyframes are taken as from a recording of a robot, and written to a folder that is removed when the process ends.
"""

import atexit
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from mapless.depth import DepthSensor
from mapless.geometry import Array, Camera, RigidTransform
from mapless_command.installation import how_to_install
from mapless_server.extras import missing_package
from mapless_tools.dataset import Dataset, DepthFile, finite_numbers, named

from .collecting import Collector, ReadOptions, filled_lines, from_corner, rotation_of
from .keyframes import keyframes, sharpness

ODOMETRY, MATRIX, VIDEO = "odometry.csv", "camera_matrix.csv", "rgb.mp4"
MIN_CONFIDENCE = 1
"""StrayVisualizer's default: of 0, 1 and 2 the values that are not certain at all are left out."""
_POSE = ("x", "y", "z", "qx", "qy", "qz", "qw")
_CAMERA = ("fx", "fy", "cx", "cy")
_OFF_CENTRE = 0.2
"""Share of half the width by which a principal point is off at most; else K is of another size."""


def fits(path: Path) -> bool:
    """Whether a folder has this layout."""
    return all((path / name).is_file() for name in (ODOMETRY, MATRIX, VIDEO))


def read(path: Path, options: ReadOptions) -> Dataset:
    """Reads the folder; see `read_dataset`."""
    if package := missing_package("reconstruct"):
        raise ValueError(f"{path / VIDEO} needs the Python package {package}: {how_to_install('reconstruct')}")
    from PIL import Image

    from mapless_tools.reconstruct.sources.jpeg import write_jpeg

    rows, k = _rows(path / ODOMETRY), _matrix(path / MATRIX)
    folder = TemporaryDirectory(prefix="mapless-keyframes-")
    atexit.register(folder.cleanup)
    collector = Collector(Path(folder.name), options.depths)
    frames = _frames(path / VIDEO, rows, collector)
    found = keyframes(frames, options.keyframes, _sharpness_of, lambda *_: None)
    for number, frame, pose in found:
        name = f"{number:06d}"
        with collector.attempt(f"{VIDEO}: frame {number}"):
            own = rows[number].camera
            camera = _camera(k if own is None else own, (frame.width, frame.height))
            write_jpeg(collector.folder / f"{name}.jpg", Image.fromarray(frame.to_ndarray(format="rgb24")))
            depth = _depth(collector, path, name, (frame.width, frame.height))
            collector.add(f"{name}.jpg", camera, pose, depth=depth)
    collector.notes.insert(0, f"{len(collector.frames)} keyframes of {len(rows)} frames with poses")
    collector.notes.append("these are the phone's own poses, which drift")
    name = path.resolve().name
    return collector.dataset(name, "stray", metric=True, source="Stray Scanner", ground_truth="device tracking")


@dataclass(frozen=True, eq=False)
class _Row:
    """A frame's pose, and its fx fy cx cy if the file has them."""

    world_from_camera: RigidTransform
    camera: Array | None


def _rows(file: Path) -> dict[int, _Row]:
    """Rows by the number of their frame; ValueError names a line that is wrong."""
    lines = filled_lines(file)
    _, header = next(lines, (0, ""))
    columns = [it.strip() for it in header.split(",")]
    missing = [name for name in ("frame", *_POSE) if name not in columns]
    if missing:
        raise ValueError(f"{file}: the first row must name columns, {', '.join(missing)} is missing")
    rows = {}
    for number, line in lines:
        with named(f"{file}:{number}"):
            words = line.split(",")
            if len(words) != len(columns):
                raise ValueError(f"expected {len(columns)} values, found {len(words)}")
            value = dict(zip(columns, words, strict=True))
            frame = int(finite_numbers(value["frame"], "frame", ()))
            x, y, z, *q = finite_numbers([value[it] for it in _POSE], "pose").tolist()
            pose = RigidTransform(rotation_of(np.array([q[3], *q[:3]]), "pose"), np.array([x, y, z]))
            has_camera = all(it in columns for it in _CAMERA)
            camera = finite_numbers([value[it] for it in _CAMERA], "intrinsics") if has_camera else None
            rows[frame] = _Row(pose, camera)
    return rows


def _matrix(file: Path) -> Array:
    """fx, fy, cx, cy of a file with K."""
    words = [line.split(",") for _, line in filled_lines(file)]
    with named(str(file)):
        return finite_numbers(words, "K", (3, 3))[[0, 1, 0, 1], [0, 1, 2, 2]]


def _frames(file: Path, rows: dict[int, _Row], collector: Collector) -> Iterator[tuple[int, Any, RigidTransform]]:
    """Yields number, frame and pose of the frames with a pose, up to the first damaged one: the others' are unknown."""
    from mapless_tools.reconstruct.sources.video import opened_video

    errors: list[str] = []
    number = -1
    with named(str(file)), opened_video(file) as video:
        for number, frame in enumerate(video.frames(errors)):
            if errors:
                collector.notes.append(f"{file.name} is damaged at frame {number}; it and the others are left out")
                break
            if number in rows:
                yield number, frame, rows[number].world_from_camera
    if not errors and rows and number < max(rows):
        collector.notes.append(f"{file.name} has {number + 1} frames, {ODOMETRY} numbers to {max(rows)}")


def _sharpness_of(frame: Any) -> float:
    return sharpness(np.asarray(frame.to_ndarray(format="gray"), np.uint8))


def _camera(k: Array, size: tuple[int, int]) -> Camera:
    off = np.abs(2 * k[2:] / size - 1).max()
    if not off <= _OFF_CENTRE:
        raise ValueError(
            f"K: its principal point ({k[2]:g}, {k[3]:g}) is not near the middle of the video, {size[0]}x{size[1]}: it "
            "is of another size, or the video was turned"
        )
    return from_corner(Camera(*size, *k.tolist()))


def _depth(collector: Collector, path: Path, name: str, size: tuple[int, int]) -> DepthFile | None:
    depth, confidence = (Path(folder) / f"{name}.png" for folder in ("depth", "confidence"))
    if not (path / depth).is_file():
        return None
    certain = confidence if (path / confidence).is_file() else None
    file = DepthFile(depth, 0.001, DepthSensor.PHONE_LIDAR, confidence_path=certain, min_confidence=MIN_CONFIDENCE)
    return collector.depth(file, size, path)
