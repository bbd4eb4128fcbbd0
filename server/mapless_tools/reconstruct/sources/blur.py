"""The blur of a photograph, measured at its edges, whatever it shows.

An edge that is blurred by a Gaussian of standard deviation s has, after a further one of s1, a gradient of
A / sqrt(2 pi (s^2 + s1^2)) for a contrast A. The ratio of two such gradients, of a small and of a large s1, does not
contain the contrast: a wall with one poster is as sharp as a bookshelf. Motion blurs the edges across it alone, so that
the directions are measured apart and the worst counts; depth of field blurs a part of the picture, so that the sharpest
fifth of a direction's edges counts.
"""

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

SIDE_PX = 1024
"""Long side of the raster in which blur is measured."""
_FINE_PX, _COARSE_PX = 1.0, 2.0
_CONTRAST = 12.0
"""Grey levels of the weakest edge: three times the noise of a dark photograph after the coarse blur."""
_DIRECTIONS = 4
_SHARPEST_PERCENT = 20
_MIN_EDGES = 200
_MIN_IN_DIRECTION = 50
_MIN_SHARE = 0.04
"""Share of the edges that a direction must have; fewer may all be shadows, which are soft."""
_MAX_BLUR_PX = 20.0


def blur_px(grey: NDArray[np.uint8]) -> float | None:
    """The blur of a grey picture (H, W), standard deviation in its pixels; None if it has too few edges to say."""
    fine, coarse = _gradients(grey, _FINE_PX), _gradients(grey, _COARSE_PX)
    rows, columns = np.nonzero(_edges(coarse))
    if len(rows) < _MIN_EDGES:
        return None
    fine, coarse = fine[:, rows, columns], coarse[:, rows, columns]
    ratio = np.maximum((fine**2).sum(0) / (coarse**2).sum(0), 1 + 1e-3)
    variance = (_COARSE_PX**2 - ratio * _FINE_PX**2) / (ratio - 1)
    blurs = np.sqrt(np.clip(variance, 0, _MAX_BLUR_PX**2))
    angles = np.arctan2(coarse[1], coarse[0]) % math.pi
    directions = np.rint(angles * (_DIRECTIONS / math.pi)).astype(int) % _DIRECTIONS
    enough = max(_MIN_IN_DIRECTION, _MIN_SHARE * len(blurs))
    of_directions = [blurs[directions == it] for it in range(_DIRECTIONS)]
    return max((float(np.percentile(it, _SHARPEST_PERCENT)) for it in of_directions if len(it) >= enough), default=None)


def _gradients(grey: NDArray[np.uint8], sigma_px: float) -> Array:
    """Gradients (2, H, W) by x and y after a Gaussian blur, grey levels per pixel."""
    smooth = cv2.GaussianBlur(grey.astype(np.float32), (0, 0), sigma_px)
    return np.stack(
        [cv2.Scharr(smooth, cv2.CV_32F, 1, 0, scale=1 / 32), cv2.Scharr(smooth, cv2.CV_32F, 0, 1, scale=1 / 32)]
    )


def _edges(gradients: Array) -> NDArray[np.bool_]:
    """The pixels (H, W) whose gradient is large, and the largest across the edge."""
    size = np.hypot(gradients[0], gradients[1])
    inner = size[1:-1, 1:-1]
    across_x = np.abs(gradients[0]) > np.abs(gradients[1])
    ridge = np.where(
        across_x[1:-1, 1:-1],
        (inner > size[1:-1, :-2]) & (inner >= size[1:-1, 2:]),
        (inner > size[:-2, 1:-1]) & (inner >= size[2:, 1:-1]),
    )
    is_strong = size > _CONTRAST / (math.sqrt(2 * math.pi) * _COARSE_PX)
    return np.asarray(np.pad(ridge, 1) & is_strong)
