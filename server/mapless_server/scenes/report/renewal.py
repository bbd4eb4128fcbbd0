"""Leaves out of the counts of places what was counted before a reference was added there."""

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import pairwise

import numpy as np

from mapless_server.store.counts import DAY_US
from mapless_server.store.reporting import OutcomeSums
from mapless_server.store.surveys import Surveyed

from ..adoption.viewpoints import Viewpoints
from .summary import Recent, recent_of

MOST_ADDED = 1000
"""References that are looked at, the last ones that were added."""


def added_days(surveyed: Sequence[Surveyed], first_day: int) -> dict[str, int]:
    """The last day, since 1970, on which a reference was added at each place, by the key of the place's reference.

    One that is added belongs to the place where it stands by the references of days before: so references that are
    stored on one day, as of a first survey, renew none of each other. Days before the first one are left out.
    """
    its = sorted(surveyed, key=lambda it: it.create_time_us // DAY_US)
    days = np.array([it.create_time_us // DAY_US for it in its])
    start = max(len(its) - MOST_ADDED, int(np.searchsorted(days, first_day)))
    if start == len(its):
        return {}
    centres = np.stack([it.world_from_camera.translation for it in its])
    axes = np.stack([it.world_from_camera.rotation[:, 2] for it in its])

    def viewpoints(first: int, end: int) -> Viewpoints:
        return Viewpoints(centres[first:end], axes[first:end])

    found, trees, split = dict[str, int](), dict[int, Viewpoints](), 0
    firsts = np.searchsorted(days, np.unique(days[start:])).tolist()
    for i, (first, end) in enumerate(pairwise([*firsts, len(its)])):
        if not first:
            continue
        # Two trees, by the index of their first reference: one of all for each of 365 days takes 15 s at 100,000.
        # The first of these days is with the older ones as soon as it is past: it may be that of the first survey.
        split = first if i < 2 else split
        trees = {0: viewpoints(0, first)} if i < 2 else {0: trees[0], split: viewpoints(split, first)}
        for row in range(max(start, first), end):
            near = [at + tree.place(centres[row], axes[row]) for at, tree in trees.items()]
            nearest = Viewpoints(centres[near], axes[near]).place(centres[row], axes[row])
            found[its[near[nearest]].key] = int(days[row])
    return found


def since_added(
    recent: Mapping[str, Recent],
    added: Mapping[str, int],
    since: Callable[[Mapping[str, int]], Iterable[OutcomeSums]],
) -> dict[str, Recent]:
    """Photographs of places after the last day on which a reference was added there, if one was.

    Args:
        recent: all photographs, by the key of their place.
        added: that day, by the key of the place.
        since: reads the photographs of some places, each of the days after its own, by the key of the place.
    """
    kept = {key: its for key, its in recent.items() if key not in added}
    return kept | recent_of(since({key: added[key] for key in recent if key in added}))
