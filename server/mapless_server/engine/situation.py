"""Properties of a photograph after an attempt, on which the rungs of the ladder depend."""

from collections.abc import Sequence

from mapless_server.method.judge.hypothesis import Doubt
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
        other_scene=None if search.group is None else _other_scene(search, search.group, promise),
        known=_known(search),
        promise=promise,
    )


def _other_scene(search: Search, group: SceneGroup, promise: PromiseOptions) -> int | None:
    """The next scene, if its matches show so much that at least the cheapest rung would be worth its time in it.

    Where two places of the present scene explain the photograph, that one must be a rival of these.
    """
    rank, own = group.next_scene(search.tried), search.own
    if rank is None or not Known(group.ranking[rank].agreement).is_worth(CHEAPEST, promise):
        return None
    has_poses = own is not None and bool(own.doubts & Doubt.TWO_PLACES)
    return rank if not has_poses or group.ranking[rank].may_rival(group.ranking[search.attempt.scene]) else None


def _known(search: Search) -> Known:
    verdict = search.own
    if verdict is None:
        return UNKNOWN
    is_accepted = not isinstance(verdict.outcome, Rejection)
    return Known(search.agreement, is_accepted, Doubt.LOW_TRUST in verdict.doubts, verdict.kinds)
