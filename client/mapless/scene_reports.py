"""Reports of a scene: how its photographs were answered, day by day and place by place, and what would help."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import date, datetime, timezone
from typing import Any

from . import wire
from .geometry import RigidTransform
from .messages import read
from .names import parse_reference_name, parse_scene_name
from .results import PlaceState
from .scenes import Vector
from .v1 import reference_service_pb2 as pb


@dataclass(frozen=True)
class PeriodCounts:
    """Photographs of some days, counted by how they were answered; each one of a rig or a sequence counts.

    Attributes:
        first_day, last_day: UTC.
        localized_count: photographs that were localized.
        rejections: number of rejected photographs by the reason's name ("LOW_OVERLAP"), those with most first.
        surveyed_share: share of the matches of localized photographs that surveyed references have, 0 to 1, the mean
            over those that have a pose of their own, also without the rig or sequence; None without any.
        position_68_m: typical 68 % radius of localized photographs, the geometric mean, metres or the scene's unit;
            None if none has one.
        inlier_count: mean number of matches that agree with the pose of these photographs; None without any.
        adoptions: of a scene, photographs that were considered as references by what became of them: "adopted", or why
            they were not, as of the metric mapless_adoptions_total.
        retirements: of a scene, references that servers retired by themselves, by why, as of mapless_retirements_total.
    """

    first_day: date
    last_day: date
    localized_count: int
    rejections: Mapping[str, int]
    surveyed_share: float | None = None
    position_68_m: float | None = None
    inlier_count: float | None = None
    adoptions: Mapping[str, int] = field(default_factory=dict)
    retirements: Mapping[str, int] = field(default_factory=dict)

    @property
    def rejected_count(self) -> int:
        """Photographs that were rejected."""
        return sum(self.rejections.values())

    @property
    def photograph_count(self) -> int:
        """All photographs."""
        return self.localized_count + self.rejected_count

    @property
    def localized_share(self) -> float | None:
        """Share of the photographs that were localized; None without any."""
        return self.localized_count / self.photograph_count if self.photograph_count else None


@dataclass(frozen=True)
class RejectedPosition:
    """Where rejected photographs of a place were taken.

    Known of those with a prior on their position, or with a pose that was only too uncertain.

    Attributes:
        photograph_count: number of these photographs.
        position: their mean position, world, metres or the scene's unit.
        forward: their mean viewing direction, world, unit length; None if it is not known.
        spread_m: root mean square distance from the mean position.
    """

    photograph_count: int
    position: Vector
    forward: Vector | None
    spread_m: float


@dataclass(frozen=True, eq=False)
class PlaceReport:
    """How photographs of a place were answered.

    A place is what is nearer to one surveyed reference than to any other that looks within 60 degrees of the same
    direction, or to any other where none does. A photograph that was rejected is counted where its prior says that it
    was taken, without one at the reference that resembles it most.

    Attributes:
        reference_id: the surveyed reference; empty for photographs whose place is not known, or whose reference was
            deleted.
        world_from_camera: pose of that reference; None without one.
        periods: counts, without periods that have no photographs.
        state: what photographs that were considered for adoption showed; None where there were none.
        is_outdated: whether they show too little of what was surveyed, so that the place needs a new survey.
        adopted_count: adopted references at the place that are in use.
        retired_count: adopted references at the place that are retired, and the surveyed one if it is.
        rejected_position: where rejected photographs were taken by their priors; None where none had one.
    """

    reference_id: str
    world_from_camera: RigidTransform | None
    periods: tuple[PeriodCounts, ...]
    state: PlaceState | None = None
    is_outdated: bool = False
    adopted_count: int = 0
    retired_count: int = 0
    rejected_position: RejectedPosition | None = None


@dataclass(frozen=True)
class ReferenceSuggestion:
    """A viewpoint from which a further reference would help.

    Attributes:
        place_id: the place, by its surveyed reference.
        photograph_count: photographs that it would likely rescue: those rejected there for lack of evidence, times
            their share of all photographs of the place, each of these counted half after every two weeks.
        position: where to take it, world, metres or the scene's unit.
        forward: which way to look, world, unit length.
        distance_m: distance of the position from the place's reference; 0 where no prior says where the photographs
            were taken.
        message: one sentence for a person.
    """

    place_id: str
    photograph_count: float
    position: Vector
    forward: Vector
    distance_m: float
    message: str


@dataclass(frozen=True)
class ReferenceEvent:
    """A reference that was adopted or retired.

    Attributes:
        reference_id: the reference.
        time: when, UTC, by the server's clock.
        kind: "ADOPTED" or "RETIRED".
        message: why it was retired, one sentence for a person; empty if it was adopted.
        place_id: the place, by its surveyed reference; empty if that is not known.
    """

    reference_id: str
    time: datetime
    kind: str
    message: str = ""
    place_id: str = ""


@dataclass(frozen=True, eq=False)
class SceneReport:
    """How photographs of a scene were answered, and what would help.

    Attributes:
        scene_id: the scene.
        first_day, last_day: UTC.
        periods: all periods between, in order, also those without photographs.
        places: places that need a new survey, then others of which photographs were counted, those with most rejected
            ones first; at most 1000.
        omitted_place_count: further places, which are left out.
        suggestions: where further references would help, the one that would help most first, at most 10.
        events: references that were adopted or retired, in order of time, the last 1000. Adopted ones that have been
            deleted since are not among them.
        arbitrary_unit: whether lengths are in the scene's own, arbitrary unit instead of metres.
    """

    scene_id: str
    first_day: date
    last_day: date
    periods: tuple[PeriodCounts, ...]
    places: tuple[PlaceReport, ...] = ()
    omitted_place_count: int = 0
    suggestions: tuple[ReferenceSuggestion, ...] = ()
    events: tuple[ReferenceEvent, ...] = ()
    arbitrary_unit: bool = False


def report_from_message(message: pb.SceneReport) -> SceneReport:
    """The report of a message."""
    return SceneReport(
        parse_scene_name(message.scene),
        date.fromisoformat(message.first_day),
        date.fromisoformat(message.last_day),
        tuple(map(_period, message.periods)),
        tuple(map(_place, message.places)),
        message.omitted_place_count,
        tuple(map(_suggestion, message.suggestions)),
        tuple(map(_event, message.events)),
        message.arbitrary_unit,
    )


def _period(message: pb.PeriodCounts) -> PeriodCounts:
    return PeriodCounts(
        date.fromisoformat(message.first_day),
        date.fromisoformat(message.last_day),
        message.localized_count,
        {_name(it, "reason"): it.count for it in message.rejections},
        message.surveyed_share if message.inlier_count else None,
        message.position_68_m or None,
        message.inlier_count or None,
        dict(message.adoptions),
        dict(message.retirements),
    )


def _place(message: pb.PlaceReport) -> PlaceReport:
    has_pose, has_position = message.HasField("world_from_camera"), message.HasField("rejected_position")
    return PlaceReport(
        _reference_id(message.reference),
        wire.transform_from_message(message.world_from_camera, "world_from_camera") if has_pose else None,
        tuple(map(_period, message.periods)),
        read(PlaceState, message.state) if message.HasField("state") else None,
        message.is_outdated,
        message.adopted_count,
        message.retired_count,
        _rejected(message.rejected_position) if has_position else None,
    )


def _rejected(message: pb.RejectedPosition) -> RejectedPosition:
    forward = _vector(message.forward) if message.HasField("forward") else None
    return RejectedPosition(message.photograph_count, _vector(message.position), forward, message.spread_m)


def _suggestion(message: pb.ReferenceSuggestion) -> ReferenceSuggestion:
    return ReferenceSuggestion(
        _reference_id(message.place),
        message.photograph_count,
        _vector(message.position),
        _vector(message.forward),
        message.distance_m,
        message.message,
    )


def _event(message: pb.ReferenceEvent) -> ReferenceEvent:
    return ReferenceEvent(
        _reference_id(message.reference),
        message.time.ToDatetime(timezone.utc),
        _name(message, "kind"),
        message.message,
        _reference_id(message.place),
    )


def _name(message: Any, field: str) -> str:
    """The name of an enum's value, without its prefix."""
    return wire.value_name(message.DESCRIPTOR.fields_by_name[field].enum_type, getattr(message, field))


def _reference_id(name: str) -> str:
    return parse_reference_name(name)[1] if name else ""


def _vector(message: Any) -> Vector:
    return message.x, message.y, message.z
