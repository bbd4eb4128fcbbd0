"""Upright rectangles before a wall: exact depth images from any place, and keypoints on what is seen."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.method.features.views import DepthSource, Features, KeypointDepths, Matches, PosedView, View
from support.scenes import random_for

CAMERA = Camera(320, 240, 260.0, 260.0, 161.0, 118.0)
WALL_M = 5.0


@dataclass(frozen=True, eq=False)
class Walls:
    """Rectangles (R, 5): distance along z and bounds of x and y, metres."""

    rectangles: Array

    @staticmethod
    def planted(count: int = 40) -> "Walls":
        random = random_for("walls")
        middle = random.uniform([-3, -2], [3, 2], (count, 2))
        half = random.uniform(0.15, 0.5, (count, 2))
        z = random.uniform(2.0, 4.5, count)
        bounds = np.stack([middle - half, middle + half], axis=2).reshape(count, 4)
        wall = [[WALL_M, -50.0, 50.0, -50.0, 50.0]]
        return Walls(np.concatenate([np.column_stack([z, bounds]), wall]))

    def depth(self, camera: Camera, world_from_camera: RigidTransform) -> NDArray[np.float32]:
        """The depth image (H, W) of a camera."""
        rows, columns = np.mgrid[: camera.height_px, : camera.width_px]
        return self.at(camera, world_from_camera, np.stack([columns, rows], axis=-1)).astype(np.float32)

    def at(self, camera: Camera, world_from_camera: RigidTransform, pixels: Array) -> Array:
        """Depths of pixels (..., 2)."""
        ray = camera.rays(pixels) @ world_from_camera.rotation.T
        centre, nearest = world_from_camera.translation, np.full(ray.shape[:-1], np.inf)
        for z, left, right, top, bottom in self.rectangles:
            depth = (z - centre[2]) / ray[..., 2]
            x, y = (centre[i] + depth * ray[..., i] for i in (0, 1))
            hit = (depth > 0) & (x >= left) & (x <= right) & (y >= top) & (y <= bottom)
            nearest = np.where(hit, np.minimum(nearest, depth), nearest)
        return nearest


def two_views(walls: Walls, count: int = 150, noise_px: float = 0.5) -> tuple[PosedView, PosedView, Matches]:
    """Two references half a metre apart, and matches of what both see; each has a measured depth."""
    random = random_for("two views", count)
    poses = [RigidTransform(np.eye(3), np.array([x, 0.0, 0.0])) for x in (-0.25, 0.25)]
    size = np.array([CAMERA.width_px, CAMERA.height_px])
    pixels = random.uniform((3, 3), size - 4, (6 * count, 2))
    depth = walls.at(CAMERA, poses[0], pixels)
    x_in_world = poses[0].apply(CAMERA.rays(pixels) * depth[:, None])
    x = poses[1].inverse().apply(x_in_world)
    other = CAMERA.project(x)
    inside = ((other >= 2) & (other <= size - 3)).all(axis=1)
    seen = inside & (np.abs(walls.at(CAMERA, poses[1], other) - x[:, 2]) < 1e-6)
    rows = np.flatnonzero(seen)[:count]
    both = [it[rows] + random.normal(0, noise_px, (len(rows), 2)) for it in (pixels, other)]
    views = [_view(name, it, pose) for name, it, pose in zip("ab", both, poses, strict=True)]
    return views[0], views[1], np.column_stack([np.arange(len(rows))] * 2).astype(np.int32)


def _view(name: str, pixels: Array, pose: RigidTransform) -> PosedView:
    count = len(pixels)
    features = Features(pixels.astype(np.float32), np.zeros((count, 4), np.uint8), np.ones(count, np.float32))
    depths = KeypointDepths(np.ones(count, np.float32), np.ones(count, np.float32), 0.01, DepthSource.MEASURED)
    return PosedView(name, f"scenes/s/references/{name}", View(CAMERA, features), pose, depths)
