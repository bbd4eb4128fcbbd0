"""Keyframes of images along a path: the sharpest of a few, each time the camera has moved or turned far enough."""

from collections.abc import Callable, Iterator
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import RigidTransform, rotation_angle_deg

from .collecting import KeyframeOptions

CANDIDATES = 5
"""Images of which the sharpest becomes a keyframe; at 30 Hz, a sixth of a second."""
SLACK = 0.2
"""Tolerance of distance and angle, as a share: the candidates are no farther from the first of them."""
Image = TypeVar("Image")


def keyframes(
    images: Iterator[tuple[int, Image, RigidTransform]],
    options: KeyframeOptions,
    sharpness_of: Callable[[Image], float],
    refuse: Callable[[int, str], None],
) -> Iterator[tuple[int, Image, RigidTransform]]:
    """Yields the images, with time and pose, that are far enough from the last keyframe and the sharpest nearby.

    Calls `refuse`, with time and reason, for images that would have been candidates and whose sharpness raises
    ValueError, since they cannot be decoded.
    """
    if 0 in (options.distance_m, options.angle_deg):
        yield from images
        return
    last: RigidTransform | None = None
    begin: RigidTransform | None = None
    best: tuple[int, Image, RigidTransform] | None = None
    sharpest, count = -1.0, 0
    for image in images:
        pose = image[2]
        if best is not None and begin is not None and (count == CANDIDATES or _is_far(begin, pose, options, SLACK)):
            yield best
            last, best, begin = best[2], None, None
        if best is None and last is not None and not _is_far(last, pose, options):
            continue
        try:
            sharpness = sharpness_of(image[1])
        except ValueError as error:
            refuse(image[0], str(error))
            continue
        if best is None:
            begin, sharpest, count = pose, -1.0, 0
        count += 1
        if sharpness > sharpest:
            best, sharpest = image, sharpness
    if best is not None:
        yield best


def sharpness(grey: NDArray[np.uint8]) -> float:
    """Variance of the Laplacian of an image (H, W) at half its size."""
    half = cv2.resize(grey, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(half, cv2.CV_32F).var())


def _is_far(before: RigidTransform, now: RigidTransform, options: KeyframeOptions, share: float = 1.0) -> bool:
    moved = before.inverse().compose(now)
    is_away = bool(np.linalg.norm(moved.translation) >= share * options.distance_m)
    return is_away or rotation_angle_deg(moved.rotation) >= share * options.angle_deg
