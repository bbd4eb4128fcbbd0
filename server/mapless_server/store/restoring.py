"""Has retired references of a scene chosen again, and forgets what was held against them.

Adopted ones that would be retired or deleted again stay retired: those without what vouches for them, those at places
that need a new survey, and the least useful ones that their places have no room for.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import Connection, Row, Select, delete, select, update

from mapless.names import shown
from mapless_server.errors import DataLoss, FailedPrecondition, InvalidArgument
from mapless_server.security import SceneKey

from . import changes, queries, retiring, rows
from .records import ReferenceRecord, RetirementReason
from .store import Store
from .tables import adopted_reference, reference, reference_standing, removed_reference, scene

MOST_LOST_SHARE = 0.5
"""Share of the vouching matches of an adopted reference whose references may be gone."""

_STAYS_BECAUSE = {
    RetirementReason.VOUCHERS_GONE: "what vouches for it was deleted or is retired",
    RetirementReason.SURVEY_OUTDATED: "its place needs a new survey",
    RetirementReason.PLACE_FULL: "its place has as many adopted references as it may",
}


@dataclass(frozen=True)
class Restored:
    """The outcome of restoring retired references.

    Attributes:
        reference_ids: of those that are chosen again, ordered.
        staying: why others stay retired, by id.
    """

    reference_ids: Sequence[str]
    staying: Mapping[str, str]


def restore(store: Store, scene_key: SceneKey, since: datetime | None = None, place_id: str = "") -> Restored:
    """Has retired references of a scene chosen again, as one change, but those that would not last, see the module.

    Those that were retired at a time or later, and of the place of the surveyed reference with this id: itself, and
    what was adopted there. That place needs no new survey any more; without time and place none of the scene does.
    NotFound if there is no such scene or reference; InvalidArgument if that was adopted.
    """
    column, standing = reference.c, reference_standing.c
    retired = (
        select(column.key, column.reference_id)
        .join(reference_standing, standing.reference_key == column.key)
        .where(column.scene_id == scene_key, standing.retire_time_us >= (0 if since is None else rows.time_us(since)))
        .order_by(column.reference_id)
    )
    is_current = column.scene_id == scene_key
    with store.changing() as connection:
        generation = changes.begin_change(connection, scene_key)
        if place_id:
            place_key = queries.find_key(connection, scene_key, place_id, "place")
            adopted = adopted_reference.c
            if connection.scalar(select(adopted.place_key).where(adopted.reference_key == place_key)) is not None:
                fault = f"{shown(place_id)} was adopted: name the surveyed reference of its place"
                raise InvalidArgument(fault, field="place")
            here = select(adopted_reference.c.reference_key).where(adopted_reference.c.place_key == place_key)
            retired = retired.where((column.key == place_key) | column.key.in_(here))
            is_current &= column.key == place_key
        if place_id or since is None:
            ended = standing.reference_key.in_(select(column.key).where(is_current))
            values = {"surveyed_share": None, "photograph_count": 0, "surveyed_by": "", "outdate_time_us": None}
            is_outdated = standing.outdate_time_us.is_not(None)
            connection.execute(update(reference_standing).where(ended, is_outdated).values(values))
        found = {it.key: it.reference_id for it in connection.execute(retired)}
        staying = _restore_lasting(connection, scene_key, generation, list(found))
    restored = [it for key, it in found.items() if key not in staying]
    return Restored(restored, {it: staying[key] for key, it in found.items() if key in staying})


def restore_reference(store: Store, scene_key: SceneKey, reference_id: str) -> ReferenceRecord:
    """Has a retired reference chosen again, and forgets what was held against it; others are left as they are.

    NotFound if there is no such scene or reference; FailedPrecondition if it stays retired, and why.
    """
    with store.changing() as connection:
        generation = changes.begin_change(connection, scene_key)
        key = queries.find_key(connection, scene_key, reference_id)
        staying = _restore_lasting(connection, scene_key, generation, retiring.retired_among(connection, [key]))
        if key in staying:
            raise FailedPrecondition(f"{reference_id} stays retired: {staying[key]}")
    return store.get_reference(scene_key, reference_id)


def _restore_lasting(
    connection: Connection, scene_key: SceneKey, generation: int, keys: Sequence[str]
) -> dict[str, str]:
    """Has retired references chosen again, but those that would not last; returns why these stay retired, by key."""
    adopted = adopted_reference.c
    its = [
        row
        for some in queries.portions(sorted(keys))
        for row in connection.execute(select(adopted_reference).where(adopted.reference_key.in_(some)))
    ]
    _restore(connection, scene_key, generation, sorted({*keys} - {it.reference_key for it in its}))
    lost = lost_shares(connection, scene_key, [it.reference_key for it in its])
    reasons = {key: RetirementReason.VOUCHERS_GONE for key, share in lost.items() if share > MOST_LOST_SHARE}
    reasons |= without_room(connection, scene_key, [it for it in its if it.reference_key not in reasons])
    _restore(connection, scene_key, generation, sorted({it.reference_key for it in its} - reasons.keys()))
    return {key: _STAYS_BECAUSE[reason] for key, reason in reasons.items()}


def without_room(connection: Connection, scene_key: SceneKey, its: Sequence[Row[Any]]) -> dict[str, RetirementReason]:
    """Why adopted references, rows of `adopted_reference`, cannot be in use at their places, by key; of some of them.

    Their places need a new survey, or have no room for them beside others that are in use: the most useful have it,
    and of equally useful ones the newest. The caller's transaction is a change of the scene.
    """
    adopted, standing = adopted_reference.c, reference_standing.c
    keys, outdated, counts = {it.reference_key for it in its}, set[str](), Counter[str]()
    for some in queries.portions(sorted({it.place_key for it in its})):
        found = select(standing.reference_key).where(
            standing.reference_key.in_(some), standing.outdate_time_us.is_not(None)
        )
        outdated |= set(connection.scalars(found))
        used: Select[Any] = (
            select(adopted.reference_key, adopted.place_key)
            .join(reference, adopted.reference_key == reference.c.key)
            .where(reference.c.scene_id == scene_key, adopted.place_key.in_(some), ~queries.is_retired(reference.c.key))
        )
        counts.update(it.place_key for it in connection.execute(used) if it.reference_key not in keys)
    policy = rows.scene_attributes(queries.find_scene(connection, scene_key)).adoption
    reasons = dict[str, RetirementReason]()
    for it in sorted(its, key=lambda row: (-row.usefulness, -row.adopt_time_us, row.reference_key)):
        if it.place_key in outdated:
            reasons[it.reference_key] = RetirementReason.SURVEY_OUTDATED
        elif policy is not None and counts[it.place_key] >= policy.most_per_place:
            reasons[it.reference_key] = RetirementReason.PLACE_FULL
        else:
            counts[it.place_key] += 1
    return reasons


def lost_shares(connection: Connection, scene_key: SceneKey, keys: Sequence[str]) -> dict[str, float]:
    """Share of the vouching matches whose references are gone, by key, of adopted references that lack some.

    A reference that is retired is gone, and one that was stored after the adopted one is another with the same id.
    Damaged adopted references are left out: they are not used anyway.
    """
    column, found = reference.c, dict[str, float]()
    records = [
        record for row in queries.rows_by_key(connection, keys).values() if (record := _undamaged(row)) is not None
    ]
    named = sorted({it.reference_id for record in records for it in record.provenance.vouchers})
    is_surveyed = column.key.not_in(select(adopted_reference.c.reference_key)) & ~queries.is_retired(column.key)
    surveyed: Select[Any] = select(column.reference_id, column.create_time_us).where(
        column.scene_id == scene_key, is_surveyed
    )
    created = {
        it.reference_id: rows.time_of(it.create_time_us)
        for ids in queries.portions(named)
        for it in connection.execute(surveyed.where(column.reference_id.in_(ids)))
    }
    for record in records:
        vouchers = record.provenance.vouchers
        there = {it for it in vouchers if (at := created.get(it.reference_id)) and at <= record.create_time}
        lost = sum(it.match_count for it in vouchers if it not in there)
        if lost:
            found[record.key] = lost / sum(it.match_count for it in vouchers)
    return found


def _undamaged(row: Row[Any]) -> ReferenceRecord | None:
    try:
        return rows.reference_record(row)
    except DataLoss:
        return None


def _restore(connection: Connection, scene_key: SceneKey, generation: int, keys: Sequence[str]) -> None:
    if not keys:
        return
    for some in queries.portions(keys):
        connection.execute(delete(reference_standing).where(reference_standing.c.reference_key.in_(some)))
        again = update(reference).where(reference.c.key.in_(some))  # for work in the background
        connection.execute(again.values(generation=generation))
    # Indexes never add a key again that they removed; so all of them read the whole scene.
    connection.execute(delete(removed_reference).where(removed_reference.c.scene_id == scene_key))
    connection.execute(update(scene).where(scene.c.scene_id == scene_key).values(first_generation=generation))
