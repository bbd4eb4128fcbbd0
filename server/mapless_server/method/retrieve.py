"""Choosing references for a photograph: those that share the most matches with it, not all from one spot.

The rule looks at nothing but the photographs, so it never uses what it is asked for, the query's pose.
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
        apart_m: references closer together than this see the same and triangulate nothing (the paper's baseline).
        nearby_weight: what the match count of a reference is worth when one within `apart_m` is chosen already. 0 would
            spread the references at any price; half of the matches is worth a baseline, a tenth is not: in a dense
            sequence the strictly spread ones see so little of the query that they cost a third of the accuracy.
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
    """Takes the best score again and again, where a candidate near a chosen one scores less; ties go to the first.

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
