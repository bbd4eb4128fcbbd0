"""Summarizes sums of a scene's counts by period and place, and suggests where further references would help.

A reference rescues a photograph that was rejected for lack of evidence, unless the photograph itself is to blame: the
larger the share of a place's photographs that are localized, the likelier that is. So at a place with R such rejections
among N photographs, each photograph counted as 2^(-age / 14 days), R * R / N are likely rescued.
"""

import math
from collections import defaultdict
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from itertools import groupby

import numpy as np

from mapless.geometry import Array, RigidTransform
from mapless_server.method.rejection import RejectionReason
from mapless_server.store.counts import LOCALIZED, Sums
from mapless_server.store.reporting import Answered, Days, OutcomeSums, PeriodSums

HALF_LIFE_DAYS = 14
"""Age after which a photograph counts half for suggestions: two weekly reports. Evidence: suggestion-half-life."""
MOST_SUGGESTIONS = 10
LEAST_RESCUED = 2.0
"""Places where fewer photographs would be rescued are not suggested: one photograph says little. Evidence:
suggestion-least."""

LACKING_EVIDENCE = frozenset(
    {
        RejectionReason.NO_USABLE_REFERENCES,
        RejectionReason.DEGENERATE_REFERENCES,
        RejectionReason.LOW_OVERLAP,
        RejectionReason.SCALE_UNRELIABLE,
        RejectionReason.TOO_FEW_MATCHES,
        RejectionReason.PNP_FAILED,
        RejectionReason.GATE,
    }
)
"""Reasons that further references remedy; the others are of the photograph, its prior, or of places that look alike."""


@dataclass(frozen=True)
class Period:
    """Counts of some days.

    Attributes:
        first_day, last_day: since 1970, UTC.
        of_outcome: sums by outcome.
    """

    first_day: int
    last_day: int
    of_outcome: Mapping[str, Answered]

    @property
    def localized(self) -> Answered:
        """Sums of the photographs that were localized."""
        return self.of_outcome.get(LOCALIZED, Answered())

    @property
    def means(self) -> tuple[float, float, float]:
        """Means over localized photographs: share of surveyed support, radius (geometric), metres, and inliers.

        The first and the last are means over those with matches of their own; 0 where unknown.
        """
        its = self.localized
        radius_m = math.exp(its.log_radius / its.radius_count) if its.radius_count else 0.0
        count = max(its.support_count, 1)
        return its.surveyed_share / count, radius_m, its.inlier_count / count

    @property
    def rejections(self) -> list[tuple[RejectionReason, int]]:
        """Number of rejected photographs by reason, the reason of most first."""
        found = [(RejectionReason(it), sums.photograph_count) for it, sums in self.of_outcome.items() if it in _REASONS]
        return sorted(found, key=lambda both: (-both[1], both[0].value))


_REASONS = frozenset(it.value for it in RejectionReason)
_LACKING = frozenset(it.value for it in LACKING_EVIDENCE)


class PlaceCounts:
    """Sums over photographs by period and outcome, of a place or of all of a scene.

    Attributes:
        photograph_count: all of them.
        weighted_count: all of them, each counted by its age.
    """

    def __init__(self) -> None:
        """Makes the object without photographs."""
        self.photograph_count = 0
        self.weighted_count = 0.0
        self._of_age: dict[int, dict[str, Answered]] = {}

    def add(self, it: PeriodSums) -> None:
        """Adds sums."""
        self.photograph_count += it.answered.photograph_count
        self.weighted_count += it.weighted_count
        of_outcome = self._of_age.setdefault(it.age, {})
        before = of_outcome.get(it.outcome)
        of_outcome[it.outcome] = it.answered if before is None else before.plus(it.answered)

    def period(self, age: int, days: Days) -> Period:
        """The period of an age, 0 the last one; the first one may be shorter than the others."""
        last_day = days.last - age * days.per_period
        return Period(max(days.first, last_day - days.per_period + 1), last_day, self._of_age.get(age, {}))

    def periods(self, days: Days) -> list[Period]:
        """The periods with photographs, in order."""
        return [self.period(age, days) for age in sorted(self._of_age, reverse=True)]


def by_place(
    found: Iterable[PeriodSums], known: Container[str], of_scene: PlaceCounts
) -> Iterator[tuple[str, PlaceCounts]]:
    """Photographs by the key of their place, one after another; empty, and the last, where it is not a known one.

    `found` is ordered by place; `of_scene` gets the photographs of all.
    """
    unknown = PlaceCounts()
    for place_key, its in groupby(found, key=lambda it: it.place_key):
        counts = PlaceCounts() if place_key in known else unknown
        for it in its:
            counts.add(it)
            of_scene.add(it)
        if counts is not unknown:
            yield place_key, counts
    yield "", unknown


def rejected_of(found: Iterable[OutcomeSums], known: Container[str]) -> dict[str, Sums]:
    """Sums over rejected photographs by the key of their place; empty where it is not among the known ones."""
    places = defaultdict[str, Sums](Sums)
    for it in found:
        places[it.place_key if it.place_key in known else ""] += it.sums
    return dict(places)


def in_order(place_keys: Iterable[str], known: Container[str], rejected: Mapping[str, Sums]) -> list[str]:
    """Places, that with most rejected photographs first; empty for those that are not known."""
    places = {it if it in known else "" for it in place_keys}
    count = {it: rejected[it].photograph_count if it in rejected else 0 for it in places}
    return sorted(places, key=lambda it: (-count[it], it))


@dataclass(frozen=True, eq=False)
class Cluster:
    """Where rejected photographs of a place were taken.

    Attributes:
        count: photographs whose position is known.
        position: mean (3,), world.
        forward: mean viewing direction (3,), world, unit length; None if it is not known.
        spread_m: root mean square distance from the mean position.
    """

    count: float
    position: Array
    forward: Array | None
    spread_m: float

    @staticmethod
    def of(sums: Sums, reference: RigidTransform) -> "Cluster | None":
        """The cluster of sums at the place of a reference with this pose; None where no position is known."""
        if not sums.position_count:
            return None
        mean = np.array([sums.offset_x, sums.offset_y, sums.offset_z]) / sums.position_count
        spread = math.sqrt(max(0.0, sums.squared_offset / sums.position_count - float(mean @ mean)))
        forward = np.array([sums.forward_x, sums.forward_y, sums.forward_z])
        length = float(np.linalg.norm(forward))
        known = forward / length if length > 1e-3 * sums.position_count else None
        return Cluster(sums.position_count, reference.translation + mean, known, spread)


@dataclass(frozen=True, eq=False)
class Suggestion:
    """A viewpoint from which a further reference would help.

    Attributes:
        place_key: the place.
        rescued_count: photographs that it would likely rescue.
        rejected_count: photographs that were rejected there for lack of evidence.
        photograph_count: all photographs of the place.
        reason: the most frequent of these rejections.
        position, forward: (3,) each, world; forward of unit length.
        distance_m: distance of the position from the place's reference; 0 if no position is known.
        positioned_share: share of the rejected photographs whose position is known.
        forward_is_known: whether priors say forward; else it is that of the place's reference.
    """

    place_key: str
    rescued_count: float
    rejected_count: int
    photograph_count: int
    reason: RejectionReason
    position: Array
    forward: Array
    distance_m: float
    positioned_share: float
    forward_is_known: bool


@dataclass(eq=False)
class Recent:
    """Photographs of a place since a reference was added there.

    Attributes:
        photograph_count: all of them.
        weighted_count: all of them, each counted by its age.
        lacking: number of those that were rejected for lack of evidence, by reason.
        weighted: sums over these, each counted by its age.
    """

    photograph_count: int = 0
    weighted_count: float = 0.0
    lacking: dict[RejectionReason, int] = field(default_factory=dict)
    weighted: Sums = field(default_factory=Sums)

    def add(self, it: OutcomeSums) -> None:
        """Adds photographs."""
        self.photograph_count += it.sums.photograph_count
        self.weighted_count += it.weighted.photograph_count
        if it.outcome in _LACKING:
            self.lacking[RejectionReason(it.outcome)] = it.sums.photograph_count
            self.weighted += it.weighted


def recent_of(found: Iterable[OutcomeSums]) -> dict[str, Recent]:
    """Photographs by the key of their place."""
    places = defaultdict[str, Recent](Recent)
    for it in found:
        places[it.place_key].add(it)
    return dict(places)


def suggestions(places: Mapping[str, Recent], poses: Mapping[str, RigidTransform]) -> list[Suggestion]:
    """Places in the order of how many photographs a reference there would likely rescue, at most `MOST_SUGGESTIONS`.

    Args:
        places: photographs by the key of their place.
        poses: pose of each place's reference; other places are left out.
    """
    made = [_suggestion(key, its, poses[key]) for key, its in places.items() if its.lacking and key in poses]
    likely = [it for it in made if it.rescued_count >= LEAST_RESCUED]
    return sorted(likely, key=lambda it: (-it.rescued_count, it.place_key))[:MOST_SUGGESTIONS]


def _suggestion(place_key: str, recent: Recent, pose: RigidTransform) -> Suggestion:
    rejected, lacking = recent.weighted, recent.lacking
    cluster = Cluster.of(rejected, pose)
    known = None if cluster is None else cluster.forward
    forward = pose.rotation[:, 2] if known is None else known
    position = pose.translation if cluster is None else cluster.position
    return Suggestion(
        place_key,
        rejected.photograph_count**2 / recent.weighted_count,
        sum(lacking.values()),
        recent.photograph_count,
        max(lacking, key=lambda it: (lacking[it], it.value)),
        position,
        forward,
        float(np.linalg.norm(position - pose.translation)),
        rejected.position_count / rejected.photograph_count,
        known is not None,
    )
