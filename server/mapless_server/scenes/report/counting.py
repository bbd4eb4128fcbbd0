"""Counts answered photographs by the place where they were taken.

A place is what is nearer to one surveyed reference than to any other that looks within 60 degrees of the same
direction, or than to any other where none does, as adoption has it. A localized photograph is at its pose, and a
rejected one at a pose that was only too uncertain. Else it is where its prior and the reference that resembles it most
place it together, each by its covariance; without a prior at that reference, maybe far from where it was taken.
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

from ..adoption.viewpoints import surveyed_viewpoints

RESEMBLING_SPACINGS = 3.0
"""Standard deviation of where a photograph is taken, from the reference that resembles it most, in distances between
places. A convention."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """An answered photograph, as far as it is counted.

    Attributes:
        time_us: when it was answered, microseconds since 1970.
        outcome: LOCALIZED, or the value of a RejectionReason.
        position: where it was taken (3,), world; None if unknown.
        covariance: (3, 3) of a position that is only a prior, world, square metres; None of a pose.
        forward: its viewing direction (3,), world, unit length; None if unknown.
        reference_id: the reference that resembles it most; empty if none does.
        inlier_count: matches that agree with its pose.
        radius_m: its 68 % radius; None without.
        inliers_of: matches that agree with its pose, of each reference that has some, by id.
    """

    time_us: int
    outcome: str
    position: Array | None = None
    covariance: Array | None = None
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
        self._rows, self._viewpoints = surveyed_viewpoints(entries, lambda: [it.key for it in self._adopted.values()])

    def is_surveyed(self, reference_id: str) -> bool:
        """Whether a reference was not adopted."""
        return reference_id not in self._adopted

    def at(self, position: Array, forward: Array | None) -> tuple[str, Array]:
        """The key of the place at a position, and its offset (3,) from the place's reference; empty without places."""
        if not len(self._rows):
            return "", np.zeros(3)
        nearest = self._viewpoints.place(position, forward)
        return self._entries.reference(int(self._rows[nearest]))[1], position - self._viewpoints.centres[nearest]

    def position(self, it: Sighting) -> Array | None:
        """Where a photograph was taken (3,); None if it is not known.

        That by a prior lies between it and the reference that resembles the photograph most: where the prior is less
        certain than places are apart, as a height that no receiver gave, nearer to the reference. It is not known
        if it is further from all references than they are from each other: such a prior is wrong, and would move means.
        """
        if it.position is None or it.covariance is None:
            return it.position
        variance, like = (RESEMBLING_SPACINGS * self._viewpoints.spacing_m) ** 2, self._in_use(it.reference_id)
        position = it.position
        if not variance or (like is None and np.linalg.eigvalsh(it.covariance)[-1] > variance):
            return None
        if like is not None:
            centre = self._entries.centres(np.array([like]))[0]
            share = variance * np.linalg.inv(variance * np.eye(3) + it.covariance)
            position = centre + share @ (it.position - centre)
        is_near = np.linalg.norm(self.at(position, it.forward)[1]) <= self._viewpoints.extent_m
        return position if is_near else None

    def of(self, reference_id: str) -> str:
        """The key of a reference's place; empty if it is not in use."""
        if reference_id in self._adopted:
            return self._adopted[reference_id].place_key
        row = self._in_use(reference_id)
        return "" if row is None else self._entries.reference(row)[1]

    def _in_use(self, reference_id: str) -> int | None:
        """The row of a reference; None if it is not in use."""
        found = self._entries.rows([reference_id] if reference_id else [])
        return int(found[0]) if len(found) else None


def counted(sightings: Iterable[Sighting], places: Places) -> dict[CountKey, Sums]:
    """The counts of photographs of a scene."""
    found: dict[CountKey, Sums] = defaultdict(Sums)
    for it in sightings:
        position = places.position(it)
        if position is None:
            place_key, offset = places.of(it.reference_id), None
        else:
            place_key, offset = places.at(position, it.forward)
        sums = _of_localized(it, places) if it.outcome == LOCALIZED else _of_rejected(it, place_key, offset)
        key = CountKey(it.time_us // DAY_US, place_key, it.outcome)
        found[key] += sums
    return dict(found)


def _of_localized(it: Sighting, places: Places) -> Sums:
    all_inliers = sum(it.inliers_of.values())
    surveyed = sum(count for name, count in it.inliers_of.items() if places.is_surveyed(name))
    has_radius = it.radius_m is not None and 0 < it.radius_m < math.inf
    has_support = all_inliers > 0 and it.inlier_count > 0
    return Sums(
        photograph_count=1,
        support_count=int(has_support),
        surveyed_share=surveyed / all_inliers if has_support else 0.0,
        inlier_count=it.inlier_count if has_support else 0,
        radius_count=int(has_radius),
        log_radius=math.log(it.radius_m) if has_radius and it.radius_m else 0.0,
    )


def _of_rejected(it: Sighting, place_key: str, offset: Array | None) -> Sums:
    if offset is None or not place_key:
        return Sums(photograph_count=1)
    x, y, z = offset.tolist()
    forward_x, forward_y, forward_z = (0.0, 0.0, 0.0) if it.forward is None else it.forward.tolist()
    return Sums(
        photograph_count=1,
        position_count=1,
        offset_x=x,
        offset_y=y,
        offset_z=z,
        squared_offset=float(offset @ offset),
        forward_x=forward_x,
        forward_y=forward_y,
        forward_z=forward_z,
    )
