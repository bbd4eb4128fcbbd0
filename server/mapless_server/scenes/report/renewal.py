"""Leaves out of the counts of places what was counted before a reference was added there."""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence

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
    if not surveyed:
        return {}
    days = np.array([it.create_time_us // DAY_US for it in surveyed])
    centres = np.stack([it.world_from_camera.translation for it in surveyed])
    axes = np.stack([it.world_from_camera.rotation[:, 2] for it in surveyed])
    found = dict[str, int]()
    last = np.argsort(-days, kind="stable")[:MOST_ADDED]
    for day in sorted({*days[last].tolist()}, reverse=True):
        before = np.flatnonzero(days < day)
        if day < first_day or not len(before):
            break
        viewpoints = Viewpoints(centres[before], axes[before])
        for i in last[days[last] == day].tolist():
            found.setdefault(surveyed[before[viewpoints.place(centres[i], axes[i])]].key, day)
    return found


def since_added(
    recent: Mapping[str, Recent],
    added: Mapping[str, int],
    since: Callable[[int, Collection[str]], Iterable[OutcomeSums]],
) -> dict[str, Recent]:
    """Photographs of places after the last day on which a reference was added there, if one was.

    Args:
        recent: all photographs, by the key of their place.
        added: that day, by the key of the place.
        since: reads the photographs of some places of the days after one.
    """
    found, places = {key: its for key, its in recent.items() if key not in added}, defaultdict[int, list[str]](list)
    for key, day in added.items():
        places[day].append(key)
    for day, keys in places.items():
        found |= recent_of(since(day, keys))
    return found
