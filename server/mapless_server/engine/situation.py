"""Properties of a photograph after an attempt, on which the rungs of the ladder depend."""

from collections.abc import Collection, Sequence

from mapless_server.method.judge.hypothesis import Attempt, Doubt
from mapless_server.method.ladder import Situation
from mapless_server.method.options import Variant
from mapless_server.method.promise import UNKNOWN, Known, PromiseOptions
from mapless_server.method.rejection import Rejection

from .query import Tier
from .scene_group import SceneGroup
from .search import Search

CHEAPEST = "wide"
"""The rung that is worth its time where matches agree least."""


def any_roll_of(tiers: Sequence[Tier]) -> int | None:
    """Index of the tier whose features match at any roll; None if there is none."""
    return next((i for i, it in enumerate(tiers) if it.any_roll), None)


def situation_of(search: Search, tiers: Sequence[Tier], promise: PromiseOptions) -> Situation:
    """On which the rungs after the present attempt depend."""
    query, material, verdict = search.query, search.material, search.own
    place = None if verdict is None else verdict.place
    return Situation(
        is_best=query.options.variant is Variant.BEST,
        reference_count=0 if material is None or search.coarse is None else len(material.references),
        may_be_elsewhere=search.may_be_elsewhere,
        has_place=place is not None and material is not None and len(place.references) < len(material.references),
        can_match_strongly=tuple(it.pipeline.matcher.pair_matching is not None for it in tiers),
        any_roll=any_roll_of(tiers),
        angles_deg=search.angles_deg,
        has_depth=search.coarse is not None and search.coarse.prepared.has_depth,
        other_scene=None if search.group is None else _other_scene(search.group, search.tried, promise),
        known=_known(search),
        promise=promise,
    )


def _other_scene(group: SceneGroup, tried: Collection[Attempt], promise: PromiseOptions) -> int | None:
    """The next scene, if its matches show so much that at least the cheapest rung would be worth its time in it."""
    rank = group.next_scene(tried)
    return rank if rank is not None and Known(group.ranking[rank].agreement).is_worth(CHEAPEST, promise) else None


def _known(search: Search) -> Known:
    verdict = search.own
    if verdict is None:
        return UNKNOWN
    is_accepted = not isinstance(verdict.outcome, Rejection)
    return Known(search.agreement, is_accepted, Doubt.LOW_TRUST in verdict.doubts, verdict.kinds)
