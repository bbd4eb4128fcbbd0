"""Photographs of two upright boards, one behind the other: rendered in milliseconds, and they localize well."""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from support.images import textured
from support.scenes import random_for

PIXELS_PER_METRE = 150.0
BOARDS_M = ((5.0, 9.0, 7.0), (3.6, 1.6, 1.1))
"""Depth, width and height of two upright boards, the far one behind everything."""

Shot = tuple[NDArray[np.uint8], RigidTransform]


def wall(camera: Camera, count: int = 9, step_m: float = 0.35) -> list[Shot]:
    """Photographs (H, W, 3) one step apart and their poses, world from camera."""
    random = random_for("wall")
    boards = [
        textured(round(width_m * PIXELS_PER_METRE), round(height_m * PIXELS_PER_METRE), seed=i)
        for i, (_, width_m, height_m) in enumerate(BOARDS_M)
    ]
    shots = []
    for i in range(count):
        rotation = rotation_from_vector(random.normal(0, 0.05, 3))
        centre = np.array([step_m * (i - count // 2), random.normal(0, 0.1), random.normal(0, 0.1)])
        pose = RigidTransform(rotation, centre)
        shots.append((photograph(boards, camera, pose), pose))
    return shots


def photograph(boards: list[NDArray[np.uint8]], camera: Camera, world_from_camera: RigidTransform) -> NDArray[np.uint8]:
    """Boards at z = depth, centred on the world's z axis: each is one homography."""
    camera_from_world = world_from_camera.inverse()
    image = np.zeros((camera.height_px, camera.width_px, 3), np.uint8)
    for board, (depth_m, width_m, height_m) in zip(boards, BOARDS_M, strict=True):
        board_x, board_y = np.array([1, 0, 0]) / PIXELS_PER_METRE, np.array([0, 1, 0]) / PIXELS_PER_METRE
        corner = np.array([-width_m / 2, -height_m / 2, depth_m])
        on_board = np.stack([board_x, board_y, corner], axis=1)
        in_camera = camera_from_world.rotation @ on_board
        in_camera[:, 2] += camera_from_world.translation
        cv2.warpPerspective(
            board, camera.matrix() @ in_camera, image.shape[1::-1], image, cv2.INTER_AREA, cv2.BORDER_TRANSPARENT
        )
    return image
