"""Reports of scenes: reads what the store has counted, and makes the message; loads what computes when it is called."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from datetime import date, datetime, timedelta, timezone
from typing import TYPE_CHECKING

from mapless import names
from mapless.geometry import Array
from mapless.rejections import WORDS
from mapless.v1 import geometry_pb2
from mapless.v1 import localization_service_pb2 as localization_pb
from mapless.v1 import reference_service_pb2 as pb
from mapless.wire import FieldError
from mapless_server.security import SceneKey, scene_id_of
from mapless_server.store import ReferenceRecord, Retirement, RetirementReason, Store

from .messages.enums import enum_to_message
from .messages.references import reference_to_message, retirement_of

if TYPE_CHECKING:  # services do not load what computes
    from mapless_server.scenes.report.summary import Period, Suggestion
    from mapless_server.store.counts import Sums
    from mapless_server.store.reporting import Days, Event

MOST_PLACES, MOST_EVENTS = 1000, 1000
DEFAULT_PERIOD_DAYS, DEFAULT_PERIODS = 7, 4
MOST_PERIOD_DAYS, MOST_DAYS = 366, 4000
EPOCH = date(1970, 1, 1)


def scene_report(store: Store, scene_key: SceneKey, request: pb.GetSceneReportRequest) -> pb.SceneReport:
    """The report that a request asks for; FieldError names a wrong day, NotFound if there is no such scene."""
    from mapless_server.scenes.report import summary
    from mapless_server.scenes.report.renewal import added_days, since_added
    from mapless_server.store.adoption import list_outdated
    from mapless_server.store.counts import DAY_US
    from mapless_server.store.reporting import find_references, read_report
    from mapless_server.store.surveys import list_surveyed

    days = days_from_message(request, datetime.now(timezone.utc).date())
    scene_id, of_scene = scene_id_of(scene_key), summary.PlaceCounts()
    message = pb.SceneReport(scene=names.scene_name(scene_id))
    with read_report(store.database, scene_key, days, summary.HALF_LIFE_DAYS) as stored:
        scene, outdated = stored.scene(), list_outdated(stored.connection, scene_key)
        added = added_days(list_surveyed(stored.connection, scene_key, days.first * DAY_US), days.first)
        (events, adopted), happened, counted = stored.events(MOST_EVENTS), stored.happened(), stored.places()
        keys = {*counted, *outdated, *(it.place_key for it in events)}
        records = find_references(stored.connection, scene_key, keys)
        outdated = {key: it for key, it in outdated.items() if key in records}  # others are damaged
        found = stored.rejected()
        recent, rejected = summary.recent_of(found), summary.rejected_of(found, records)
        places = list(dict.fromkeys([*outdated, *summary.in_order(counted, records, rejected)]))
        of_place = {key: message.places.add() for key in places[:MOST_PLACES]}
        for key, counts in summary.by_place(stored.periods(), records, of_scene):
            if key in recent:  # until here it had those that were rejected
                recent[key].photograph_count = counts.photograph_count
                recent[key].weighted_count = counts.weighted_count
            if key in of_place:
                of_place[key].periods.extend(map(period_to_message, counts.periods(days)))
        recent = since_added(recent, added, stored.since)
    for key, its in of_place.items():
        its.is_outdated = key in outdated
        if (record := records.get(key)) is not None:
            describe_place(its, record, rejected.get(key), adopted.get(key, (0, 0)))
    for age in reversed(range(days.period_count)):
        its_period = period_to_message(of_scene.period(age, days))
        message.periods.append(with_happened(its_period, happened.get(age, {})))
    message.first_day, message.last_day = message.periods[0].first_day, message.periods[-1].last_day
    message.omitted_place_count, message.arbitrary_unit = len(places) - len(of_place), scene.attributes.arbitrary_unit
    for it in summary.suggestions(recent, {key: record.world_from_camera for key, record in records.items()}):
        at, unit = records[it.place_key], scene.attributes.unit
        message.suggestions.append(suggestion_to_message(it, at, unit, it.place_key in outdated))
    ids = {key: record.reference_id for key, record in records.items()}
    message.events.extend(event_to_message(it, scene_id, ids) for it in reversed(events))
    return message


def days_from_message(request: pb.GetSceneReportRequest, today: date) -> Days:
    """The days of a report; FieldError names a wrong one."""
    from mapless_server.store.reporting import Days

    if not 0 <= request.days_per_period <= MOST_PERIOD_DAYS:
        raise FieldError("days_per_period", f"must be 0 to {MOST_PERIOD_DAYS}, is {request.days_per_period}")
    period = request.days_per_period or DEFAULT_PERIOD_DAYS
    last = _day(request.last_day, "last_day") if request.last_day else (today - EPOCH).days
    first = max(0, last - DEFAULT_PERIODS * period + 1)
    if request.first_day:
        first = _day(request.first_day, "first_day")
    if first > last:
        raise FieldError("first_day", f"must not be after last_day, {_text(last)}, is {_text(first)}")
    if last - first >= MOST_DAYS:
        raise FieldError(
            "first_day", f"must be less than {MOST_DAYS} days before last_day, is {last - first} days before"
        )
    return Days(first, last, period)


def _day(text: str, field: str) -> int:
    with suppress(ValueError):
        day = date.fromisoformat(text)
        if day >= EPOCH and day.isoformat() == text:  # Python reads other forms, too
            return (day - EPOCH).days
    raise FieldError(field, f"must be a day such as 2026-11-02, from 1970 to 9999, is {names.shown(text)}")


def _text(day: int) -> str:
    return (EPOCH + timedelta(days=day)).isoformat()


def period_to_message(period: Period) -> pb.PeriodCounts:
    """Message of the counts of some days."""
    surveyed_share, radius_m, inlier_count = period.means
    return pb.PeriodCounts(
        first_day=_text(period.first_day),
        last_day=_text(period.last_day),
        localized_count=period.localized.photograph_count,
        rejections=[
            pb.RejectionCount(reason=enum_to_message(reason, localization_pb.RejectionReason), count=count)
            for reason, count in period.rejections
        ],
        surveyed_share=surveyed_share,
        position_68_m=radius_m,
        inlier_count=inlier_count,
    )


def with_happened(message: pb.PeriodCounts, happened: Mapping[str, int]) -> pb.PeriodCounts:
    """The message of a scene's period with what became of photographs and references, by `counts.happening`."""
    fields = {"adoptions": message.adoptions, "retirements": message.retirements}
    for what, count in happened.items():
        name, _, result = what.partition(":")
        if name in fields:
            fields[name][result] += count
    return message


def describe_place(
    message: pb.PlaceReport, record: ReferenceRecord, rejected: Sums | None, adopted: tuple[int, int]
) -> None:
    """Sets what is known of a place in its message, which has its periods.

    Args:
        message: the message.
        record: the place's reference.
        rejected: sums over photographs that were rejected there; None without any.
        adopted: numbers of adopted references there: in use, and retired.
    """
    from mapless_server.scenes.report.summary import Cluster

    reference = reference_to_message(record)
    message.reference = reference.name
    message.world_from_camera.CopyFrom(reference.world_from_camera)
    message.adopted_count, message.retired_count = adopted
    if reference.HasField("place"):
        message.state.CopyFrom(reference.place)
    cluster = None if rejected is None else Cluster.of(rejected, record.world_from_camera)
    if cluster is not None:
        message.rejected_position.photograph_count = round(cluster.count)
        message.rejected_position.position.CopyFrom(_vector(cluster.position))
        message.rejected_position.spread_m = cluster.spread_m
        if cluster.forward is not None:
            message.rejected_position.forward.CopyFrom(_vector(cluster.forward))


def _vector(vector: Array) -> geometry_pb2.Vector3:
    x, y, z = vector.tolist()
    return geometry_pb2.Vector3(x=x, y=y, z=z)


def suggestion_to_message(
    it: Suggestion, record: ReferenceRecord, unit: str, is_outdated: bool
) -> pb.ReferenceSuggestion:
    """Message of a suggestion for the place of a reference, in a scene with this unit of length."""
    return pb.ReferenceSuggestion(
        place=names.reference_name(record.scene_id, record.reference_id),
        photograph_count=it.rescued_count,
        position=_vector(it.position),
        forward=_vector(it.forward),
        distance_m=it.distance_m,
        message=_sentence(it, record.reference_id, unit, is_outdated),
    )


def _sentence(it: Suggestion, reference_id: str, unit: str, is_outdated: bool) -> str:
    x, y, z = it.position.tolist()
    many = f"{it.rejected_count} of {it.photograph_count} photographs around {reference_id} were rejected"
    why = f"most often {it.reason.name} ({WORDS[it.reason.name]})"
    if is_outdated:
        return f"{many}, {why}; the place has changed: survey it again, around ({x:.2f}, {y:.2f}, {z:.2f})"
    if it.positioned_share < 0.5:
        few = "few priors say" if it.positioned_share else "no prior says"
        return f"{many}, {why}; {few} where they were taken: add references of what is seen from there"
    along = ", ".join(f"{each:.1f}" for each in it.forward.tolist())
    where = f"on average at ({x:.2f}, {y:.2f}, {z:.2f}), {it.distance_m:.2g} {unit} from {reference_id}"
    looking = f"looking along ({along})" + (
        "" if it.forward_is_known else f" as {reference_id}, since no prior says it"
    )
    return f"{many}, {why}, {where}, {looking}: add references there"


def event_to_message(event: Event, scene_id: str, places: Mapping[str, str]) -> pb.ReferenceEvent:
    """Message of a reference that was adopted or retired; places are ids by key."""
    time = datetime.fromtimestamp(event.time_us // 1_000_000, timezone.utc)
    place_id, retired = places.get(event.place_key, ""), event.retirement_reason
    message = pb.ReferenceEvent(
        reference=names.reference_name(scene_id, event.reference_id),
        kind=pb.REFERENCE_EVENT_KIND_RETIRED if retired else pb.REFERENCE_EVENT_KIND_ADOPTED,
        message=retirement_of(Retirement(time, RetirementReason(retired))) if retired else "",
        place=names.reference_name(scene_id, place_id) if place_id else "",
    )
    message.time.FromDatetime(time)
    return message
