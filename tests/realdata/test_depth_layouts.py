"""Depth of real recordings in the layouts of their makers: what is triangulated from their poses has the same depth."""

import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from mapless.geometry import Array
from mapless_server.images import ImageLimits, decode_depth
from mapless_server.method.structure.measured_depth import MeasuredDepth
from mapless_tools.dataset import Dataset, Frame
from mapless_tools.ingest.formats import read_dataset

from .conftest import DATA

pytestmark = pytest.mark.realdata
STEP = 2
"""Frames between two of a pair."""
MIN_SINE = 0.026
"""Sine of the angle between two rays, 1.5 degrees, below which a point's depth is uncertain by tens of per cent."""


def points_of(frame: Frame) -> MeasuredDepth:
    """The depth as the photograph's camera sees it."""
    assert frame.depth is not None
    image, photo = frame.depth.read(), frame.camera
    depth = decode_depth(image, (photo.width_px, photo.height_px), ImageLimits())
    camera = image.camera or photo.resized(*depth.shape[::-1])
    found = MeasuredDepth(camera, depth, image.known_noise, image.camera_from_depth_camera)
    return found if image.camera_from_depth_camera is None else found.seen_by(photo)


def ratios(first: Frame, second: Frame) -> Array:
    """Depths of the first photograph's matched features by those that are triangulated."""
    matched = matches(first, second)
    if not len(matched):
        return np.empty(0)
    pixels, others = matched[:, :2], matched[:, 2:]
    second_from_first = second.world_from_camera.inverse().compose(first.world_from_camera)
    ray, other_ray = first.camera.rays(pixels) @ second_from_first.rotation.T, second.camera.rays(others)
    sine = np.linalg.norm(np.cross(ray, other_ray), axis=1)
    sine /= np.linalg.norm(ray, axis=1) * np.linalg.norm(other_ray, axis=1)
    both = np.stack([ray, -other_ray], axis=2)
    normal = np.swapaxes(both, 1, 2) @ both
    z = np.linalg.solve(normal, -np.swapaxes(both, 1, 2) @ second_from_first.translation[:, None])[:, 0, 0]
    seen = second.camera.project(ray * z[:, None] + second_from_first.translation)
    near = np.linalg.norm(seen - others, axis=1) < 2 * second.camera.width_px / 1024
    depth = points_of(first)
    columns, rows = np.rint(depth.camera.project(first.camera.rays(pixels))).astype(int).T
    inside = (columns >= 0) & (rows >= 0) & (columns < depth.depth.shape[1]) & (rows < depth.depth.shape[0])
    keep = near & inside & (z > 0) & (sine > MIN_SINE)
    found = depth.depth[rows[keep], columns[keep]] / z[keep]
    return np.asarray(found[np.isfinite(found)], float)


def matches(first: Frame, second: Frame) -> Array:
    """Pixels (N, 4) of matched features, x and y in each of both photographs."""
    sift = cv2.SIFT.create(1500)
    described = []
    for frame in (first, second):
        grey = cv2.imread(str(frame.image_path), cv2.IMREAD_GRAYSCALE | cv2.IMREAD_IGNORE_ORIENTATION)
        described.append(sift.detectAndCompute(np.asarray(grey, np.uint8), np.empty(0, np.uint8)))
    (points, values), (other_points, other_values) = described
    pairs = cv2.BFMatcher().knnMatch(values, other_values, k=2)
    kept = [best for best, next_best in pairs if best.distance < 0.75 * next_best.distance]
    return np.array([[*points[it.queryIdx].pt, *other_points[it.trainIdx].pt] for it in kept]).reshape(-1, 4)


def assert_agrees(dataset: Dataset) -> None:
    """Within 5 %, by which the poses of a phone or motion capture are off between two frames."""
    frames = [frame for frame in dataset.frames if frame.depth is not None]
    assert len(frames) == len(dataset.frames)
    chosen = range(0, len(frames) - STEP, max(1, len(frames) // 5))
    found = np.concatenate([ratios(frames[i], frames[i + STEP]) for i in chosen])
    assert len(found) > 50
    assert abs(np.median(found) - 1) < 0.05


@pytest.mark.nightly
def test_record3ds_depths_are_those_of_triangulated_points(tmp_path: Path) -> None:
    """The export's own files; their photographs are named in text files where links were not kept."""
    export = DATA / "depth" / "lidar-desk" / "original"
    if not (export / "metadata.json").is_file():
        pytest.skip(f"needs {export}")
    shutil.copytree(export / "depth", tmp_path / "depth")
    shutil.copy(export / "metadata.json", tmp_path)
    (tmp_path / "rgb").mkdir()
    for file in (export / "rgb").iterdir():
        photo = file if file.stat().st_size > 100 else file.parent / file.read_text().strip()
        shutil.copy(photo, tmp_path / "rgb" / file.name)
    assert_agrees(read_dataset(tmp_path))


@pytest.mark.parametrize("place", ["tum-teddy", "kinect-kitchen", "realsense-robot"])
def test_depths_are_those_of_triangulated_points(photographs: Callable[[str], Dataset], place: str) -> None:
    assert_agrees(photographs(f"depth/{place}"))
