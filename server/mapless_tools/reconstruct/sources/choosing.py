"""Chooses the frames of videos: sharp ones, apart by what they show."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

_STEPS = 60


def choose_frames(content: Array, sharpness: Array, usable: NDArray[np.bool_], spacing: float) -> list[int]:
    """The frames to choose of those of a video, sorted.

    From one view to the next the content grows by `spacing`. Within half of it around each view a frame is chosen by
    its sharpness, times one minus its distance from the view in spacings: half a spacing away it is to be twice as
    sharp.

    Args:
        content: (N,), not decreasing, see `content`.
        sharpness: (N,), positive; any unit.
        usable: (N,), whether a frame may be chosen.
        spacing: content from one view to the next.
    """
    if not usable.any():
        return []
    begin = float(content[usable][0])
    chosen = set()
    for i in range(view_count(float(content[usable][-1]) - begin, spacing)):
        target = begin + i * spacing
        first, last = np.searchsorted(content, [target - spacing / 2, target + spacing / 2])
        near = np.arange(first, last)[usable[first:last]]
        if len(near):
            worth = sharpness[near] * (1 - np.abs(content[near] - target) / spacing)
            chosen.add(int(near[worth.argmax()]))
    return sorted(chosen)


def view_count(extent: float, spacing: float) -> int:
    """How many views a video has whose content grows by `extent`."""
    return math.floor(extent / spacing) + 1


def common_spacing(extents: Sequence[float], frames: int) -> float:
    """The smallest spacing, at least 1, with which videos of these contents have at most so many views together.

    ValueError if there are more videos than frames.
    """
    if len(extents) > frames:
        raise ValueError(f"there are {len(extents)} videos: frames must be at least as many, is {frames}")

    def is_enough(spacing: float) -> bool:
        return sum(view_count(it, spacing) for it in extents) <= frames

    if is_enough(1.0):
        return 1.0
    low, high = 1.0, 2 * max(extents)  # with twice the largest content each video has one view
    for _ in range(_STEPS):
        middle = (low + high) / 2
        low, high = (low, middle) if is_enough(middle) else (middle, high)
    return high
