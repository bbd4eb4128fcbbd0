"""Where keypoints may lie in a photograph with a mask: away from its ignored pixels.

The detectors search the whole image, and the strongest of the keypoints that may be used are kept: an image whose
ignored pixels were painted over would have keypoints along the paint's border.
"""

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from .views import Ignored

MARGIN_PX = 4.0
"""Keypoints are at least so far from an ignored pixel, in the processed image. Evidence: mask-margin."""


def usable_pixels(ignored: Ignored, width_px: int, height_px: int) -> NDArray[np.bool_]:
    """Pixels (height, width) of a reduced image further than MARGIN_PX from all that are ignored, at any size."""
    shares = cv2.resize(ignored.astype(np.float32), (width_px, height_px), interpolation=cv2.INTER_AREA)
    clear = np.asarray(shares <= 0, np.uint8)  # a pixel that is ignored in part is ignored
    if clear.all():
        return np.ones(clear.shape, bool)
    distance_px = cv2.distanceTransform(clear, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    return np.asarray(distance_px > MARGIN_PX, bool)


def are_usable(usable: NDArray[np.bool_], pixels: Array) -> NDArray[np.bool_]:
    """Returns whether each keypoint (N, 2) lies in a usable pixel, (N,)."""
    last = usable.shape[1] - 1, usable.shape[0] - 1
    columns, rows = np.clip(np.rint(np.reshape(pixels, (-1, 2))), 0, last).astype(np.intp).T
    return np.asarray(usable[rows, columns], bool)
