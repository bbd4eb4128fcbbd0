"""Follows what the frames of a video show: how much of a reference frame is still seen, and how far it has moved."""

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

_CORNERS = 200
_QUALITY = 0.01
_APART_PX = 8
_WINDOW_PX = (15, 15)
_LEVELS = 3
_RETURN_PX = 1.0
"""A point is followed if it returns to where it began."""
MIN_CORNERS = 20


@dataclass(frozen=True)
class Seen:
    """The share of a reference's corners that a frame shows, and their median motion as a share of the diagonal."""

    share: float
    motion: float


class Reference:
    """The corners of a frame; each later frame is compared with it itself, so that nothing drifts."""

    def __init__(self, grey: NDArray[np.uint8]) -> None:
        """Takes a small frame in grey (H, W)."""
        self._grey = _evened(grey)
        found = cv2.goodFeaturesToTrack(self._grey, _CORNERS, _QUALITY, _APART_PX)
        self._corners: Array = np.zeros((0, 1, 2), np.float32) if found is None else np.asarray(found)
        self._guess = self._corners.copy()
        self._diagonal_px = float(np.hypot(*grey.shape))

    @property
    def corner_count(self) -> int:
        """How many corners there are; a picture of nothing has none."""
        return len(self._corners)

    def seen_in(self, grey: NDArray[np.uint8]) -> Seen:
        """Compares a frame of the same size."""
        if self.corner_count < MIN_CORNERS:
            return Seen(0.0, 0.0)
        there, is_found = self._follow(self._grey, _evened(grey), self._corners, self._guess)
        height, width = grey.shape
        inside = ((there >= 0) & (there < (width, height))).all(-1).ravel()
        back, is_back = self._follow(_evened(grey), self._grey, there, self._corners)
        returns = np.linalg.norm(back - self._corners, axis=-1).ravel() < _RETURN_PX
        kept = is_found & is_back & inside & returns
        if not kept.any():
            return Seen(0.0, 0.0)
        motions = (there - self._corners)[kept]
        # The others are looked for where the picture as a whole went.
        self._guess = np.where(kept[:, None, None], there, self._corners + np.median(motions, axis=0))
        return Seen(float(kept.mean()), float(np.median(np.linalg.norm(motions, axis=-1))) / self._diagonal_px)

    @staticmethod
    def _follow(
        first: NDArray[np.uint8], second: NDArray[np.uint8], points: Array, guess: Array
    ) -> tuple[Array, NDArray[np.bool_]]:
        moved, is_found, _ = cv2.calcOpticalFlowPyrLK(
            first,
            second,
            points.astype(np.float32),
            guess.astype(np.float32),
            winSize=_WINDOW_PX,
            maxLevel=_LEVELS,
            flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
        )
        return np.asarray(moved, float), is_found.ravel() == 1


def _evened(grey: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A picture of usual brightness and contrast: cameras change their exposure."""
    mean, deviation = cv2.meanStdDev(grey)
    scale = 50 / max(float(deviation[0, 0]), 1.0)
    return np.asarray(cv2.convertScaleAbs(grey, alpha=scale, beta=128 - scale * float(mean[0, 0])), np.uint8)
