"""How much of what was surveyed a photograph of the renovated room still shows, by the room's geometry alone."""

from collections.abc import Sequence
from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array
from mapless_tools.dataset import Frame

from .furniture import Room
from .photographs import cast
from .renovation import shape_of

CORNERS, CORNER_QUALITY, CORNERS_APART_PX = 400, 0.01, 5.0
"""Points of each reference: so many corners of its image, with this share of the strongest one's response."""
HIDDEN = 0.98
"""A point is hidden by what is nearer than this share of its distance."""


class SurveyedPoints:
    """Points of the surveyed room, those at corners in the images of its references.

    Attributes:
        points: (N, 3) world, metres.
        quad: (N,) index of the rectangle that each lies on.
    """

    def __init__(self, seed: int, references: Sequence[Frame]) -> None:
        """Finds the points of the room of a seed in photographs that were taken before its renovation."""
        self._room = cache(lambda step: shape_of(seed, step))
        found = [self._of_reference(it) for it in references]
        self.points = np.concatenate([points for points, _ in found])
        self.quad = np.concatenate([quad for _, quad in found])

    def _of_reference(self, frame: Frame) -> tuple[Array, NDArray[np.int16]]:
        grey = cv2.imread(str(frame.image_path), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        corners = cv2.goodFeaturesToTrack(grey, CORNERS, CORNER_QUALITY, CORNERS_APART_PX)
        columns, lines = np.rint(np.reshape(corners, (-1, 2))).astype(int).T
        inverse_depth, nearest = cast(self._room(0), frame.camera, frame.world_from_camera)
        is_on = nearest[lines, columns] >= 0
        columns, lines = columns[is_on], lines[is_on]
        rays = np.stack([columns, lines, np.ones(len(lines))], axis=-1) @ np.linalg.inv(frame.camera.matrix()).T
        in_camera = rays / inverse_depth[lines, columns, None]
        return frame.world_from_camera.apply(in_camera), nearest[lines, columns]

    def left(self, step: int, frame: Frame) -> float:
        """Share of the points in a photograph's view that are as they were surveyed, 0 to 1; 0 without any.

        In view are those that the photograph would have shown before the renovation.
        """
        before, now = self._room(0), self._room(step)
        in_view = visible(before, frame, self.points)
        pairs = zip(before.versions, now.versions, strict=True)
        is_kept = np.array([was == version for was, version in pairs])[self.quad]
        return float((is_kept & visible(now, frame, self.points))[in_view].mean()) if in_view.any() else 0.0


def visible(room: Room, frame: Frame, points: Array) -> NDArray[np.bool_]:
    """Whether each point (N, 3) is in a photograph, and nothing of the room hides it."""
    camera, pose = frame.camera, frame.world_from_camera
    inverse_depth, _ = cast(room, camera, pose)
    in_camera = pose.inverse().apply(points)
    is_ahead = in_camera[:, 2] > 0
    pixels = camera.project(np.where(is_ahead[:, None], in_camera, [0.0, 0.0, 1.0]))
    last_px = [camera.width_px - 1, camera.height_px - 1]
    inside = is_ahead & ((pixels >= 0) & (pixels <= last_px)).all(axis=-1)
    columns, lines = np.where(inside[:, None], np.rint(pixels), 0).astype(int).T
    nearness = 1 / np.where(inside, in_camera[:, 2], 1.0)
    return np.asarray(inside & (nearness >= HIDDEN * inverse_depth[lines, columns]))
