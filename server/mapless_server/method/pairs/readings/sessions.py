"""Photographs of two sessions in one scene, each in a world of its own.

Photographs of one session agree with one another, and not with those of another world. So they are grouped by the votes
of their pairs: two large groups that remain, most pairs between which do not agree, are sessions.
"""

from collections import Counter, deque
from collections.abc import Mapping
from typing import TypeVar

from .errors import FEW_SHARE

K = TypeVar("K", int, str)
"""A photograph: its index, or the key of its reference."""

MIN_GROUP, MIN_BETWEEN = 3, 6
"""Least number of photographs of a session, and of pairs between two sessions. Evidence: scene-agreement."""

MIN_INSIDE_SHARE = 0.8
"""Least share of the pairs inside a session that agree. Evidence: scene-agreement."""

ROUNDS = 3
"""Most rounds in which photographs change their group; they may alternate between two that agree as much."""


def sessions_of(agrees: Mapping[tuple[K, K], bool]) -> tuple[tuple[K, ...], tuple[K, ...]] | None:
    """The photographs of the two largest sessions, the larger first; None if there are not two.

    `agrees` is whether each pair of photographs that can be compared agrees with their poses.
    """
    links: dict[K, dict[K, int]] = {}
    for (first, second), is_good in agrees.items():
        links.setdefault(first, {})[second] = links.setdefault(second, {})[first] = 1 if is_good else -1
    group = _grouped(links)
    members: dict[int, list[K]] = {}
    for key in sorted(group):
        members.setdefault(group[key], []).append(key)
    large = sorted((it for it in members if len(members[it]) >= MIN_GROUP), key=lambda it: (-len(members[it]), it))
    if len(large) < 2:
        return None
    first_group, second_group = large[:2]

    def votes(of: int, with_group: int) -> list[int]:
        return [vote for key in members[of] for other, vote in links[key].items() if group[other] == with_group]

    between = votes(first_group, second_group)
    if len(between) < MIN_BETWEEN or between.count(1) > FEW_SHARE * len(between):
        return None
    if any(inside.count(1) < MIN_INSIDE_SHARE * len(inside) for inside in (votes(it, it) for it in large[:2])):
        return None
    return tuple(members[first_group]), tuple(members[second_group])


def _grouped(links: Mapping[K, Mapping[K, int]]) -> dict[K, int]:
    """Groups of photographs: each is in the group with which most of its pairs agree, by the number of votes."""
    group: dict[K, int] = {}
    order = _along_agreeing(links)
    for _ in range(ROUNDS):
        before = dict(group)
        for number, key in enumerate(order):
            votes: Counter[int] = Counter()
            for other, vote in links[key].items():
                if other in group and other != key:
                    votes[group[other]] += vote
            best = max(votes, key=lambda it: (votes[it], -it), default=-1)
            if best >= 0 and votes[best] > 0:
                group[key] = best
            elif key not in group:
                group[key] = len(order) + number
        if group == before:
            break
    return group


def _along_agreeing(links: Mapping[K, Mapping[K, int]]) -> list[K]:
    """All photographs, along pairs that agree as far as these lead, from the one with the most of them on."""
    if not links:
        return []
    begin = max(links, key=lambda key: (sum(links[key].values()), key))
    waiting, order, seen = deque([begin]), [begin], {begin}
    left = iter(sorted(links))
    while len(order) < len(links):
        if waiting:
            key = waiting.popleft()
            found = [other for other in sorted(links[key]) if links[key][other] > 0 and other not in seen]
        else:
            found = [next(key for key in left if key not in seen)]
        seen.update(found)
        order += found
        waiting += found
    return order
