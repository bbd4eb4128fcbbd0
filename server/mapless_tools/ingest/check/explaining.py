"""Which usual mistake would make poses fit that do not."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from .conventions import CONVENTIONS, FOCAL_SCALES, Correction, corrected, focal_scaled
from .errors import MatchedPair, PairError, Views, errors_of, summary, summary_with

FOCAL_TOLERANCE = 0.03
"""A focal length that would have to change by less is not the reason."""

_GAIN = 0.4  # an explanation must reduce the error to this share, or it explains nothing
_BAD_SHARE = 0.5  # of the pairs, that may stay bad
_MIXED_BAD_SHARE = 0.2  # stricter, because each pair is given the choice of which of its two to correct
_REFINEMENTS = 3
_ENOUGH_MATCHES = 64  # for a median that tells mistakes apart


@dataclass(frozen=True)
class Explanation:
    """A likely mistake.

    Attributes:
        text: what a person is told; empty if there is none.
        error_px: median error of the pairs if it were corrected.
        photographs: those that it concerns, where it does not concern all.
    """

    text: str = ""
    error_px: float = math.nan
    photographs: tuple[int, ...] = ()


def explain(views: Views, matched: Sequence[MatchedPair], given_px: float) -> Explanation:
    """The mistake that, corrected, makes the poses fit best.

    Args:
        views: as given.
        matched: pairs of them.
        given_px: their median error as given.
    """
    matched = [MatchedPair(item.pair, item.matches[:: 1 + len(item.matches) // _ENOUGH_MATCHES]) for item in matched]
    candidates = []
    for text, correction in CONVENTIONS.items():
        error_px, bad_share = summary_with(views, matched, lambda view, c=correction: corrected(view, c))  # type: ignore[misc]
        if bad_share < _BAD_SHARE:
            candidates.append(Explanation(text, error_px))
    scale, error_px, bad_share = best_focal_scale(views, matched)
    if abs(scale - 1) > FOCAL_TOLERANCE and FOCAL_SCALES[0] < scale < FOCAL_SCALES[-1] and bad_share < _BAD_SHARE:
        text = (
            f"the focal lengths are {scale:.2f} times what is given (intrinsics of another image size, or of a video "
            "mode that crops?)"
        )
        candidates.append(Explanation(text, error_px))
    fitting = [candidate for candidate in candidates if candidate.error_px < _GAIN * given_px]
    return min(fitting, key=lambda candidate: candidate.error_px) if fitting else _explain_mixed(views, matched)


def best_focal_scale(views: Views, matched: Sequence[MatchedPair]) -> tuple[float, float, float]:
    """The factor on all focal lengths with the least median error, that error, and the share of bad pairs then."""
    scales = FOCAL_SCALES
    for _ in range(_REFINEMENTS):
        medians = [
            summary_with(views, matched, lambda view, s=scale: focal_scaled(view, s))[0]  # type: ignore[misc]
            for scale in scales
        ]
        best = int(np.argmin(medians))
        low, high = scales[max(best - 1, 0)], scales[min(best + 1, len(scales) - 1)]
        scale = float(scales[best])
        scales = np.geomspace(low, high, 9)
    return scale, *summary_with(views, matched, lambda view: focal_scaled(view, scale))


def _explain_mixed(views: Views, matched: Sequence[MatchedPair]) -> Explanation:
    """A mistake that was made with some photographs only; none if that does not explain it either."""
    found = [_mixed(views, matched, text, correction) for text, correction in CONVENTIONS.items()]
    fitting = [explanation for explanation in found if explanation.text]
    return min(fitting, key=lambda explanation: explanation.error_px) if fitting else Explanation()


def _mixed(views: Views, matched: Sequence[MatchedPair], text: str, correction: Correction) -> Explanation:
    """With every pair free to have either, both or none of its photographs corrected."""
    turned = {i: corrected(view, correction) for i, view in views.items()}
    best: list[PairError] = []
    said: Counter[int] = Counter()
    for item in matched:
        choices = [
            (error, chosen)
            for chosen in ((), item.pair[:1], item.pair[1:], item.pair)
            for error in errors_of({i: (turned if i in chosen else views)[i] for i in item.pair}, [item])
        ]
        if choices:
            error, chosen = min(choices, key=lambda choice: choice[0].error_px)
            best.append(error)
            for i in item.pair:
                said[i] += 1 if i in chosen else -1
    error_px, bad_share = summary(best)
    concerned = tuple(sorted(i for i, votes in said.items() if votes > 0))
    if bad_share >= _MIXED_BAD_SHARE or not concerned:
        return Explanation()
    return Explanation(f"with some photographs, not all, {text}", error_px, concerned)
