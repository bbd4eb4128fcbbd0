"""Leaves out of the counts of places what was counted before a reference was added there."""

from collections.abc import Mapping, Sequence

import numpy as np

from mapless_server.store.counts import DAY_US, CountKey, Sums
from mapless_server.store.surveys import Surveyed

from ..adoption.viewpoints import Viewpoints

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
    places: Mapping[str, Mapping[CountKey, Sums]], added: Mapping[str, int]
) -> dict[str, dict[CountKey, Sums]]:
    """The counts of places of the days after the last one on which a reference was added there."""
    return {
        place: {key: sums for key, sums in counts.items() if key.day > added.get(place, -1)}
        for place, counts in places.items()
    }
