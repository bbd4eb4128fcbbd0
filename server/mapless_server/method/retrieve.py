"""Choosing references for a photograph: those with the most matches, from different places.

The choice uses the photographs and the references' poses only, never the query's pose.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .correspond import CorrespondOptions, mutual_matches
from .options import check_bounds
from .views import PosedView, View


@dataclass(frozen=True)
class RetrieveOptions:
    """Options of the choice.

    Attributes:
        apart_m: references closer together than this triangulate nothing (the paper's least baseline).
        nearby_weight: factor on the match count of a reference within `apart_m` of a chosen one. 0 would spread the
            references at any cost: in a dense sequence such references show so little of the query that a third of
            the accuracy is lost.
    """

    apart_m: float = 0.3
    nearby_weight: float = 0.5

    def __post_init__(self) -> None:
        check_bounds(self, "apart_m", at_least=0)
        check_bounds(self, "nearby_weight", at_least=0, at_most=1)


def choose_references(
    query: View,
    candidates: Sequence[PosedView],
    count: int,
    options: RetrieveOptions | None = None,
    ratio: float = CorrespondOptions.query_ratio,
) -> list[int]:
    """Indices of at most `count` candidates, in the order of choice, the most similar first.

    `ratio` is the extractor's: `CorrespondOptions.query_ratio`.
    """
    matches = [len(mutual_matches(query.features, c.view.features, ratio)) for c in candidates]
    return spread_choice(matches, [c.world_from_camera.translation for c in candidates], count, options)


def spread_choice(
    match_counts: ArrayLike, centres: ArrayLike, count: int, options: RetrieveOptions | None = None
) -> list[int]:
    """Greedy choice by match count, reduced for candidates near a chosen one; the first of equals.

    Args:
        match_counts: (N,) matches with the query.
        centres: (N, 3) camera centres, metres.
        count: how many to choose.
        options: see there.
    """
    options = options or RetrieveOptions()
    score: NDArray[np.float64] = np.asarray(match_counts, float)
    centre = np.asarray(centres, float).reshape(-1, 3)
    nearby = np.zeros(len(score), bool)
    chosen: list[int] = []
    for _ in range(min(count, len(score))):
        weighted = np.where(nearby, options.nearby_weight, 1.0) * score
        weighted[chosen] = -1.0
        best = int(np.argmax(weighted))
        chosen.append(best)
        nearby |= np.linalg.norm(centre - centre[best], axis=1) < options.apart_m
    return chosen
