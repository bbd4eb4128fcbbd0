"""Photographs of a corner of a room, rendered in milliseconds: three papered walls, full of features."""

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless import Client, NewReference
from mapless.geometry import Camera, RigidTransform
from support.images import encode
from support.scenes import look_at

CAMERA = Camera(512, 384, 430.0, 430.0, 255.5, 191.5)
SIDE_M = 4.0
"""The walls are x = 0, y = 0 and z = 0, the room where all are negative; y points down."""
_TEXELS_PER_M = 120


def wallpaper(seed: int) -> NDArray[np.uint8]:
    """Shapes of all sizes in greys, (H, W, 3): whatever has a colour was drawn over it."""
    random = np.random.default_rng(seed)
    side = int(SIDE_M * _TEXELS_PER_M)
    paper = np.full((side, side, 3), random.integers(90, 200), np.uint8)
    for _ in range(900):
        centre, size = random.integers(0, side, 2), int(random.integers(2, 26))
        colour = [int(random.integers(0, 256))] * 3
        if random.random() < 0.5:
            cv2.circle(paper, centre.tolist(), size, colour, -1, cv2.LINE_AA)
        else:
            cv2.rectangle(paper, (centre - size).tolist(), (centre + random.integers(2, 26, 2)).tolist(), colour, -1)
    return np.asarray(cv2.GaussianBlur(paper, (0, 0), 0.8), np.uint8)


PAPERS = tuple(wallpaper(seed) for seed in range(3))


def photograph(
    world_from_camera: RigidTransform, camera: Camera = CAMERA, papers: Sequence[NDArray[np.uint8]] = PAPERS
) -> bytes:
    """A PNG of what a camera in the room sees, whose walls have these papers."""
    return encode(".png", picture(world_from_camera, camera, papers))


def picture(
    world_from_camera: RigidTransform, camera: Camera = CAMERA, papers: Sequence[NDArray[np.uint8]] = PAPERS
) -> NDArray[np.uint8]:
    """The same as (H, W, 3)."""
    columns, rows = np.meshgrid(np.arange(camera.width_px), np.arange(camera.height_px))
    rays = camera.rays(np.stack([columns, rows], axis=-1)) @ world_from_camera.rotation.T
    centre = world_from_camera.translation
    with np.errstate(divide="ignore", invalid="ignore"):
        depths = np.where(rays > 1e-9, -centre / rays, np.inf)
    wall = depths.argmin(axis=-1)
    hit = centre + rays * depths.min(axis=-1, keepdims=True)
    shown = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    for axis, paper in enumerate(papers):
        across, down = np.moveaxis(np.delete(hit, axis, axis=-1) * -_TEXELS_PER_M, -1, 0).astype(np.float32)
        found = cv2.remap(paper, across, down, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REFLECT_101)
        shown[wall == axis] = found[wall == axis]
    return shown


def pose(angle_deg: float, height_m: float = -1.6, distance_m: float = 3.4) -> RigidTransform:
    """``world_from_camera`` that looks into the corner from an angle, 0 along its middle."""
    angle = np.radians(45 + angle_deg)
    return look_at(np.array([-distance_m * np.cos(angle), height_m, -distance_m * np.sin(angle)]), [-0.5, -1.2, -0.5])


def make_corner(
    client: Client, poses: Sequence[RigidTransform], scene_id: str = "corner", camera: Camera = CAMERA
) -> None:
    """A scene of photographs from these poses, r0, r1, and so on."""
    client.create_scene(scene_id)
    added = [NewReference(f"r{i}", photograph(it, camera), camera, it) for i, it in enumerate(poses)]
    client.add_references(scene_id, added)
