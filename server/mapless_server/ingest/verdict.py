"""What the epipolar errors of pairs say of a scene's poses: fine, wrong as a whole and how, or wrong here and there."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..method.correspond import Matches
from ..method.epipolar import pair_error_px
from ..method.views import PosedView
from .conventions import CONVENTIONS, FOCAL_SCALES, corrected, focal_scaled
from .pairs import Pair

THRESHOLD_PX = 3.0
"""Of an image whose longer side is 1024 pixels. Good poses give 0.1 (surveyed) to 0.8 px (motion capture, a rolling
shutter); a phone's tracking up to two. Wrong conventions give tens."""

FOCAL_TOLERANCE = 0.03
"""A focal length that would have to change by less is not the reason."""

_GAIN = 0.4  # an explanation must reduce the error to this share, or it explains nothing
_WRONG_SHARE = 0.4  # more bad pairs than one photograph in five could make
_GUILTY_SHARE = 0.6
_GUILTY_PAIRS = 2
_REFINEMENTS = 3
_ENOUGH_MATCHES = 64  # for a median that tells hypotheses apart


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


@dataclass(frozen=True)
class Verdict:
    """Of all pairs.

    Attributes:
        pairs: those that had matches.
        unmatched_count: pairs that had too few.
        median_px: of the pairs' errors; NaN without pairs.
        bad_share: of the pairs; NaN without pairs.
        threshold_px: median of the pairs' thresholds.
        suspects: photographs that do not fit their neighbours while the scene as a whole does.
        explanation: the likely mistake if the scene as a whole is wrong; empty if none was found.
        explained_px: the median if that mistake were corrected.
    """

    pairs: tuple[PairError, ...]
    unmatched_count: int
    median_px: float
    bad_share: float
    threshold_px: float
    suspects: tuple[int, ...] = ()
    explanation: str = ""
    explained_px: float = math.nan

    @property
    def is_known(self) -> bool:
        """Whether there was anything to judge by."""
        return bool(self.pairs)

    @property
    def is_wrong(self) -> bool:
        """Whether the scene as a whole does not fit: too many pairs are bad for single photographs to be the reason."""
        return self.is_known and self.bad_share > _WRONG_SHARE


Views = Mapping[int, PosedView]


def judge(views: Views, matched: Sequence[MatchedPair], unmatched_count: int = 0) -> Verdict:
    """The verdict on pairs.

    Args:
        views: by the index that pairs use.
        matched: pairs that have matches.
        unmatched_count: those that were tried and have too few.
    """
    errors = errors_of(views, matched)
    if not errors:
        return Verdict((), unmatched_count, math.nan, math.nan, THRESHOLD_PX)
    median_px, bad_share = _summary(errors)
    threshold_px = float(np.median([error.threshold_px for error in errors]))
    verdict = Verdict(tuple(errors), unmatched_count, median_px, bad_share, threshold_px)
    if verdict.is_wrong:
        explanation, explained_px = explain(views, matched, median_px)
        verdict = replace(verdict, explanation=explanation, explained_px=explained_px)
    return verdict if verdict.explanation else replace(verdict, suspects=suspects_of(errors))


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


def explain(views: Views, matched: Sequence[MatchedPair], given_px: float) -> tuple[str, float]:
    """The mistake that, corrected, makes the poses fit best, and the median error then; empty if none does."""
    matched = [MatchedPair(item.pair, item.matches[:: 1 + len(item.matches) // _ENOUGH_MATCHES]) for item in matched]
    candidates = [
        (name, *_summary_with(views, matched, lambda view, c=correction: corrected(view, c)))  # type: ignore[misc]
        for name, correction in CONVENTIONS.items()
    ]
    scale, median_px, bad_share = best_focal_scale(views, matched)
    if abs(scale - 1) > FOCAL_TOLERANCE and FOCAL_SCALES[0] < scale < FOCAL_SCALES[-1]:
        name = (
            f"the focal lengths are {scale:.2f} times what is given (intrinsics of another image size, or of a video "
            "mode that crops?)"
        )
        candidates.append((name, median_px, bad_share))
    fitting = [(px, name) for name, px, share in candidates if share < 0.5 and px < _GAIN * given_px]
    if not fitting:
        return "", math.nan
    best_px, best = min(fitting)
    return best, best_px


def best_focal_scale(views: Views, matched: Sequence[MatchedPair]) -> tuple[float, float, float]:
    """The factor on all focal lengths with the least median error, that error, and the share of bad pairs then."""
    scales = FOCAL_SCALES
    for _ in range(_REFINEMENTS):
        medians = [
            _summary_with(views, matched, lambda view, s=scale: focal_scaled(view, s))[0]  # type: ignore[misc]
            for scale in scales
        ]
        best = int(np.argmin(medians))
        low, high = scales[max(best - 1, 0)], scales[min(best + 1, len(scales) - 1)]
        scale = float(scales[best])
        scales = np.geomspace(low, high, 9)
    return scale, *_summary_with(views, matched, lambda view: focal_scaled(view, scale))


def suspects_of(errors: Sequence[PairError]) -> tuple[int, ...]:
    """Photographs almost all of whose pairs are bad; the worst first, whose pairs then accuse nobody else."""
    left = list(errors)
    suspects: list[int] = []
    while True:
        total = Counter(i for error in left for i in error.pair)
        bad = Counter(i for error in left if error.is_bad for i in error.pair)
        guilty = [i for i in bad if bad[i] >= _GUILTY_PAIRS and bad[i] >= _GUILTY_SHARE * total[i]]
        if not guilty:
            return tuple(suspects)
        worst = max(guilty, key=lambda i: (bad[i] / total[i], bad[i], -i))
        suspects.append(worst)
        left = [error for error in left if worst not in error.pair]


def _summary(errors: Sequence[PairError]) -> tuple[float, float]:
    """Median error, and share of the bad."""
    if not errors:
        return math.inf, 1.0
    return float(np.median([error.error_px for error in errors])), float(np.mean([error.is_bad for error in errors]))


def _summary_with(
    views: Views, matched: Sequence[MatchedPair], change: Callable[[PosedView], PosedView]
) -> tuple[float, float]:
    used = {i for item in matched for i in item.pair}
    return _summary(errors_of({i: change(views[i]) for i in used}, matched))
