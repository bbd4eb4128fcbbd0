"""Pixels of 16 bits as 8: cameras fill 10, 12, 14 or all bits, and thermal ones a range of them; no file says which."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

CLIPPED_SHARE = 0.001
"""Share of the values that is clipped at each end of the range: hot and dead pixels do not set it."""

_LEVELS = 65536
_BLOCK = 2**20  # values counted at a time: numpy converts them to eight bytes each


def eight_bits(values: NDArray[Any]) -> NDArray[np.uint8]:
    """Stretches values of 16 bits, (H, W) or (H, W, C), to 0 to 255, by one gain and offset for all of the image.

    The range is that of the values without CLIPPED_SHARE at each end. The values 0 and 65535 do not count for it, which
    borders and dead pixels have, unless there are hardly others; nor does a fourth channel, which is alpha. A range
    that is empty is widened to all values; of an image of one value nothing can be said, and it is black.
    """
    values = np.asarray(values, np.uint16)
    shown = values[..., :3] if values.ndim == 3 else values
    counts = np.zeros(_LEVELS, np.int64)
    flat = shown.reshape(-1)
    for start in range(0, flat.size, _BLOCK):
        counts += np.bincount(flat[start : start + _BLOCK], minlength=_LEVELS)
    low, high = _range(counts)
    table = (np.arange(_LEVELS, dtype=np.float64) - low) * (255 / max(high - low, 1))
    return np.asarray(np.clip(table + 0.5, 0, 255).astype(np.uint8)[values])


def _range(counts: NDArray[np.int64]) -> tuple[int, int]:
    """The ends of the range of an image, by how often it has each value."""
    inner = counts.copy()
    inner[[0, -1]] = 0
    total = int(inner.sum())
    if total > CLIPPED_SHARE * counts.sum():
        below = np.cumsum(inner)
        low = int(np.searchsorted(below, CLIPPED_SHARE * total, "right"))
        high = int(np.searchsorted(below, total - CLIPPED_SHARE * total))
        if high > low:
            return low, high
    there = np.flatnonzero(counts)
    return (int(there[0]), int(there[-1])) if there.size else (0, 0)
