"""The order of references for a photograph: by similarity, thinned to a baseline, narrowed by what is known beforehand.

Two references at one place that look the same way see the same and triangulate nothing, so after the first of them the
second counts for less. It is not left out: in a dense sequence the strictly spread ones see so little of the query that
they cost a third of the accuracy. But where a camera stood still, on a tripod or at a robot's dock, hundreds are more
alike than any other: of those a few are chosen, and then others before the rest.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapless.geometry import Array, RigidTransform
from mapless_server.method.options import check_bounds

from .descriptor import Vector
from .index import Entries, Rows
from .narrowing import Narrowing


@dataclass(frozen=True)
class RankOptions:
    """Options of the ranking.

    Attributes:
        apart_m: references closer together than this triangulate nothing (the paper's baseline),
        apart_deg: if their optical axes are closer than this too: one that looks elsewhere sees other things.
        nearby_weight: what is left of a reference's lead over the scene's typical similarity when one nearby is chosen
            already. 1 does not thin, 0 spreads at any price. In the kitchen of 7-Scenes (100 references, 60 queries)
            the median errors with 1, 0.75 and 0.5 are 0.13, 0.15 and 0.15 cm, and 90 % lie below 0.27, 0.29 and 0.32;
            with 0 the chosen share half as many matches with the query.
        same_place_m: of references that stand closer together than this and look the same way a photograph of the same
            place resembles all about equally, and ten of them tell no depth. A video at walking speed has two or three.
        per_place: so many of them are chosen, but no more than half of what is wanted, before all others.
        pool: so many times the references that are wanted are looked at, the most similar ones. Those behind them are
            never chosen instead of one that is nearby, unless too few of them stand at places of their own.
        smallest_pool: but at least so many.
    """

    apart_m: float = 0.3
    apart_deg: float = 30.0
    nearby_weight: float = 0.75
    same_place_m: float = 0.05
    per_place: int = 3
    pool: int = 10
    smallest_pool: int = 200

    def __post_init__(self) -> None:
        check_bounds(self, "apart_m same_place_m", at_least=0)
        check_bounds(self, "apart_deg", at_least=0, at_most=180)
        check_bounds(self, "nearby_weight", at_least=0, at_most=1)
        check_bounds(self, "per_place pool smallest_pool", at_least=1)


@dataclass(frozen=True, eq=False)
class RankedReference:
    """A reference and how much it resembles the photograph.

    Attributes:
        reference_id: unique in its scene.
        key: identifies this very reference for good.
        similarity: cosine of the descriptors, -1 to 1; NaN where the reference or the photograph has none.
        world_from_camera: its pose, metric.
    """

    reference_id: str
    key: str
    similarity: float
    world_from_camera: RigidTransform


def rank_references(
    entries: Entries,
    vector: Vector | None,
    count: int,
    narrowing: Narrowing | None = None,
    among: Collection[str] | None = None,
    options: RankOptions | None = None,
) -> list[RankedReference]:
    """At most `count` references in the order of choice; fewer where fewer come into question.

    References without a descriptor come last; these, and all where the photograph has none, are ordered by how near
    they are to where the camera is thought to be, or as they were stored.

    Args:
        entries: of the scene.
        vector: the photograph's descriptor, (D,); None if it has none.
        count: how many.
        narrowing: which references come into question.
        among: ids of those to choose from; None for all. Unknown ones are passed over.
        options: see there.
    """
    options, narrowing = options or RankOptions(), narrowing or Narrowing()
    rows = entries.rows(among)
    if not narrowing.is_empty:
        rows = rows[narrowing.keeps(entries.centres(rows), entries.axes(rows))]
    if not len(rows) or count < 1:
        return []
    similarity = np.full(len(rows), np.nan, np.float32) if vector is None else entries.similarities(vector, rows)
    score = _scores(similarity, entries, rows, narrowing)
    known = similarity[~np.isnan(similarity)]
    typical = float(np.median(known)) if len(known) else math.inf
    wanted, size = min(count, len(rows)), max(options.pool * count, options.smallest_pool)
    while True:
        pool = _best(score, size)
        at = rows[pool]
        order = spread(score[pool], entries.centres(at), entries.axes(at), wanted, typical, options)
        if len(order) == wanted or len(pool) == len(rows):
            break
        size *= 10
    rest = np.setdiff1d(np.arange(len(pool)), order)  # in the order of their scores
    chosen = pool[[*order, *rest[: wanted - len(order)]]]
    return [_ranked(entries, int(rows[i]), float(similarity[i])) for i in chosen]


def spread(
    scores: ArrayLike, centres: ArrayLike, axes: ArrayLike, count: int, typical: float, options: RankOptions
) -> list[int]:
    """Takes the best score again and again, where one near a chosen one has less of a lead; ties go to the first.

    Where enough have been taken from one place, the others there are passed over.

    Args:
        scores: (N,) finite, or -inf.
        centres: (N, 3) camera centres, metres.
        axes: (N, 3) optical axes, unit length.
        count: how many to choose.
        typical: score that is no lead: those below it lose nothing.
        options: see there.

    Returns:
        Indices in the order of choice, not more than `count`; fewer if the rest are passed over.
    """
    score, centre, axis = np.asarray(scores, float), np.asarray(centres, float), np.asarray(axes, float)
    lead = np.maximum(score - typical, 0.0)
    lowered = score - (1 - options.nearby_weight) * lead
    same_way = math.cos(math.radians(options.apart_deg))
    left = np.ones(len(score), bool)
    current = score.copy()
    chosen: list[int] = []
    taken_there = np.zeros(len(score), int)
    most_there = max(1, min(options.per_place, count // 2))
    while len(chosen) < count and left.any():
        candidates = np.flatnonzero(left)
        best = int(candidates[np.argmax(current[candidates])])
        chosen.append(best)
        away_m = np.linalg.norm(centre - centre[best], axis=1)
        alike = axis @ axis[best] >= same_way
        current = np.where((away_m < options.apart_m) & alike, lowered, current)
        taken_there += (away_m < options.same_place_m) & alike
        left &= taken_there < most_there
        left[best] = False
    return chosen


def _scores(similarity: NDArray[np.float32], entries: Entries, rows: Rows, narrowing: Narrowing) -> Array:
    """Similarities (N,), and for those that are unknown something lower: the less, the further from the prior."""
    scores = similarity.astype(np.float64)
    unknown = np.flatnonzero(np.isnan(similarity))
    scores[unknown] = -2.0
    if narrowing.centre is not None and len(unknown):
        centres = entries.centres(rows[unknown])
        scores[unknown] -= np.linalg.norm(centres - narrowing.centre, axis=1)
    return scores


def _best(score: Array, count: int) -> Rows:
    """Indices of the `count` best scores, the best first; ties in order."""
    if count >= len(score):
        return np.argsort(-score, kind="stable")
    # Partitioning keeps any of those that tie with the last one: take the first of them.
    smallest = np.partition(score, len(score) - count)[len(score) - count]
    better, ties = np.flatnonzero(score > smallest), np.flatnonzero(score == smallest)
    best = np.sort(np.concatenate([better, ties[: count - len(better)]]))
    return np.asarray(best[np.argsort(-score[best], kind="stable")])


def _ranked(entries: Entries, row: int, similarity: float) -> RankedReference:
    reference_id, key, world_from_camera = entries.reference(row)
    return RankedReference(reference_id, key, similarity, world_from_camera)
