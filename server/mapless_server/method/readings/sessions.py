"""Photographs of several sessions in one scene, each in a world of its own.

Photographs of one session agree with one another. So they are grouped: two groups are joined if more pairs between them
agree than contradict. Two large groups that remain, most pairs between which are bad, are sessions.
"""

from collections import Counter
from collections.abc import Sequence

from .errors import Pair, PairError

LEAST_PHOTOGRAPHS = 3
LEAST_PAIRS = 3
"""Of a session, and of pairs between two."""
COVERED_SHARE = 0.8
"""Of the photographs, in the two largest sessions."""
BAD_SHARE = 0.8
"""Of the pairs between two sessions; and least share of good ones inside."""


def sessions_of(errors: Sequence[PairError]) -> tuple[tuple[int, ...], tuple[int, ...]] | None:
    """The photographs of two sessions, the larger first; None if there are not two."""
    photographs = sorted({i for error in errors for i in error.pair})
    groups = sorted(_grouped(photographs, errors), key=len, reverse=True)[:2]
    if len(groups) < 2 or len(groups[1]) < LEAST_PHOTOGRAPHS:
        return None
    if sum(map(len, groups)) < COVERED_SHARE * len(photographs):
        return None
    group_of = {i: number for number, group in enumerate(groups) for i in group}
    inside = [e.is_bad for e in errors if _groups(e.pair, group_of) in ((0, 0), (1, 1))]
    between = [e.is_bad for e in errors if set(_groups(e.pair, group_of)) == {0, 1}]
    if len(between) < LEAST_PAIRS or sum(between) < BAD_SHARE * len(between):
        return None
    if not inside or sum(inside) > (1 - BAD_SHARE) * len(inside):
        return None
    return tuple(groups[0]), tuple(groups[1])


def _groups(pair: Pair, group_of: dict[int, int]) -> tuple[int, int]:
    return group_of.get(pair[0], -1), group_of.get(pair[1], -1)


def _grouped(photographs: Sequence[int], errors: Sequence[PairError]) -> list[list[int]]:
    group_of = {i: i for i in photographs}
    while True:
        balance: Counter[tuple[int, int]] = Counter()
        for error in errors:
            first, second = sorted(group_of[i] for i in error.pair)
            if first != second:
                balance[first, second] += -1 if error.is_bad else 1
        best, surplus = max(balance.items(), key=lambda it: (it[1], it[0]), default=((0, 0), 0))
        if surplus <= 0:
            break
        group_of = {i: best[0] if group == best[1] else group for i, group in group_of.items()}
    groups: dict[int, list[int]] = {}
    for i, group in group_of.items():
        groups.setdefault(group, []).append(i)
    return list(groups.values())
