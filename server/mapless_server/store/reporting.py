"""Reads a report of a scene at one moment: its counts, which the database adds up, and what happened to its references.

A year of a scene with a thousand places has a million counts, so rows are read one after another, and none are kept.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from typing import Any, NamedTuple

from sqlalchemy import ColumnElement, Connection, Double, FromClause, Select, cast, column, func, select, values

from mapless_server.errors import DataLoss
from mapless_server.security import SceneKey

from . import queries, rows
from .counts import DAY_US, HAPPENED, LOCALIZED, Sums
from .database import Database
from .records import ReferenceRecord, SceneRecord
from .tables import adopted_reference, reference, reference_standing, scene_count

_ROWS_AT_A_TIME = 2000


class Event(NamedTuple):
    """A reference that was adopted or, with a reason, retired."""

    reference_id: str
    time_us: int
    retirement_reason: str | None
    place_key: str


class Answered(NamedTuple):
    """Sums over photographs with one outcome; see `counts.Sums`."""

    photograph_count: int = 0
    support_count: int = 0
    surveyed_share: float = 0.0
    inlier_count: int = 0
    radius_count: int = 0
    log_radius: float = 0.0

    def plus(self, other: Answered) -> Answered:
        """The sums over the photographs of both."""
        return Answered(
            self.photograph_count + other.photograph_count,
            self.support_count + other.support_count,
            self.surveyed_share + other.surveyed_share,
            self.inlier_count + other.inlier_count,
            self.radius_count + other.radius_count,
            self.log_radius + other.log_radius,
        )


class PeriodSums(NamedTuple):
    """Sums over the photographs of a place, a period and an outcome.

    Attributes:
        place_key: the place.
        age: of the period: 0 of the last one, 1 of that before.
        outcome: how they were answered.
        answered: sums over them.
        weighted_count: number of them, each counted by its weight.
    """

    place_key: str
    age: int
    outcome: str
    answered: Answered
    weighted_count: float


class OutcomeSums(NamedTuple):
    """Sums over the photographs of a place and an outcome.

    Attributes:
        place_key: the place.
        outcome: how they were answered.
        sums: over them, without what is of localized ones alone.
        weighted: the same, each photograph counted by its weight; without `squared_offset`.
    """

    place_key: str
    outcome: str
    sums: Sums
    weighted: Sums


@dataclass(frozen=True)
class Days:
    """First and last day of a report, since 1970, UTC, and days of a period; the last period ends with the last day."""

    first: int
    last: int
    per_period: int

    @property
    def period_count(self) -> int:
        """Number of periods; the first may be shorter."""
        return (self.last - self.first) // self.per_period + 1


_POSITIONED = (
    "photograph_count",
    "position_count",
    "offset_x",
    "offset_y",
    "offset_z",
    "forward_x",
    "forward_y",
    "forward_z",
)


@contextmanager
def read_report(database: Database, scene_key: SceneKey, days: Days, half_life_days: float) -> Iterator[ReportReader]:
    """Reads what is counted of a scene in some days; of one that does not exist nothing.

    A photograph weighs 1 on the last day, and half as much after each half-life before.
    """
    with database.read() as connection:
        yield ReportReader(connection, scene_key, days, half_life_days)


class ReportReader:
    """Reads counts of a scene's answers, all as of one moment: that of the connection's transaction."""

    def __init__(self, connection: Connection, scene_key: SceneKey, days: Days, half_life_days: float) -> None:
        """Makes the object; arguments as those of `read_report`."""
        self.connection = connection
        self._scene_key = scene_key
        self._days = days
        counted = scene_count.c
        self._age = ((days.last - counted.day) // days.per_period).label("age")
        self._weight: ColumnElement[float] = func.power(2.0, (counted.day - days.last) / half_life_days, type_=Double())
        self._is_counted = (counted.scene_id == scene_key) & counted.day.between(days.first, days.last)
        self._is_answer = ~counted.outcome.contains(HAPPENED)

    def scene(self) -> SceneRecord:
        """The scene; NotFound if there is no such scene; DataLoss if its attributes are damaged."""
        return queries.read_scenes(self.connection, [queries.find_scene(self.connection, self._scene_key)])[0]

    def places(self) -> list[str]:
        """Keys of all places of which photographs were counted, in no order; empty for those whose is not known."""
        found = select(scene_count.c.place_key).where(self._is_counted, self._is_answer).distinct()
        return list(self.connection.scalars(found))

    def happened(self) -> dict[int, dict[str, int]]:
        """How often something else happened, by the age of the period and by `counts.happening`."""
        counted, age = scene_count.c, self._age
        found: Select[Any] = (
            select(age, counted.outcome, _sum(counted.photograph_count))
            .where(self._is_counted, counted.place_key == "", ~self._is_answer)
            .group_by("age", counted.outcome)
        )
        happened = defaultdict[int, dict[str, int]](dict)
        for its_age, outcome, count in self.connection.execute(found):
            happened[its_age][outcome] = count
        return dict(happened)

    def rejected(self) -> list[OutcomeSums]:
        """Sums over rejected photographs by place and outcome."""
        return self._by_outcome(scene_count, scene_count.c.outcome != LOCALIZED)

    def since(self, days: Mapping[str, int]) -> list[OutcomeSums]:
        """Sums over all photographs of places, by place and outcome, of the days after that of the place, by key.

        One statement, with two parameters for each place, reads each count once: there may be a thousand places.
        """
        if not days:
            return []
        counted = scene_count.c
        columns = column("place_key", counted.place_key.type), column("day", counted.day.type)
        given = values(*columns, name="given").data(list(days.items())).cte("given").c
        # SQLite makes an index of rows that are distinct and have types; others it reads once for each count.
        after = select(cast(given.place_key, counted.place_key.type), given.day).distinct().subquery()
        joined = scene_count.outerjoin(after, after.c.place_key == counted.place_key)
        return self._by_outcome(joined, counted.day > func.coalesce(after.c.day, self._days.last))

    def _by_outcome(self, source: FromClause, is_wanted: ColumnElement[bool]) -> list[OutcomeSums]:
        counted, names, count = scene_count.c, (*_POSITIONED, "squared_offset"), len(_POSITIONED)
        sums = [_sum(counted[name]) for name in names]
        weighted = [_sum(counted[name] * self._weight) for name in _POSITIONED]
        found: Select[Any] = (
            select(counted.place_key, counted.outcome, *sums, *weighted)
            .select_from(source)
            .where(self._is_counted, self._is_answer, is_wanted)
            .group_by(counted.place_key, counted.outcome)
        )
        return [
            OutcomeSums(
                place_key,
                outcome,
                Sums(**dict(zip(names, its[:-count], strict=True))),
                Sums(**dict(zip(_POSITIONED, its[-count:], strict=True))),
            )
            for place_key, outcome, *its in self.connection.execute(found)
        ]

    def periods(self) -> Iterator[PeriodSums]:
        """Sums by place, period and outcome, ordered by place."""
        counted, age = scene_count.c, self._age
        sums = [_sum(counted[name]) for name in Answered._fields]
        found: Select[Any] = (
            select(counted.place_key, age, counted.outcome, _sum(counted.photograph_count * self._weight), *sums)
            .where(self._is_counted, self._is_answer)
            .group_by(counted.place_key, "age", counted.outcome)
            .order_by(counted.place_key, "age", counted.outcome)
        )
        result = self.connection.execute(found, execution_options={"yield_per": _ROWS_AT_A_TIME})
        for place_key, its_age, outcome, weighted_count, *its in result:
            yield PeriodSums(place_key, its_age, outcome, Answered(*its), weighted_count)

    def events(self, most: int) -> tuple[list[Event], dict[str, tuple[int, int]]]:
        """The last references that were adopted or retired, the last one first; and numbers of adopted ones.

        The numbers are of each place with adopted references, by key: those in use and those that are retired.
        """
        adopted, standing = adopted_reference.c, reference_standing.c
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
            .where(reference.c.scene_id == self._scene_key)
            .where(adopted.adopt_time_us.is_not(None) | standing.retire_time_us.is_not(None))
        )
        events, places = list[Event](), dict[str, tuple[int, int]]()
        for it in self.connection.execute(of_scene):
            place_key = it.key if it.place_key is None else it.place_key
            if it.adopt_time_us is not None:
                events.append(Event(it.reference_id, it.adopt_time_us, None, place_key))
            if it.retire_time_us is not None:
                events.append(Event(it.reference_id, it.retire_time_us, it.retire_reason, place_key))
            used, retired = places.get(place_key, (0, 0))
            is_retired = it.retire_time_us is not None
            places[place_key] = (used + (not is_retired), retired + is_retired)
        events = [it for it in events if self._days.first <= it.time_us // DAY_US <= self._days.last]
        events.sort(key=lambda it: (-it.time_us, it.reference_id))
        return events[:most], places


def find_references(connection: Connection, scene_key: SceneKey, keys: Collection[str]) -> dict[str, ReferenceRecord]:
    """References of a scene by key, with what photographs said of them; those that are gone or damaged are left out."""
    of_scene, found = queries.select_references().where(reference.c.scene_id == scene_key), dict[str, ReferenceRecord]()
    for some in queries.portions(sorted(keys)):
        for row in connection.execute(of_scene.where(reference.c.key.in_(some))):
            with suppress(DataLoss):
                found[row.key] = rows.reference_record(row)
    return found


def _sum(value: ColumnElement[Any]) -> ColumnElement[Any]:
    """The sum of a value, of its type: PostgreSQL's of integers is a decimal."""
    return cast(func.sum(value), value.type)
