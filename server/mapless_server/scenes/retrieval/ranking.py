"""Selection of references for a photograph: by similarity, spread in space, within what is known of its pose.

Two references at one place that look the same way see the same and triangulate nothing, so after the first of them is
chosen the second counts for less. It is not excluded: in a dense sequence, strictly spread references see so little of
the query that this costs a third of the accuracy. But where a camera stood still, on a tripod or at a robot's dock,
hundreds of references are more similar than any other: of those a few are chosen, and then others before the rest.

Of few candidates whose features are loaded, those with the most matches are chosen (`spread_choice`). Both choices use
the photographs and the references' poses only, never the query's pose.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapless.geometry import Array, RigidTransform
from mapless_server.bounds import check_bounds
from mapless_server.method.bundle.priors import PosePrior

from .narrowing import Narrowing

if TYPE_CHECKING:  # services that exchange choices need not load the index
    from .index import Entries, Rows, Vector


@dataclass(frozen=True)
class RankOptions:
    """Options of the ranking.

    Attributes:
        apart_m: references closer together than this triangulate nothing (the paper's baseline),
        apart_deg: if their optical axes are closer than this, too: otherwise they see different things.
        nearby_weight: share that remains of a reference's lead over the scene's typical similarity if one nearby is
            chosen already. 1 does not thin, 0 spreads at any price. In the kitchen of 7-Scenes (100 references, 60
            queries) the median errors with 1, 0.75 and 0.5 are 0.13, 0.15 and 0.15 cm, and 90 % lie below 0.27, 0.29
            and 0.32; with 0 the chosen share half as many matches with the query.
        same_place_m: references closer together than this, looking the same way, are about equally similar to any
            photograph, and ten of them determine no depth. A video at walking speed has two or three.
        per_place: number of them that are chosen before all others, but at most half of the wanted references.
        pool: number of most similar references that are considered, as a multiple of the wanted ones. Less similar ones
            are never chosen instead of a nearby one, unless too few of the pool stand at different places.
        smallest_pool: least number of references that are considered.
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


THINNED_LATER = RankOptions(nearby_weight=1.0)
"""References near one another are thinned out by their matches, which show better what each is worth."""


@dataclass(frozen=True, eq=False)
class Selection:
    """A choice of references: how many, and within which limits.

    Attributes:
        count: largest number of references.
        narrowing: limits of the camera's pose.
        among: ids of the candidates, unknown ones ignored; empty for the whole scene.
        options: options of the ranking.
        near: prior near which references are chosen, in place of similar ones; see `nearest_references`.
    """

    count: int
    narrowing: Narrowing = field(default_factory=Narrowing)
    among: Collection[str] = ()
    options: RankOptions = field(default_factory=RankOptions)
    near: PosePrior | None = None


@dataclass(frozen=True, eq=False)
class RankedReference:
    """A selected reference.

    Attributes:
        reference_id: its id, unique in its scene.
        key: its key, never used again.
        similarity: cosine of the descriptors, -1 to 1, to four decimals; NaN if the reference or the photograph has
            none.
        world_from_camera: its pose, metric.
    """

    reference_id: str
    key: str
    similarity: float
    world_from_camera: RigidTransform


@dataclass(frozen=True, eq=False)
class Choice:
    """The references that were selected for a photograph of a scene's generation, in order.

    The most similar are first, except for those that see the same as an earlier one. `descriptor` is the name of the
    global descriptor that was compared; empty if the scene has no references.
    """

    references: tuple[RankedReference, ...]
    descriptor: str
    generation: int


def rank_references(entries: Entries, vector: Vector | None, selection: Selection) -> list[RankedReference]:
    """Selects references by the photograph's descriptor (D,), None if it has none, in the order of choice.

    References without a descriptor come last. These, or all references if the photograph has no descriptor, are ordered
    by their distance from the likely position of the camera, or as they were stored.
    """
    options, narrowing, count = selection.options, selection.narrowing, selection.count
    rows = entries.rows(selection.among or None)
    if not narrowing.is_empty:
        rows = rows[narrowing.keeps(entries.centres(rows), entries.axes(rows))]
    if not len(rows) or count < 1:
        return []
    wanted, size = min(count, len(rows)), max(options.pool * count, options.smallest_pool)
    similar = entries.similar(vector, rows, size)
    while True:
        score = _scores(similar.similarity, entries, similar.rows, narrowing)
        pool = _best(score, size)
        at = similar.rows[pool]
        order = spread(score[pool], entries.centres(at), entries.axes(at), wanted, similar.typical, options)
        if len(order) == wanted or len(pool) == len(rows):
            break
        size *= 10
        if len(similar.rows) < len(rows):
            similar = entries.similar(vector, rows, size)
    rest = np.setdiff1d(np.arange(len(pool)), order)  # in the order of their scores
    chosen = pool[[*order, *rest[: wanted - len(order)]]]
    return [_ranked(entries, int(similar.rows[i]), float(similar.similarity[i])) for i in chosen]


def rank_among(
    scenes: Sequence[tuple[Entries, Narrowing]], vector: Vector, count: int
) -> list[Sequence[RankedReference]]:
    """Selects so many references of all of several scenes by the photograph's descriptor (D,).

    In each scene they are spread as in `rank_references`, and thinned later. References without a descriptor are not
    selected.

    Returns:
        For each scene, its references, the most similar first.
    """
    found = [_similar(entries, narrowing, vector, count) for entries, narrowing in scenes]
    everything = np.concatenate([np.empty(0, np.float32), *found])
    scene = np.repeat(np.arange(len(scenes)), [len(it) for it in found])
    best = _best(np.where(np.isnan(everything), -np.inf, everything), count)
    ranked = [
        (i, it)
        for i in np.unique(scene[best]).tolist()
        for it in rank_references(scenes[i][0], vector, Selection(count, scenes[i][1], options=THINNED_LATER))
        if not math.isnan(it.similarity)
    ]
    selected: list[list[RankedReference]] = [[] for _ in scenes]
    for i, it in sorted(ranked, key=lambda it: -it[1].similarity)[:count]:
        selected[i].append(it)
    return [*selected]


def _similar(entries: Entries, narrowing: Narrowing, vector: Vector, count: int) -> NDArray[np.float32]:
    """Similarities (N,) of the references within limits and likely values that may be the `count` most similar."""
    rows = entries.rows()
    if not narrowing.is_empty:
        rows = rows[narrowing.keeps(entries.centres(rows), entries.axes(rows))]
    # Without what else `similar` finds, which takes most of the time that a small scene of many does.
    return entries.similarities(vector, rows) if entries.is_exact else entries.similar(vector, rows, count).similarity


def rank_beside(
    entries: Entries, reference_id: str, count: int, among: Collection[str] | None = None
) -> list[RankedReference]:
    """The other references that a query from the place of one of the entries would choose, in the order of choice.

    `among` are ids of the candidates; None for the whole scene.
    """
    if among is None:
        among = ()
    elif not among:
        return []
    (row,) = entries.rows([reference_id])
    selection = Selection(count + 1, among=among, options=THINNED_LATER)
    ranked = rank_references(entries, entries.vector(row), selection)
    return [it for it in ranked if it.reference_id != reference_id]


TURN_DEG = 15.0
"""A reference that looks so far elsewhere counts as twice as far away."""

MAX_TURN_DEG = 60.0
"""References that look further elsewhere show other things."""


def nearest_references(entries: Entries, prior: PosePrior, count: int) -> list[RankedReference]:
    """The reference with the viewpoint most like a pose prior, and those with viewpoints most like its own.

    So they are the same for all priors around the first, and what depends on them alone is computed once. They are not
    thinned, except where many stand at one place. Their similarities are 0.

    Returns:
        At most `count`; none if no reference looks where the prior does, or the prior leaves open which references are
        near: its standard deviation is larger than the distance of the furthest of them from the first, or the camera
        is further from the first than that.
    """
    rows = entries.rows()
    pose, sigma_m = prior.world_from_camera, math.sqrt(float(np.linalg.eigvalsh(prior.covariance[:3, :3])[-1]))
    unlikeness = _unlikeness(entries, rows, pose, sigma_m)
    if not np.isfinite(unlikeness).any():
        return []
    _, _, at = entries.reference(int(rows[unlikeness.argmin()]))
    unlikeness = _unlikeness(entries, rows, at, 0.0)
    pool = _best(-unlikeness, max(RankOptions().pool * count, RankOptions().smallest_pool))
    pool = pool[np.isfinite(unlikeness[pool])]
    near = rows[pool]
    order = spread(-unlikeness[pool], entries.centres(near), entries.axes(near), count, math.inf, THINNED_LATER)
    chosen = near[order]
    extent_m = float(np.linalg.norm(entries.centres(chosen) - at.translation, axis=1).max(initial=0.0))
    if max(sigma_m, float(np.linalg.norm(at.translation - pose.translation))) > extent_m:
        return []
    return [_ranked(entries, int(row), 0.0) for row in chosen]


def _unlikeness(entries: Entries, rows: Rows, pose: RigidTransform, sigma_m: float) -> Array:
    """How unlike the viewpoints (N,) of references are to a pose, whose position is uncertain by `sigma_m`."""
    away_m = np.hypot(np.linalg.norm(entries.centres(rows) - pose.translation, axis=1), sigma_m)
    turn_deg = np.degrees(np.arccos(np.clip(entries.axes(rows) @ pose.rotation[:, 2], -1.0, 1.0)))
    return np.where(turn_deg <= MAX_TURN_DEG, away_m * (1 + turn_deg / TURN_DEG), np.inf)


def spread(
    scores: ArrayLike, centres: ArrayLike, axes: ArrayLike, count: int, typical: float, options: RankOptions
) -> list[int]:
    """Chooses the best score repeatedly; a reference near a chosen one loses a part of its lead. Ties go to the first.

    Once enough are chosen at one place, the others there are skipped.

    Args:
        scores: (N,) scores, finite or -inf.
        centres: (N, 3) camera centres, metres.
        axes: (N, 3) optical axes, unit length.
        count: how many to choose.
        typical: score without a lead; lower scores lose nothing.
        options: options of the ranking.

    Returns:
        Indices in the order of choice; fewer than `count` if the others are skipped.
    """
    score, centre, axis = np.asarray(scores, float), np.asarray(centres, float), np.asarray(axes, float)
    lead = np.maximum(score - typical, 0.0)
    lowered = score - (1 - options.nearby_weight) * lead
    same_way = math.cos(math.radians(options.apart_deg))
    left = np.ones(len(score), bool)
    current = score.copy()
    chosen: list[int] = []
    chosen_there = np.zeros(len(score), int)
    most_there = max(1, min(options.per_place, count // 2))
    while len(chosen) < count and left.any():
        candidates = np.flatnonzero(left)
        best = int(candidates[np.argmax(current[candidates])])
        chosen.append(best)
        away_m = np.linalg.norm(centre - centre[best], axis=1)
        is_parallel = axis @ axis[best] >= same_way
        current = np.where((away_m < options.apart_m) & is_parallel, lowered, current)
        chosen_there += (away_m < options.same_place_m) & is_parallel
        left &= chosen_there < most_there
        left[best] = False
    return chosen


def _scores(similarity: NDArray[np.float32], entries: Entries, rows: Rows, narrowing: Narrowing) -> Array:
    """Similarities (N,); unknown ones get lower scores, the lower, the further from the prior."""
    scores = similarity.astype(np.float64)
    unknown = np.flatnonzero(np.isnan(similarity))
    scores[unknown] = -2.0
    if narrowing.centre is not None and len(unknown):
        centres = entries.centres(rows[unknown])
        scores[unknown] -= np.linalg.norm(centres - narrowing.centre, axis=1)
    return scores


def _best(score: Array, count: int) -> Rows:
    """Indices of the `count` best scores, the best first; ties keep their order."""
    if count >= len(score):
        return np.argsort(-score, kind="stable")
    # Partitioning keeps any of those that tie with the last one, so the first of them are taken.
    smallest = np.partition(score, len(score) - count)[len(score) - count]
    better, ties = np.flatnonzero(score > smallest), np.flatnonzero(score == smallest)
    best = np.sort(np.concatenate([better, ties[: count - len(better)]]))
    return np.asarray(best[np.argsort(-score[best], kind="stable")])


def _ranked(entries: Entries, row: int, similarity: float) -> RankedReference:
    reference_id, key, world_from_camera = entries.reference(row)
    # Sums of float32 differ by the row at which a reference stands; quantized rows know no more than four decimals.
    return RankedReference(reference_id, key, round(similarity, 4), world_from_camera)


APART_M = 0.3
"""References closer together than this triangulate nothing (the paper's least baseline)."""
NEARBY_WEIGHT = 0.5
"""Factor on the match count of a reference within `APART_M` of a chosen one. 0 would spread the references at any cost:
in a dense sequence such references show so little of the query that a third of the accuracy is lost."""


def spread_choice(
    match_counts: ArrayLike,
    centres: ArrayLike,
    count: int,
    apart_m: float = APART_M,
    nearby_weight: float = NEARBY_WEIGHT,
) -> list[int]:
    """Greedy choice by match count, reduced for candidates near a chosen one; the first of equals.

    `match_counts` (N,) are those with the query, `centres` (N, 3) the cameras' in metres; see `APART_M` and
    `NEARBY_WEIGHT`.
    """
    score: NDArray[np.float64] = np.asarray(match_counts, float)
    centre = np.asarray(centres, float).reshape(-1, 3)
    nearby = np.zeros(len(score), bool)
    chosen: list[int] = []
    for _ in range(min(count, len(score))):
        weighted = np.where(nearby, nearby_weight, 1.0) * score
        weighted[chosen] = -1.0
        best = int(np.argmax(weighted))
        chosen.append(best)
        nearby |= np.linalg.norm(centre - centre[best], axis=1) < apart_m
    return chosen
