"""Adopted references, and what photographs said of references: which are retired, so that they are not chosen any more.

An adopted reference is an ordinary one whose provenance says what vouches for it; a row in `adopted_reference` says
where it belongs and how useful it is. A reference that is retired stays in the store, and leaves the indexes of all
servers as a deleted one does (`changes.read_changes`); after it is restored they read the whole scene.

Two servers that adopt one photograph give it the same id, so that the database refuses the second.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from datetime import datetime
from typing import Any

from sqlalchemy import ColumnElement, Connection, Row, Select, bindparam, func, select, update

from mapless.provenance import ADOPTED
from mapless_server.security import SceneKey

from . import changes, deletion, queries, restoring, retiring, rows
from .database import Database
from .records import Adopted, NewReference, ReferenceRecord, RetirementReason, Standing
from .store import Store
from .tables import adopted_reference, reference, reference_standing, scene_generation


class NotAdopted(Exception):
    """A photograph is not adopted, because the scene or what vouches for it has changed meanwhile; says what."""


class PlaceFull(Exception):
    """A photograph is not adopted, because its place has as many as it may, all as useful, or one of its adopter."""


def adopt(
    store: Store, scene_key: SceneKey, new: NewReference, voucher_keys: Collection[str], most_per_place: int
) -> tuple[ReferenceRecord, frozenset[str]]:
    """Adds an adopted reference, if the scene still adopts and what it rests on is as it was, in one transaction.

    That are the surveyed references that vouch for it, by their keys, since another one may have got the id of one; and
    its place, `NewReference.place_key`, which needs no new survey. So many that are not retired are kept there; the
    least useful are deleted. Where there is one of the same `NewReference.adopted_by`, retired or not, there is no
    place for another.

    Returns:
        The new reference, and the keys of those that were deleted.

    NotAdopted or PlaceFull if it is not added; AlreadyExists if another server was first; otherwise as
    `Store.add_references`.
    """
    if new.provenance.source != ADOPTED:
        raise ValueError(f"the provenance must be {ADOPTED}, is {new.provenance.source}")
    column, adopted, left = reference.c, adopted_reference.c, list[str]()

    def refuse_changed(connection: Connection) -> None:
        wanted = {it.reference_id for it in new.provenance.vouchers}
        is_surveyed = ~queries.is_retired(column.key) & column.key.not_in(select(adopted.reference_key))
        there: Select[Any] = select(column.key, column.reference_id).where(
            column.scene_id == scene_key, column.key.in_({*voucher_keys, new.place_key}), is_surveyed
        )
        found = {it.key: it.reference_id for it in connection.execute(there)}
        if {found.get(it) for it in voucher_keys} != wanted:
            raise NotAdopted("a surveyed reference that vouches for it was deleted, retired or replaced")
        if new.place_key not in found:
            raise NotAdopted("the surveyed reference of its place was deleted or retired")
        standing = reference_standing.c
        outdated = select(standing.outdate_time_us).where(standing.reference_key == new.place_key)
        # Who declares it outdated waits for the end of the transaction, and then retires this one, too.
        if connection.scalar(outdated.with_for_update(read=True)) is not None:
            raise NotAdopted("its place needs a new survey")

    def admit(connection: Connection) -> None:
        if rows.scene_attributes(queries.find_scene(connection, scene_key)).adoption is None:
            raise NotAdopted("the scene adopts no photographs any more")
        queries.refuse_taken_ids(connection, scene_key, [new.reference_id])  # before the same one leaves for it
        refuse_changed(connection)
        here = (
            select(column.key, adopted.usefulness)
            .join(adopted_reference, adopted.reference_key == column.key)
            .where(column.scene_id == scene_key, adopted.place_key == new.place_key)
            .order_by(adopted.usefulness, adopted.adopt_time_us, column.key)
        )
        if new.adopted_by and connection.execute(here.where(adopted.adopted_by == new.adopted_by)).first() is not None:
            raise PlaceFull
        found = connection.execute(here.where(~queries.is_retired(column.key))).all()
        leaving = found[: max(0, len(found) + 1 - most_per_place)]
        if any(it.usefulness >= new.usefulness for it in leaving):
            raise PlaceFull
        left[:] = [it.key for it in leaving]
        if left:
            generation = changes.begin_change(connection, scene_key, -len(left))
            deletion.delete_references(connection, *left)
            changes.note_removals(connection, scene_key, generation, left)

    (record,) = store.add_references(scene_key, [new], admit)
    if left:
        store.forget_deleted(left)
    return record, frozenset(left)


def list_adopted(database: Database, scene_key: SceneKey) -> list[Adopted]:
    """The adopted references of a scene, the least useful first; empty if there is no such scene."""
    return _list_adopted(database, reference.c.scene_id == scene_key)


def list_adopted_at(database: Database, place_keys: Collection[str]) -> list[Adopted]:
    """The adopted references at places, the least useful first; reads no others, however many a scene has."""
    return _list_adopted(database, adopted_reference.c.place_key.in_(sorted(place_keys)))


def _list_adopted(database: Database, are_wanted: ColumnElement[bool]) -> list[Adopted]:
    column, standing = adopted_reference.c, reference_standing.c
    statement: Select[Any] = (
        select(reference.c.reference_id, adopted_reference, standing.retire_time_us)
        .join(adopted_reference, column.reference_key == reference.c.key)
        .outerjoin(reference_standing, standing.reference_key == reference.c.key)
        .where(are_wanted)
        .order_by(column.usefulness, column.adopt_time_us, reference.c.reference_id)
    )
    with database.read() as connection:
        return [
            Adopted(
                it.reference_id,
                it.reference_key,
                it.place_key,
                it.usefulness,
                it.retire_time_us is not None,
                it.adopted_by,
            )
            for it in connection.execute(statement)
        ]


def list_adopting_scenes(database: Database) -> dict[SceneKey, int]:
    """Generations of the scenes that have adopted references, by key, ordered."""
    scene_id = reference.c.scene_id
    statement: Select[Any] = (
        select(scene_id, scene_generation.c.generation)
        .join(adopted_reference, adopted_reference.c.reference_key == reference.c.key)
        .join(scene_generation, scene_generation.c.scene_id == scene_id)
        .where(~queries.is_detached(scene_id))
        .distinct()
        .order_by(scene_id)
    )
    with database.read() as connection:
        return {SceneKey(it.scene_id): it.generation for it in connection.execute(statement)}


def list_expired(database: Database, before: datetime) -> list[tuple[SceneKey, str]]:
    """Scene and id of the references that were adopted before a time, or are of a time to come, ordered."""
    column, now_us = adopted_reference.c, rows.now_us()
    is_expired = (column.adopt_time_us < rows.time_us(before)) | (column.adopt_time_us > now_us + CLOCKS_DIFFER_US)
    statement: Select[Any] = (
        select(reference.c.scene_id, reference.c.reference_id)
        .join(adopted_reference, column.reference_key == reference.c.key)
        .where(~queries.is_detached(reference.c.scene_id), is_expired)
        .order_by(reference.c.scene_id, reference.c.reference_id)
    )
    with database.read() as connection:
        return [(SceneKey(it.scene_id), it.reference_id) for it in connection.execute(statement)]


CLOCKS_DIFFER_US = 60_000_000
"""Clocks of servers that share a store may differ by so much; one that was set back prolongs nothing."""


def unvouched(database: Database, scene_key: SceneKey) -> list[str]:
    """Keys of the adopted references that are not retired, and more than half of whose vouching matches are gone."""
    column = reference.c
    adopted = select(column.key).join(adopted_reference, adopted_reference.c.reference_key == column.key)
    with database.read() as connection:
        keys = connection.scalars(adopted.where(column.scene_id == scene_key, ~queries.is_retired(column.key))).all()
        lost = restoring.lost_shares(connection, scene_key, keys)
    return sorted(key for key, share in lost.items() if share > restoring.MOST_LOST_SHARE)


def list_unplaced(database: Database, scene_key: SceneKey) -> list[str]:
    """Keys of the adopted references whose place is not known: they were imported, or its surveyed one was deleted."""
    key, column = reference.c.key, adopted_reference.c
    place = reference.alias()
    adopted = select(key).join(adopted_reference, column.reference_key == key)
    statement = adopted.outerjoin(place, place.c.key == column.place_key).where(
        reference.c.scene_id == scene_key, place.c.key.is_(None)
    )
    with database.read() as connection:
        return list(connection.scalars(statement.order_by(key)))


def set_places(store: Store, scene_key: SceneKey, places: Mapping[str, str]) -> dict[str, RetirementReason]:
    """Stores the key of the surveyed reference whose place each adopted one is at, by key, as one change of the scene.

    Retires those at places that need a new survey, and the least useful of these places beyond the policy's most.

    Returns:
        Why references were retired, by key, also those that were there before.

    NotFound if there is no such scene; references that are gone are passed over.
    """
    adopted = adopted_reference.c
    with store.changing() as connection:
        generation = changes.begin_change(connection, scene_key)
        for key, place_key in sorted(places.items()):
            row = update(adopted_reference).where(adopted.reference_key == key)
            connection.execute(row.values(place_key=place_key))
        in_use: Select[Any] = (
            select(adopted_reference)
            .join(reference, reference.c.key == adopted.reference_key)
            .where(reference.c.scene_id == scene_key, ~queries.is_retired(reference.c.key))
        )
        its, standing = list[Row[Any]](), reference_standing.c
        for some in queries.portions(sorted(set(places.values()))):
            # Who declares one outdated waits for the end of the transaction, and then retires what is at it.
            known = select(standing.reference_key).where(standing.reference_key.in_(some))
            connection.execute(known.order_by(standing.reference_key).with_for_update(read=True)).all()
            its += connection.execute(in_use.where(adopted.place_key.in_(some)))
        reasons = restoring.without_room(connection, scene_key, its)
        for reason in sorted(set(reasons.values())):
            leaving = sorted(key for key, why in reasons.items() if why is reason)
            retiring.retire(connection, scene_key, generation, leaving, reason)
    return reasons


def set_usefulness(database: Database, usefulness: Mapping[str, float]) -> None:
    """Stores the usefulness of adopted references, by key; those that are gone are passed over."""
    with database.write() as connection:
        for key, value in sorted(usefulness.items()):  # in one order, or two servers would wait for each other
            row = update(adopted_reference).where(adopted_reference.c.reference_key == key)
            connection.execute(row.values(usefulness=value))


def read_standings(database: Database, keys: Collection[str]) -> dict[str, Standing]:
    """Findings of photographs about references, by key; references without any are left out."""
    column = reference_standing.c
    with database.read() as connection:
        found = connection.execute(select(reference_standing).where(column.reference_key.in_(sorted(keys))))
        return {it.reference_key: rows.standing(it) for it in found}


def list_outdated(connection: Connection, scene_key: SceneKey) -> dict[str, str]:
    """Ids of the references whose places need a new survey, by key, ordered by id; empty if there is no such scene."""
    statement: Select[Any] = (
        select(reference.c.key, reference.c.reference_id)
        .join(reference_standing, reference_standing.c.reference_key == reference.c.key)
        .where(reference.c.scene_id == scene_key, reference_standing.c.outdate_time_us.is_not(None))
        .order_by(reference.c.reference_id)
    )
    return {it.key: it.reference_id for it in connection.execute(statement)}


def list_outdated_scenes(database: Database) -> dict[SceneKey, dict[str, int]]:
    """The references whose places need a new survey, since when, microseconds since 1970, by key and by scene."""
    found = dict[SceneKey, dict[str, int]]()
    statement: Select[Any] = (
        select(reference.c.scene_id, reference.c.key, reference_standing.c.outdate_time_us)
        .join(reference_standing, reference_standing.c.reference_key == reference.c.key)
        .where(~queries.is_detached(reference.c.scene_id), reference_standing.c.outdate_time_us.is_not(None))
        .order_by(reference.c.scene_id, reference.c.key)
    )
    with database.read() as connection:
        for it in connection.execute(statement):
            found.setdefault(SceneKey(it.scene_id), {})[it.key] = it.outdate_time_us
    return found


def list_surveyed_since(database: Database, scene_key: SceneKey, time_us: int) -> dict[str, int]:
    """When the surveyed references of a scene were stored, by key, of those that were stored after a time."""
    column = reference.c
    statement: Select[Any] = select(column.key, column.create_time_us).where(
        column.scene_id == scene_key,
        column.create_time_us > time_us,
        column.key.not_in(select(adopted_reference.c.reference_key)),
        ~queries.is_retired(column.key),
    )
    with database.read() as connection:
        return {it.key: it.create_time_us for it in connection.execute(statement)}


_PLACE = reference.alias("place")
_FIND_OUTDATED: Select[Any] = (  # made once: a rejection waits for it
    select(reference.c.key, _PLACE.c.key.label("place_key"), _PLACE.c.reference_id)
    .outerjoin(adopted_reference, adopted_reference.c.reference_key == reference.c.key)
    .join(_PLACE, _PLACE.c.key == func.coalesce(adopted_reference.c.place_key, reference.c.key))
    .join(reference_standing, reference_standing.c.reference_key == _PLACE.c.key)
    .where(reference.c.key.in_(bindparam("keys", expanding=True)), reference_standing.c.outdate_time_us.is_not(None))
)


def find_outdated(database: Database, keys: Collection[str]) -> dict[str, tuple[str, str]]:
    """The places of references, by their keys, that need a new survey: key and id of the place's surveyed reference.

    References at other places are left out.
    """
    with database.read() as connection:
        found = connection.execute(_FIND_OUTDATED, {"keys": sorted(keys)})
        return {it.key: (it.place_key, it.reference_id) for it in found}


def change_standings(
    database: Database, keys: Collection[str], change: Callable[[str, Standing], Standing]
) -> dict[str, Standing]:
    """Changes what is known of references, by key, in one transaction; returns the new values.

    References that are gone are passed over. Servers that count at once lose nothing: the rows are locked.
    """
    made = dict[str, Standing]()
    with database.write() as connection:
        for key in sorted(keys):
            there = select(reference.c.key).where(reference.c.key == key)
            # Its deletion waits for the end of the transaction.
            if connection.scalar(there.with_for_update(read=True, key_share=True)) is None:
                continue
            made[key] = change(key, rows.standing(_locked_standing(connection, key)))
            values = dict(vars(made[key]))
            values |= {name: " ".join(values[name]) for name in ("contradicted_by", "surveyed_by")}
            row = update(reference_standing).where(reference_standing.c.reference_key == key)
            connection.execute(row.values(values))
    return made


def _locked_standing(connection: Connection, key: str) -> Row[Any]:
    """The row of what is known of a reference, which is inserted if there is none."""
    stored: Select[Any] = select(reference_standing).where(reference_standing.c.reference_key == key).with_for_update()
    while True:
        queries.insert_new(connection, reference_standing, {"reference_key": key})
        row = connection.execute(stored).one_or_none()
        if row is not None:  # else it was restored by another server after the insertion
            return row


def outdated(standing: Standing) -> Standing:
    """The standing of a place that needs a new survey from now on, by the store's clock."""
    return replace(standing, outdate_time_us=rows.now_us())


def surveyed_again(standing: Standing) -> Standing:
    """The standing of a place that has a new survey: nothing is known of it yet."""
    return replace(standing, surveyed_share=None, photograph_count=0, surveyed_by=(), outdate_time_us=None)


def retire(store: Store, scene_key: SceneKey, keys: Sequence[str], reason: RetirementReason) -> list[str]:
    """Has references not chosen any more, as one change of the scene; returns the keys of those that were.

    References that are gone or retired already are passed over. NotFound if there is no such scene.
    """
    column = reference.c
    of_scene = select(column.key).where(column.scene_id == scene_key, column.key.in_(keys))
    with store.changing() as connection:
        generation = changes.begin_change(connection, scene_key)
        chosen = list(connection.scalars(of_scene.where(~queries.is_retired(column.key)).order_by(column.key)))
        retiring.retire(connection, scene_key, generation, chosen, reason)
    return chosen


def retire_by_operator(store: Store, scene_key: SceneKey, reference_id: str) -> ReferenceRecord:
    """Has a reference not chosen any more, unless it is retired already; returns it as it is then.

    NotFound if there is no such scene or reference.
    """
    with store.changing() as connection:
        generation = changes.begin_change(connection, scene_key)
        key = queries.find_key(connection, scene_key, reference_id)
        if not retiring.retired_among(connection, [key]):
            retiring.retire(connection, scene_key, generation, [key], RetirementReason.BY_OPERATOR)
    return store.get_reference(scene_key, reference_id)
