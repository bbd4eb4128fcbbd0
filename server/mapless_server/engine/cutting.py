"""Where the ladder is cut for another reason than what the photograph shows: failures of the caller, time, evidence."""

from collections.abc import Callable, Iterable
from dataclasses import replace

from mapless_server.method.judge.hypothesis import Attempt
from mapless_server.method.ladder import Rung

from .query import CutReason
from .search import Search


def offered(
    search: Search, following: Iterable[tuple[Rung, Attempt]], features_of: Callable[[Attempt], str]
) -> tuple[Search, list[tuple[Search, Rung, Attempt]]]:
    """The rungs that a photograph gets of those that follow, in order.

    Args:
        search: the search.
        following: the rungs that can remove a doubt, and their attempts.
        features_of: the name of an attempt's features.

    Returns:
        The search if no rung is left, and each rung with the search that it is made in. Both list the cuts: rungs that
        are not cheap where the caller gets only those that are; and the first rung where the queue, which has no time
        for it, takes a later one.
    """
    taken = list[tuple[Search, Rung, Attempt]]()
    for rung, attempt in following:
        features = features_of(attempt)
        if not rung.is_cheap and (search.gets_cheap_rungs or search.is_cut_at(rung.name, features)):
            if not taken and not search.gets_cheap_rungs:
                search = search.cut(rung.name, features, CutReason.CALLER_FAILS)
            continue
        chosen = search
        if taken:
            _, first, its_attempt = taken[0]
            chosen = search.cut(first.name, features_of(its_attempt), search.reason_at(search.ends_s))
        taken.append((chosen, rung, attempt))
    return search, taken


def without_unmatched(search: Search, features: str) -> Search:
    """The search with the matches there are, and the cut if a network would have matched further references."""
    material = search.material
    assert material is not None
    if not material.unmatched:
        return search
    reason = search.reason_at(search.lacking_until_s)
    search = search.cut(search.rung, features, reason, len(material.unmatched))
    return search.but(material=replace(material, unmatched=()))
