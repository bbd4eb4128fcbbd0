"""Counts answered photographs by the place where they were taken.

A place is what is nearer to one surveyed reference than to any other, as adoption has it. A localized photograph is at
its pose, a rejected one where its prior says, or a pose that was only too uncertain; without these it is at the
reference that resembles it most, which may be far from where it was taken.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np

from mapless.geometry import Array
from mapless_server.scenes.retrieval.index import Entries
from mapless_server.store.counts import DAY_US, LOCALIZED, CountKey, Sums
from mapless_server.store.records import Adopted

from ..adoption.policy import nearest_place


@dataclass(frozen=True, eq=False)
class Sighting:
    """An answered photograph, as far as it is counted.

    Attributes:
        time_us: when it was answered, microseconds since 1970.
        outcome: LOCALIZED, or the value of a RejectionReason.
        position: where it was taken (3,), world; None if unknown.
        forward: its viewing direction (3,), world, unit length; None if unknown.
        reference_id: the reference that resembles it most; empty if none does.
        inlier_count: matches that agree with its pose.
        radius_m: its 68 % radius; None without.
        inliers_of: matches that agree with its pose, of each reference that has some, by id.
    """

    time_us: int
    outcome: str
    position: Array | None = None
    forward: Array | None = None
    reference_id: str = ""
    inlier_count: int = 0
    radius_m: float | None = None
    inliers_of: Mapping[str, int] = field(default_factory=dict)


class Places:
    """The places of a scene: its surveyed references, and those that were adopted there."""

    def __init__(self, entries: Entries, adopted: Iterable[Adopted]) -> None:
        """Makes the object of a scene's references in use, and all of its adopted ones."""
        self._entries = entries
        self._adopted = {it.reference_id: it for it in adopted}
        its = list(entries.rows_of_keys([it.key for it in self._adopted.values()]).values())
        self._rows = np.setdiff1d(entries.rows(), its, assume_unique=True)
        self._centres, self._axes = entries.centres(self._rows), entries.axes(self._rows)

    def is_surveyed(self, reference_id: str) -> bool:
        """Whether a reference was not adopted."""
        return reference_id not in self._adopted

    def at(self, position: Array, forward: Array | None) -> tuple[str, Array]:
        """The key of the place at a position, and its offset (3,) from the place's reference; empty without places."""
        if not len(self._rows):
            return "", np.zeros(3)
        nearest = nearest_place(self._centres, self._axes, position, forward)
        return self._entries.reference(int(self._rows[nearest]))[1], position - self._centres[nearest]

    def of(self, reference_id: str) -> str:
        """The key of a reference's place; empty if it is not in use."""
        if reference_id in self._adopted:
            return self._adopted[reference_id].place_key
        found = self._entries.rows([reference_id] if reference_id else [])
        return self._entries.reference(int(found[0]))[1] if len(found) else ""


def counted(sightings: Iterable[Sighting], places: Places) -> dict[CountKey, Sums]:
    """The counts of photographs of a scene."""
    found: dict[CountKey, Sums] = defaultdict(Sums)
    for it in sightings:
        if it.position is None:
            place_key, offset = places.of(it.reference_id), np.zeros(3)
        else:
            place_key, offset = places.at(it.position, it.forward)
        sums = _of_localized(it, places) if it.outcome == LOCALIZED else _of_rejected(it, place_key, offset)
        key = CountKey(it.time_us // DAY_US, place_key, it.outcome)
        found[key] += sums
    return dict(found)


def _of_localized(it: Sighting, places: Places) -> Sums:
    all_inliers = sum(it.inliers_of.values())
    surveyed = sum(count for name, count in it.inliers_of.items() if places.is_surveyed(name))
    has_radius = it.radius_m is not None and 0 < it.radius_m < math.inf
    return Sums(
        photograph_count=1,
        surveyed_share=surveyed / all_inliers if all_inliers else 1.0,
        inlier_count=it.inlier_count,
        radius_count=int(has_radius),
        log_radius=math.log(it.radius_m) if has_radius and it.radius_m else 0.0,
    )


def _of_rejected(it: Sighting, place_key: str, offset: Array) -> Sums:
    if it.position is None or not place_key:
        return Sums(photograph_count=1)
    x, y, z = offset.tolist()
    forward_x, forward_y, forward_z = (0.0, 0.0, 0.0) if it.forward is None else it.forward.tolist()
    squared = float(offset @ offset)
    return Sums(1, 0.0, 0, 0, 0.0, 1, x, y, z, squared, forward_x, forward_y, forward_z)
