"""The mistake that explains why poses do not fit: which correction makes them fit best."""

import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ..views import PosedView
from .conventions import CORRECTIONS, ViewCorrection
from .errors import MatchedPair, PairError, Views, errors_of, summary, summary_with

FOCAL_SCALES = np.geomspace(0.2, 5.0, 33)
"""Wrong image sizes are usually wrong by a factor of up to four."""
FOCAL_TOLERANCE = 0.03
"""A focal length that would have to change by less is not the reason."""
_GAIN = 0.4  # an explanation must reduce the error to this share, or it explains nothing
_BAD_SHARE = 0.5  # of the pairs, that may stay bad
_MIXED_BAD_SHARE = 0.2  # stricter, because each pair is given the choice of which of its two to correct
_REFINEMENTS = 3
_ENOUGH_MATCHES = 64  # for a median that distinguishes mistakes


@dataclass(frozen=True)
class Explanation:
    """A likely mistake, and the photographs that it concerns, if not all; without text there is none.

    `error_px` is the median error of the pairs after its correction.
    """

    text: str = ""
    error_px: float = math.nan
    photographs: tuple[int, ...] = ()


def explain(views: Views, matched: Sequence[MatchedPair], given_px: float) -> Explanation:
    """Finds the mistake whose correction makes the poses fit best; `given_px` is the median error without it."""
    matched = [MatchedPair(item.pair, item.matches[:: 1 + len(item.matches) // _ENOUGH_MATCHES]) for item in matched]
    candidates = []
    for text, correction in CORRECTIONS.items():
        error_px, bad_share = summary_with(views, matched, correction)
        if bad_share < _BAD_SHARE:
            candidates.append(Explanation(text, error_px))
    for what, change in (("focal lengths are", _focal_scaled), ("focal lengths and principal points are", _scaled)):
        scale, error_px, bad_share = best_scale(views, matched, change)
        if abs(scale - 1) > FOCAL_TOLERANCE and FOCAL_SCALES[0] < scale < FOCAL_SCALES[-1] and bad_share < _BAD_SHARE:
            text = (
                f"the {what} {scale:.2f} times what is given (intrinsics of another image size, or of a video "
                "mode that crops?)"
            )
            candidates.append(Explanation(text, error_px))
    fitting = [candidate for candidate in candidates if candidate.error_px < _GAIN * given_px]
    if not fitting:  # perhaps it was made with some photographs only
        mixed = [_mixed(views, matched, text, correction) for text, correction in CORRECTIONS.items()]
        fitting = [explanation for explanation in mixed if explanation.text]
    return min(fitting, key=lambda it: it.error_px, default=Explanation())


def best_scale(
    views: Views, matched: Sequence[MatchedPair], change: Callable[[PosedView, float], PosedView]
) -> tuple[float, float, float]:
    """The factor by which to `change` all views with the least median error; that error, and the share of bad pairs."""

    def summary_at(scale: float) -> tuple[float, float]:
        return summary_with(views, matched, lambda view: change(view, scale))

    scales = FOCAL_SCALES
    for _ in range(_REFINEMENTS):
        best = int(np.argmin([summary_at(scale)[0] for scale in scales]))
        low, high = scales[max(best - 1, 0)], scales[min(best + 1, len(scales) - 1)]
        scale = float(scales[best])
        scales = np.geomspace(low, high, 9)
    return scale, *summary_at(scale)


def _mixed(views: Views, matched: Sequence[MatchedPair], text: str, correction: ViewCorrection) -> Explanation:
    """Explains pairs by correcting either, both or none of their photographs; empty if that does not fit."""
    turned = {i: correction(view) for i, view in views.items()}
    best: list[PairError] = []
    votes: Counter[int] = Counter()
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
                votes[i] += 1 if i in chosen else -1
    error_px, bad_share = summary(best)
    concerned = tuple(sorted(i for i, count in votes.items() if count > 0))
    if bad_share >= _MIXED_BAD_SHARE or not concerned:
        return Explanation()
    return Explanation(f"with some photographs, not all, {text}", error_px, concerned)


def _focal_scaled(view: PosedView, scale: float) -> PosedView:
    camera = view.view.camera
    scaled = replace(camera, focal_x_px=scale * camera.focal_x_px, focal_y_px=scale * camera.focal_y_px)
    return replace(view, view=replace(view.view, camera=scaled))


def _scaled(view: PosedView, scale: float) -> PosedView:
    camera = _focal_scaled(view, scale).view.camera
    scaled = replace(camera, principal_x_px=scale * camera.principal_x_px, principal_y_px=scale * camera.principal_y_px)
    return replace(view, view=replace(view.view, camera=scaled))
