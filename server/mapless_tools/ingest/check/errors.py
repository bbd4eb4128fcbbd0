"""Pairs of photographs, their matches, and how far these are from satisfying the poses."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapless_server.method.views import Matches, PosedView

from .epipolar import pair_error_px
from .pairs import Pair

THRESHOLD_PX = 3.0
"""Of an image whose longer side is 1024 pixels. Good poses give 0.1 (surveyed) to 0.8 px (motion capture, a rolling
shutter); a phone's tracking up to two. Wrong conventions give tens."""


@dataclass(frozen=True, eq=False)
class MatchedPair:
    """Two photographs and the matches that a fundamental matrix of their own explains."""

    pair: Pair
    matches: Matches


@dataclass(frozen=True)
class PairError:
    """Median epipolar error of a pair, and the error above which it is bad, pixels of the processed image."""

    pair: Pair
    error_px: float
    threshold_px: float
    match_count: int

    @property
    def is_bad(self) -> bool:
        """Whether it does not satisfy the poses."""
        return not self.error_px <= self.threshold_px


Views = Mapping[int, PosedView]
"""By the index that pairs use."""


def errors_of(views: Views, matched: Sequence[MatchedPair]) -> list[PairError]:
    """The pairs' errors, without those of photographs at one place."""
    errors = []
    for item in matched:
        first, second = (views[i] for i in item.pair)
        error_px = pair_error_px(first, second, item.matches)
        sides = (max(view.view.camera.width_px, view.view.camera.height_px) for view in (first, second))
        if not math.isnan(error_px):
            errors.append(PairError(item.pair, error_px, THRESHOLD_PX * max(sides) / 1024, len(item.matches)))
    return errors


def summary(errors: Sequence[PairError]) -> tuple[float, float]:
    """Median error, and share of the bad."""
    if not errors:
        return math.inf, 1.0
    return float(np.median([error.error_px for error in errors])), float(np.mean([error.is_bad for error in errors]))


def summary_with(
    views: Views, matched: Sequence[MatchedPair], change: Callable[[PosedView], PosedView]
) -> tuple[float, float]:
    """The same if every view were changed."""
    used = {i for item in matched for i in item.pair}
    return summary(errors_of({i: change(views[i]) for i in used}, matched))
