"""Whether something grows over hours: a robust slope, and between which slopes the true one lies.

What a process holds moves in steps and waves, so that neighbouring samples are alike, and now and then one is far off.
The slope is therefore Theil's and Sen's, the median of the slopes between all pairs of samples, which a third of wild
samples does not move; and what it may be off by comes of drawing its residuals again in blocks long enough to hold the
waves (the circular block bootstrap of Politis and Romano), not of a formula for independent samples.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import ndtri, stdtrit

from mapless.geometry import Array

CONFIDENCE = 0.99
"""Of each interval: several slopes are asked at once, and all of six hold together in 94 % of cases at least."""
RESAMPLES = 400
MAX_SAMPLES = 120
"""More are first put together, an odd number of them each to their median: all pairs of them are looked at."""
MIN_SAMPLES = 12
_ALIKE = 0.05
"""A correlation below this is none."""


@dataclass(frozen=True)
class Slope:
    """How something develops.

    Attributes:
        level: median of the samples.
        per_hour: the slope.
        low, high: between which the true slope lies, with `CONFIDENCE`.
        hours: that the samples span.
        block: samples that are taken to be alike.
    """

    level: float
    per_hour: float
    low: float
    high: float
    hours: float
    block: int

    @property
    def is_flat(self) -> bool:
        """Whether it is indistinguishable from zero."""
        return self.low <= 0 <= self.high

    @property
    def grows(self) -> bool:
        """Whether that it grows is beyond doubt."""
        return self.low > 0

    @property
    def verdict(self) -> str:
        """In words."""
        return "flat" if self.is_flat else "grows" if self.grows else "falls"


def slope(times_s: Sequence[float], values: Sequence[float], seed: int = 0) -> Slope:
    """The slope of samples in the order of time, with its interval; the same for the same seed.

    Raises:
        ValueError: fewer than `MIN_SAMPLES`, or times that do not ascend.
    """
    hours, y = np.asarray(times_s, float) / 3600, np.asarray(values, float)
    if len(hours) != len(y) or len(y) < MIN_SAMPLES or not (np.diff(hours) > 0).all():
        raise ValueError(f"a slope needs {MIN_SAMPLES} samples in the order of time")
    level, span = float(np.median(y)), float(hours[-1] - hours[0])
    hours, y = _thinned(hours, y)
    pairs = np.triu_indices(len(hours), 1)
    apart = hours[pairs[1]] - hours[pairs[0]]
    found = _theil_sen(y, pairs, apart)
    residuals = y - found * hours
    residuals -= np.median(residuals)
    block = _block(residuals)
    random = np.random.default_rng(seed)
    around = found * hours
    slopes = [_theil_sen(around + _redrawn(residuals, block, random), pairs, apart) for _ in range(RESAMPLES)]
    tail = (1 - CONFIDENCE) / 2
    low, high = np.quantile(slopes, [tail, 1 - tail])
    wider = _few_blocks(len(y) / block)
    below, above = max(0.0, found - float(low)), max(0.0, float(high) - found)
    return Slope(level, found, found - wider * below, found + wider * above, span, block)


def _thinned(hours: Array, y: Array) -> tuple[Array, Array]:
    each = -(-len(y) // MAX_SAMPLES)
    if each == 1:
        return hours, y
    each += 1 - each % 2
    count = len(y) // each
    return hours[: count * each].reshape(count, each).mean(1), np.median(y[: count * each].reshape(count, each), 1)


def _theil_sen(y: Array, pairs: tuple[np.ndarray, np.ndarray], apart: Array) -> float:
    return float(np.median((y[pairs[1]] - y[pairs[0]]) / apart))


def _block(residuals: Array) -> int:
    """How many samples in a row are drawn together: twice as many as are alike, at most a quarter of all."""
    count = len(residuals)
    spread = float(residuals @ residuals)
    alike = 1.0
    for lag in range(1, count // 2):
        correlation = float(residuals[lag:] @ residuals[:-lag]) / spread if spread > 0 else 0.0
        if correlation < _ALIKE:
            break
        alike += 2 * correlation
    return min(max(math.ceil(2 * alike), round(float(np.cbrt(count)))), count // 4)


def _few_blocks(count: float) -> float:
    """How much wider the interval is for the few blocks that it comes of, which fit the line all too well.

    Student's quantile in place of the normal one, and the residuals' spread without the two numbers that the line took.
    """
    freedom, share = max(count - 2, 1.0), (1 + CONFIDENCE) / 2
    return float(stdtrit(freedom, share) / ndtri(share) * math.sqrt(count / freedom))


def _redrawn(residuals: Array, block: int, random: np.random.Generator) -> Array:
    count = len(residuals)
    starts = random.integers(0, count, -(-count // block))
    redrawn: Array = residuals[(starts[:, None] + np.arange(block)).ravel()[:count] % count]
    return redrawn
