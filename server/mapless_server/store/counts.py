"""Counts of answered photographs by scene, day, place and outcome, for reports of scenes; and the rows of a report.

Only sums are kept: no photographs, no callers. Servers that share a store add up. A row is deleted when its day is too
old, and with its scene; its place is the key of a surveyed reference, which may have been deleted since.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from sqlalchemy import Select, case, func, select, true

from mapless_server.errors import DataLoss
from mapless_server.security import SceneKey

from . import queries, rows
from .database import Database
from .deletion import delete_counts_where
from .records import ReferenceRecord
from .tables import adopted_reference, reference, reference_standing, scene, scene_count

DAY_US = 24 * 3600 * 1_000_000
LOCALIZED = "localized"
"""The outcome of a photograph that was localized; others are values of `RejectionReason`."""


def happening(name: str, result: str) -> str:
    """The outcome under which is counted what became of a photograph or a reference: no answer, and without a place."""
    return f"{name}:{result}"


_HAPPENED = ":"


class CountKey(NamedTuple):
    """Key of counts of a scene's photographs: day since 1970, UTC, place, empty if unknown, and outcome."""

    day: int
    place_key: str
    outcome: str


@dataclass(frozen=True)
class Sums:
    """Sums over photographs.

    Attributes:
        photograph_count: number of photographs.
        support_count: localized photographs whose matches agree with a pose of their own; of others, which only a rig
            or a sequence localizes, the next two are not known.
        surveyed_share: shares of these matches that surveyed references have.
        inlier_count: these matches.
        radius_count, log_radius: photographs with a 68 % radius, and its natural logarithms, metres.
        position_count: rejected photographs whose position is known.
        offset_x, offset_y, offset_z: their offsets from the place's reference, world axes, metres.
        squared_offset: squares of the lengths of these offsets.
        forward_x, forward_y, forward_z: viewing directions, world, of those of them whose direction is known.
    """

    photograph_count: int = 0
    support_count: int = 0
    surveyed_share: float = 0.0
    inlier_count: int = 0
    radius_count: int = 0
    log_radius: float = 0.0
    position_count: int = 0
    offset_x: float = 0.0
    offset_y: float = 0.0
    offset_z: float = 0.0
    squared_offset: float = 0.0
    forward_x: float = 0.0
    forward_y: float = 0.0
    forward_z: float = 0.0

    def __add__(self, other: Sums) -> Sums:
        return Sums(**{name: getattr(self, name) + getattr(other, name) for name in _NAMES})

    def times(self, weight: float) -> Sums:
        """The sums with each photograph counted as so many."""
        return Sums(**{name: weight * getattr(self, name) for name in _NAMES})


_NAMES = tuple(it.name for it in fields(Sums))


def scenes_created(database: Database, scene_keys: Collection[SceneKey]) -> dict[SceneKey, int]:
    """When scenes were created, microseconds since 1970, by key; those that do not exist are left out."""
    column, found = scene.c, dict[SceneKey, int]()
    with database.read() as connection:
        for some in queries.portions(sorted(scene_keys)):
            created: Select[Any] = select(column.scene_id, column.create_time_us).where(column.scene_id.in_(some))
            found |= {SceneKey(it.scene_id): it.create_time_us for it in connection.execute(created)}
    return found


def add_counts(database: Database, counted: Mapping[SceneKey, Mapping[CountKey, Sums]]) -> None:
    """Adds to the counts of scenes, in one transaction; those that do not exist any more are passed over."""
    with database.write() as connection:
        for scene_key, counts in sorted(counted.items()):
            # Its deletion waits for the end of the transaction.
            there = select(scene.c.scene_id).where(scene.c.scene_id == scene_key)
            if connection.scalar(there.with_for_update(read=True, key_share=True)) is None:
                continue
            for key, sums in sorted(counts.items()):
                row = {"scene_id": scene_key, **key._asdict(), **vars(sums)}
                queries.add_to(connection, scene_count, row, _NAMES)


def delete_counts(database: Database, before_day: int) -> int:
    """Deletes the counts of days before one, in portions; returns the number of rows."""
    return delete_counts_where(database, scene_count.c.day < before_day)


class Event(NamedTuple):
    """A reference that was adopted or, with a reason, retired."""

    reference_id: str
    time_us: int
    retirement_reason: str | None
    place_key: str


@dataclass(frozen=True, eq=False)
class StoredReport:
    """The counts that are stored of a scene's answers, read at one moment.

    Attributes:
        counts: answered photographs by what they are counted by, in no order.
        happened: what else happened, by day and `happening`.
        events: references that were adopted or retired, the last ones first.
        adopted: for each place with adopted references, by key, how many are in use and how many are retired.
    """

    counts: Mapping[CountKey, Sums]
    happened: Mapping[tuple[int, str], int]
    events: Sequence[Event]
    adopted: Mapping[str, tuple[int, int]]


def read_report(
    database: Database, scene_key: SceneKey, first_day: int, last_day: int, most_events: int
) -> StoredReport:
    """Reads what is stored of a scene's answers; of one that does not exist nothing.

    Args:
        database: the database.
        scene_key: the scene.
        first_day: since 1970, UTC.
        last_day: likewise.
        most_events: the last so many events are read.
    """
    column, adopted, standing = scene_count.c, adopted_reference.c, reference_standing.c
    counted = select(scene_count).where(column.scene_id == scene_key, column.day.between(first_day, last_day))
    of_scene: Select[Any] = (
        select(
            reference.c.reference_id,
            reference.c.key,
            adopted.adopt_time_us,
            adopted.place_key,
            standing.retire_time_us,
            standing.retire_reason,
        )
        .outerjoin(adopted_reference, adopted.reference_key == reference.c.key)
        .outerjoin(reference_standing, standing.reference_key == reference.c.key)
        .where(reference.c.scene_id == scene_key)
        .where(adopted.adopt_time_us.is_not(None) | standing.retire_time_us.is_not(None))
    )
    with database.read() as connection:
        counts = {
            CountKey(it.day, it.place_key, it.outcome): Sums(**{name: getattr(it, name) for name in _NAMES})
            for it in connection.execute(counted)
        }
        found = connection.execute(of_scene).all()
    events, places = list[Event](), dict[str, tuple[int, int]]()
    for it in found:
        place_key = it.key if it.place_key is None else it.place_key
        if it.adopt_time_us is not None:
            events.append(Event(it.reference_id, it.adopt_time_us, None, place_key))
        if it.retire_time_us is not None:
            events.append(Event(it.reference_id, it.retire_time_us, it.retire_reason, place_key))
        used, retired = places.get(place_key, (0, 0))
        is_retired = it.retire_time_us is not None
        places[place_key] = (used + (not is_retired), retired + is_retired)
    events = [it for it in events if first_day <= it.time_us // DAY_US <= last_day]
    events.sort(key=lambda it: (-it.time_us, it.reference_id))
    happened = {(it.day, it.outcome): sums.photograph_count for it, sums in counts.items() if _HAPPENED in it.outcome}
    counts = {it: sums for it, sums in counts.items() if _HAPPENED not in it.outcome}
    return StoredReport(counts, happened, events[:most_events], places)


def find_references(database: Database, scene_key: SceneKey, keys: Collection[str]) -> dict[str, ReferenceRecord]:
    """References of a scene by key, with what photographs said of them; those that are gone or damaged are left out."""
    of_scene, found = queries.select_references().where(reference.c.scene_id == scene_key), dict[str, ReferenceRecord]()
    with database.read() as connection:
        for some in queries.portions(sorted(keys)):
            for row in connection.execute(of_scene.where(reference.c.key.in_(some))):
                with suppress(DataLoss):
                    found[row.key] = rows.reference_record(row)
    return found


class BusyScene(NamedTuple):
    """A scene with numbers of its photographs of some last days, and of as many days before these."""

    scene_key: SceneKey
    photograph_count: int
    localized_count: int
    photographs_before: int
    localized_before: int


def busiest_scenes(database: Database, since_day: int, days: int, most: int) -> list[BusyScene]:
    """The scenes with most photographs since a day, at most so many; and numbers of so many days before it."""
    column = scene_count.c
    is_now, is_localized = column.day >= since_day, column.outcome == LOCALIZED
    conditions = true(), is_localized
    numbers = [
        func.sum(case((it & each, column.photograph_count), else_=0)) for it in (is_now, ~is_now) for each in conditions
    ]
    found: Select[Any] = (
        select(column.scene_id, *numbers)
        .where(column.day >= since_day - days, ~column.outcome.contains(_HAPPENED))
        .group_by(column.scene_id)
        .having(numbers[0] > 0)
        .order_by(numbers[0].desc(), column.scene_id)
        .limit(most)
    )
    with database.read() as connection:
        return [BusyScene(SceneKey(key), *map(int, counted)) for key, *counted in connection.execute(found)]


class ReferenceNumbers(NamedTuple):
    """Numbers of references of a scene: adopted ones in use, and retired ones."""

    adopted_count: int
    retired_count: int


def count_references(database: Database, scene_key: SceneKey) -> ReferenceNumbers:
    """Counts the adopted and the retired references of a scene."""
    key, number = reference.c.key, select(func.count()).select_from(reference).where(reference.c.scene_id == scene_key)
    adopted = number.join(adopted_reference, adopted_reference.c.reference_key == key).where(~queries.is_retired(key))
    standing = reference_standing.c
    retired = number.join(reference_standing, standing.reference_key == key).where(standing.retire_time_us.is_not(None))
    with database.read() as connection:
        return ReferenceNumbers(connection.scalar(adopted) or 0, connection.scalar(retired) or 0)


def least_surveyed_share(database: Database, scene_key: SceneKey, least_photographs: int) -> float | None:
    """Least share of the survey that is left at a place of a scene with so many photographs; None without any."""
    standing = reference_standing.c
    least: Select[Any] = (
        select(func.min(standing.surveyed_share))
        .join(reference, reference.c.key == standing.reference_key)
        .where(reference.c.scene_id == scene_key, standing.photograph_count >= least_photographs)
    )
    with database.read() as connection:
        share: float | None = connection.scalar(least)
        return share
