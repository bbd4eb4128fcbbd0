"""Places of a scene as a report shows them: the colour of what became of their photographs, and the floor of each."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapless import Reference, RigidTransform
from mapless.geometry import Array
from mapless.provenance import ADOPTED
from mapless.scene_reports import PlaceReport, SceneReport

FLOOR_GAP_M = 1.5
"""Cameras of two floors have a gap of at least this height between them: what people hold differs by less on one
floor, and floors are 2.5 m apart or more. A convention."""
LEAST_OF_FLOOR, MOST_FLOORS = 3, 6
"""Fewer references belong to the next floor; more floors are none, but flights."""

GOOD, FAIR, BAD, NONE = "#2f7bd0", "#c9930a", "#d02f2f", "#97999c"
SHARES = (
    (0.9, GOOD, "90 % or more of the photographs were localized"),
    (0.5, FAIR, "50 to 90 %"),
    (0.0, BAD, "less than 50 %"),
)
"""Least share of localized photographs, its colour, and words for it."""
SUGGESTED, ADOPTED_COLOUR, OUTDATED = "#222222", "#1f9a55", "#e0561f"

REASONS = {
    "LOW_OVERLAP": "#8467d8",
    "GATE": "#d667b4",
    "TOO_FEW_MATCHES": "#18a0a0",
    "PNP_FAILED": "#6f9a1f",
    "AMBIGUOUS": "#a8713f",
    "PRIOR_CONFLICT": "#5f7f95",
    "LOW_TEXTURE": "#f08a6c",
    "NO_USABLE_REFERENCES": "#b03ad1",
    "DEGENERATE_REFERENCES": "#4cae8f",
    "SCALE_UNRELIABLE": "#b5b021",
}
"""Colour of each reason of rejections; readable on white and on black."""
_UNKNOWN_COLOUR = "#777777"


def reason_colour(reason: str) -> str:
    """The colour of a reason; grey for one of a newer server."""
    return REASONS.get(reason, _UNKNOWN_COLOUR)


@dataclass(frozen=True, eq=False)
class Place:
    """A place with a known reference.

    Attributes:
        reference_id: its surveyed reference.
        world_from_camera: pose of that reference.
        localized_count: photographs of the period that were localized.
        rejections: number of rejected ones by reason, those with most first.
        rejected_at: (3,) where these are drawn, world: their mean position by priors, where at least half of them had
            one, else the reference's.
        has_priors: whether it is by priors.
        surveyed_left: share of its matches that the survey supports; None where no photograph was considered.
        is_outdated, adopted_count, retired_count: as reported.
    """

    reference_id: str
    world_from_camera: RigidTransform
    rejected_at: Array
    localized_count: int = 0
    rejections: Mapping[str, int] = field(default_factory=dict)
    has_priors: bool = False
    surveyed_left: float | None = None
    is_outdated: bool = False
    adopted_count: int = 0
    retired_count: int = 0

    @property
    def rejected_count(self) -> int:
        """Photographs that were rejected."""
        return sum(self.rejections.values())

    @property
    def photograph_count(self) -> int:
        """All photographs."""
        return self.localized_count + self.rejected_count

    @property
    def colour(self) -> str:
        """By the share of photographs that were localized; grey where none came."""
        if not self.photograph_count:
            return NONE
        share = self.localized_count / self.photograph_count
        return next(colour for least, colour, _ in SHARES if share >= least)


def places_of(report: SceneReport, references: Iterable[Reference]) -> list[Place]:
    """The places of a report, in its order, then the surveyed references of which no photograph was counted."""
    found = [_reported(it) for it in report.places if it.world_from_camera is not None]
    counted = {it.reference_id for it in found}
    for it in references:
        if it.provenance.source != ADOPTED and it.reference_id not in counted:
            pose, retired = it.world_from_camera, int(it.retire_time is not None)
            left = None if it.place is None else it.place.surveyed_share
            found.append(Place(it.reference_id, pose, pose.translation, surveyed_left=left, retired_count=retired))
    return found


def _reported(place: PlaceReport) -> Place:
    assert place.world_from_camera is not None
    rejections: dict[str, int] = {}
    for period in place.periods:
        for reason, count in period.rejections.items():
            rejections[reason] = rejections.get(reason, 0) + count
    cluster = place.rejected_position
    has_priors = cluster is not None and 2 * cluster.photograph_count >= sum(rejections.values())
    at = np.asarray(cluster.position, float) if cluster is not None and has_priors else None
    return Place(
        place.reference_id,
        place.world_from_camera,
        place.world_from_camera.translation if at is None else at,
        sum(it.localized_count for it in place.periods),
        dict(sorted(rejections.items(), key=lambda it: (-it[1], it[0]))),
        has_priors,
        None if place.state is None else place.state.surveyed_share,
        place.is_outdated,
        place.adopted_count,
        place.retired_count,
    )


def floors_of(heights: NDArray[np.float64], is_metric: bool = True) -> list[tuple[float, float]]:
    """The lowest and highest height of each floor's references, the lowest floor first.

    A floor is what has no gap of `FLOOR_GAP_M` in its heights (N,), at least one; all is one in scenes
    without metres, and where there would be too many.
    """
    ordered = np.sort(heights)
    whole = (float(ordered[0]), float(ordered[-1]))
    if not is_metric:
        return [whole]
    parts = np.split(ordered, np.flatnonzero(np.diff(ordered) >= FLOOR_GAP_M) + 1)
    large = [it for it in parts if len(it) >= LEAST_OF_FLOOR]
    if not 1 < len(large) <= MOST_FLOORS:
        return [whole]
    return [(float(it[0]), float(it[-1])) for it in large]


def floor_of(height: float, floors: Sequence[tuple[float, float]]) -> int:
    """Index of the floor that is nearest to a height."""
    return min(range(len(floors)), key=lambda i: max(floors[i][0] - height, height - floors[i][1], 0.0))
