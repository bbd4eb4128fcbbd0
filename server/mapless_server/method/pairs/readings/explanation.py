"""The mistake that explains why poses do not fit: the correction that makes them fit.

A mistake explains if its correction leaves less than `GAIN` of the error, and most pairs good. Of several that fit
equally well, the more common ones are named; of two, both; of more, none, since the photographs do not say which.
"""

import math
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from ...features.views import PosedView
from ..agreement import LARGEST_ERROR_PX
from .alignment import align_sessions
from .conventions import CONVENTIONS, RARE, STRANGE, USUAL, Convention, Mistake
from .errors import FEW_SHARE, SAMPLED_MATCHES, MatchedPair, PairError, PairSample, Views, summary
from .intrinsics import camera_mistakes, focal_scaled, is_unset, scaled, usual_camera, with_camera
from .rounding import rounding_text
from .sessions import sessions_of

FOCAL_SCALES = np.geomspace(0.2, 5.0, 33)
"""Factors on focal lengths that are tried: image sizes are usually wrong by a factor of up to four."""
GAIN = 0.4
"""Share of the error that an explanation may leave."""
EQUAL_SHARE, EQUAL_PX = 1.25, 0.1
"""Errors that differ by less than this factor, and this distance, are equal: noise of medians."""
MOST_NAMED = 2
"""Explanations that are named together, of those that fit equally well."""


@dataclass(frozen=True)
class Explanation:
    """A likely mistake, and the photographs that it concerns, if not all; without text there is none.

    `error_px` is the median error of the pairs after its correction; NaN where the right poses are unknown.
    """

    text: str = ""
    error_px: float = math.nan
    photographs: tuple[int, ...] = ()


@dataclass(frozen=True)
class _Candidate:
    text: str
    error_px: float
    bad_share: float
    rarity: int


def explain(views: Views, matched: Sequence[MatchedPair]) -> Explanation:
    """Finds the mistake whose correction makes the poses fit."""
    sample = PairSample(views, [item for item in matched if len(item.matches)], SAMPLED_MATCHES)
    if not sample.pairs:
        return Explanation()
    errors = sample.measure()
    given_px = _score(errors)[0]
    mistakes = [*map(_of_view, CONVENTIONS), *camera_mistakes(list(sample.views.values()))]
    candidates = [_Candidate(it.text, *_score_with(sample, it.correct), it.rarity) for it in mistakes]
    candidates += _scalings(sample)
    fitting = [it for it in candidates if it.bad_share < 0.5 and it.error_px < GAIN * given_px]
    if fitting:
        return _named(fitting)
    if text := rounding_text(sample, summary(errors)[0]):
        return Explanation(text)
    if apart := _sessions(views, matched, errors):
        return apart
    # Perhaps a mistake was made with some photographs only.
    mixed = [(it.rarity, _mixed(sample, it)) for it in mistakes if it.rarity < STRANGE]
    found = [(rarity, it) for rarity, it in mixed if it.text]
    return min(found, key=lambda it: (it[0], it[1].error_px), default=(USUAL, Explanation()))[1]


def _sessions(views: Views, matched: Sequence[MatchedPair], errors: Sequence[PairError]) -> Explanation | None:
    """Explains pairs by two sessions, with the similarity that aligns the smaller one, if the pairs determine it."""
    groups = sessions_of({it.pair: not it.is_bad for it in errors})
    if groups is None or sum(map(len, groups)) < (1 - FEW_SHARE) * len({i for it in errors for i in it.pair}):
        return None
    first, second = groups
    text = (
        f"two sessions, {len(first)} and {len(second)} photographs that agree among themselves but not with each "
        "other, each in a world of its own"
    )
    found = align_sessions(views, matched, first, second)
    if found is None:
        return Explanation(text, photographs=second)
    return Explanation(f"{text}: the smaller one fits with {found.text}", found.median_px, second)


def _named(fitting: Sequence[_Candidate]) -> Explanation:
    """The best candidates, the most common ones of those that are equal."""
    best = min(it.error_px for it in fitting)
    equal = [it for it in fitting if it.error_px <= max(EQUAL_SHARE * best, best + EQUAL_PX)]
    rarity = min(it.rarity for it in equal)
    named = sorted((it for it in equal if it.rarity == rarity), key=lambda it: it.error_px)
    if len(named) > MOST_NAMED:
        return Explanation()
    return Explanation("; or ".join(it.text for it in named), named[0].error_px)


def _of_view(convention: Convention) -> Mistake[PosedView]:
    def correct(view: PosedView) -> PosedView:
        return replace(view, world_from_camera=convention.correct(view.world_from_camera))

    return Mistake(convention.text, correct, convention.rarity)


def _score(errors: Sequence[PairError]) -> tuple[float, float]:
    """Median error, that of pairs behind their cameras being large, and share of bad pairs."""
    costs = [LARGEST_ERROR_PX if it.is_behind or math.isnan(it.error_px) else it.error_px for it in errors]
    return float(np.median(costs)), float(np.mean([it.is_bad for it in errors]))


def _score_with(sample: PairSample, change: Callable[[PosedView], PosedView]) -> tuple[float, float]:
    return _score(sample.measure({i: change(view) for i, view in sample.views.items()}))


def _scalings(sample: PairSample) -> Iterator[_Candidate]:
    """Explanations by focal lengths that fit: of another image size, or of no camera at all."""
    cameras = [view.view.camera for view in sample.views.values()]
    if any(map(is_unset, cameras)):
        yield from _unset(sample)
        return
    for what, change in (("focal lengths are", focal_scaled), ("focal lengths and principal points are", scaled)):
        scale, error_px, bad_share = best_scale(sample, change)
        if FOCAL_SCALES[0] < scale < FOCAL_SCALES[-1]:
            text = (
                f"the {what} {scale:.2f} times what is given (intrinsics of another image size, or of a video "
                "mode that crops?)"
            )
            yield _Candidate(text, error_px, bad_share, RARE)


def _unset(sample: PairSample) -> Iterator[_Candidate]:
    """A focal length of no camera: the one that fits, with the principal point in the image's centre."""

    def change(view: PosedView, scale: float) -> PosedView:
        return focal_scaled(with_camera(view, usual_camera(view.view.camera)), scale)

    scale, error_px, bad_share = best_scale(sample, change)
    cameras = [it.view.camera for it in sample.views.values()]
    given = np.median([it.focal_x_px for it in cameras])
    found = np.median([scale * usual_camera(it).focal_x_px for it in cameras])
    text = (
        f"K was not set (a camera that is not calibrated), or is not in pixels: focal lengths of {given:.3g} px are "
        f"those of no camera; about {found:.0f} px fit"
    )
    yield _Candidate(text, error_px, bad_share, USUAL)


def best_scale(sample: PairSample, change: Callable[[PosedView, float], PosedView]) -> tuple[float, float, float]:
    """The factor by which to `change` all views with the least median error; that error, and the share of bad pairs."""

    def score_at(scale: float) -> tuple[float, float]:
        return _score_with(sample, lambda view: change(view, scale))

    scales = FOCAL_SCALES
    for _ in range(3):  # finds the factor to half a per cent
        best = int(np.argmin([score_at(scale)[0] for scale in scales]))
        low, high = scales[max(best - 1, 0)], scales[min(best + 1, len(scales) - 1)]
        scale = float(scales[best])
        scales = np.geomspace(low, high, 9)
    return scale, *score_at(scale)


def _mixed(sample: PairSample, mistake: Mistake[PosedView]) -> Explanation:
    """Explains pairs by correcting either, both or none of their photographs; empty if that does not fit."""
    views, corrected = sample.views, {i: mistake.correct(view) for i, view in sample.views.items()}
    choices = ((views, views), (corrected, views), (views, corrected), (corrected, corrected))
    measured = [sample.measure(*it) for it in choices]
    best: list[PairError] = []
    votes: Counter[int] = Counter()
    for errors in zip(*measured, strict=True):
        chosen = int(np.argmin([_score([it])[0] for it in errors]))
        best.append(errors[chosen])
        for side, i in enumerate(errors[chosen].pair):
            votes[i] += 1 if chosen in ((1, 3), (2, 3))[side] else -1
    error_px, bad_share = _score(best)
    concerned = tuple(sorted(i for i, votes_for in votes.items() if votes_for > 0))
    if bad_share >= FEW_SHARE or not concerned:
        return Explanation()
    return Explanation(f"with some photographs, not all, {mistake.text}", error_px, concerned)
