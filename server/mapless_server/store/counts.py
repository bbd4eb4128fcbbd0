"""Counts of answered photographs by scene, day, place and outcome, for reports of scenes, which `reporting` reads.

Only sums are kept: no photographs, no callers. Servers that share a store add up. A row is deleted when its day is too
old, and with its scene; its place is the key of a surveyed reference, which may have been deleted since.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from sqlalchemy import Select, case, func, select, true

from mapless_server.security import SceneKey

from . import queries
from .database import Database
from .deletion import delete_counts_where
from .tables import adopted_reference, reference, reference_standing, scene, scene_count

DAY_US = 24 * 3600 * 1_000_000
LOCALIZED = "localized"
"""The outcome of a photograph that was localized; others are values of `RejectionReason`."""


def happening(name: str, result: str) -> str:
    """The outcome under which is counted what became of a photograph or a reference: no answer, and without a place."""
    return f"{name}:{result}"


HAPPENED = ":"
"""Stands in the outcomes of `happening`, and in no other."""


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
        .where(column.day >= since_day - days, ~column.outcome.contains(HAPPENED))
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
