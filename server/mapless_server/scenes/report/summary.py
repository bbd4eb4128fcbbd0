"""Summarizes the counts of a scene by period and place, and suggests where further references would help.

A reference rescues a photograph that was rejected for lack of evidence, unless the photograph itself is to blame: the
larger the share of a place's photographs that are localized, the likelier that is. So at a place with R such rejections
among N photographs, each photograph counted as 2^(-age / 14 days), R * R / N are likely rescued.
"""

import math
from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array, RigidTransform
from mapless_server.method.rejection import RejectionReason
from mapless_server.store.counts import LOCALIZED, CountKey, Sums

HALF_LIFE_DAYS = 14
"""Age after which a photograph counts half for suggestions: two weekly reports. A convention."""
MOST_SUGGESTIONS = 10
LEAST_RESCUED = 2.0
"""Places where fewer photographs would be rescued are not suggested: one photograph says little."""

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
    of_outcome: Mapping[str, Sums]

    @property
    def localized(self) -> Sums:
        """Sums of the photographs that were localized."""
        return self.of_outcome.get(LOCALIZED, Sums())

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


def periods_of(counts: Mapping[CountKey, Sums], first_day: int, last_day: int, days: int) -> list[Period]:
    """Counts by periods of so many days, the last of which ends with the last day; the first may be shorter."""
    found: dict[int, dict[str, Sums]] = defaultdict(lambda: defaultdict(Sums))
    for key, sums in counts.items():
        found[(last_day - key.day) // days][key.outcome] += sums
    count = (last_day - first_day) // days + 1
    ends = [(i, last_day - i * days) for i in reversed(range(count))]
    return [Period(max(first_day, end - days + 1), end, found.get(i, {})) for i, end in ends]


def by_place(counts: Mapping[CountKey, Sums], known: Iterable[str]) -> dict[str, dict[CountKey, Sums]]:
    """Counts by the key of their place, that with most rejected photographs first; empty where it is not known."""
    places, known = defaultdict[str, dict[CountKey, Sums]](dict), frozenset(known)
    for key, sums in counts.items():
        at = key if key.place_key in known else key._replace(place_key="")
        its = places[at.place_key]
        its[at] = its.get(at, Sums()) + sums
    return dict(sorted(places.items(), key=lambda it: (-rejected_count(it[1]), it[0])))


def rejected_count(counts: Mapping[CountKey, Sums]) -> int:
    """Number of photographs that were rejected."""
    return sum(sums.photograph_count for key, sums in counts.items() if key.outcome != LOCALIZED)


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

    @staticmethod
    def of_rejected(counts: Mapping[CountKey, Sums], reference: RigidTransform) -> "Cluster | None":
        """The cluster of all rejected photographs at the place of a reference."""
        return Cluster.of(total(it for key, it in counts.items() if key.outcome != LOCALIZED), reference)


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


def suggestions(
    places: Mapping[str, Mapping[CountKey, Sums]], poses: Mapping[str, RigidTransform], last_day: int
) -> list[Suggestion]:
    """Places in the order of how many photographs a reference there would likely rescue, at most `MOST_SUGGESTIONS`.

    Args:
        places: counts by the key of their place.
        poses: pose of each place's reference; other places are left out.
        last_day: the day at which a photograph counts as one.
    """
    made = [_suggestion(key, its, poses[key], last_day) for key, its in places.items() if key in poses]
    likely = [it for it in made if it is not None and it.rescued_count >= LEAST_RESCUED]
    return sorted(likely, key=lambda it: (-it.rescued_count, it.place_key))[:MOST_SUGGESTIONS]


def _suggestion(
    place_key: str, counts: Mapping[CountKey, Sums], pose: RigidTransform, last_day: int
) -> Suggestion | None:
    lacking = {key: sums for key, sums in counts.items() if key.outcome in _LACKING}
    if not lacking:
        return None
    weighted, rejected = _weighted(counts, last_day), _weighted(lacking, last_day)
    of_reason: dict[str, int] = defaultdict(int)
    for key, sums in lacking.items():
        of_reason[key.outcome] += sums.photograph_count
    cluster = Cluster.of(rejected, pose)
    known = None if cluster is None else cluster.forward
    forward = pose.rotation[:, 2] if known is None else known
    position = pose.translation if cluster is None else cluster.position
    return Suggestion(
        place_key,
        rejected.photograph_count**2 / weighted.photograph_count,
        rejected_count(lacking),
        sum(it.photograph_count for it in counts.values()),
        RejectionReason(max(of_reason, key=lambda it: (of_reason[it], it))),
        position,
        forward,
        float(np.linalg.norm(position - pose.translation)),
        rejected.position_count / rejected.photograph_count,
        known is not None,
    )


_LACKING = frozenset(it.value for it in LACKING_EVIDENCE)


def _weighted(counts: Mapping[CountKey, Sums], last_day: int) -> Sums:
    """The sums of counts, each photograph counted by its age."""
    found = Sums()
    for key, sums in counts.items():
        found += sums.times(2.0 ** (-max(0, last_day - key.day) / HALF_LIFE_DAYS))
    return found


def total(counts: Iterable[Sums]) -> Sums:
    """The sum of all."""
    found = Sums()
    for it in counts:
        found += it
    return found
