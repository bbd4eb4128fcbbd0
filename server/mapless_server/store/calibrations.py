"""Self-calibrations of scenes, and which scenes wait for one, of any server.

There is one calibration for each *kind* of answers: features, backend and server version, see `calibration_kind`. It
belongs to a generation of its scene; a later one makes the scene due again, and until then the last calibration is
used. A first calibration, of a few references soon after they were added, is for scenes without a calibration of any
kind. It leaves the scene due, and is made again when the scene has twice as many references, until there is another
one. A server claims a scene, localizes its references and
stores the result; a claim ends by itself after `CLAIM_S` unless it is renewed, so a scene whose server is killed is
calibrated by another server, or after a restart. A server that lost its claim, because it was too slow or the scene was
deleted, stores nothing.
"""

import random
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import ColumnElement, Connection, Select, and_, delete, func, literal, or_, select, update

from mapless_server.errors import NotFound
from mapless_server.security import SceneKey

from . import codec, queries, rows
from .attributes import SelfCalibration
from .database import Database
from .pairs import next_try
from .queries import is_detached
from .store import Store
from .tables import adopted_reference, reference, scene, scene_calibration, scene_generation

CLAIM_S = 120.0
"""Far longer than one reference takes, also on a busy server; it is renewed after each."""

LEAST_REFERENCES = 3
"""A reference is localized against two others at least."""

_CANDIDATES = 16


@dataclass(frozen=True)
class CalibrationClaim:
    """A scene that one server calibrates for answers of a kind, with the number of its references when it was claimed.

    No other server's claim ends at the same microsecond.
    """

    scene_key: SceneKey
    kind: str
    until_us: int
    reference_count: int


def claim_scene(database: Database, kind: str, is_first: bool = False) -> CalibrationClaim | None:
    """Claims a scene that has changed since its calibration; None if none may be claimed now.

    With `is_first` only one without a calibration of any kind, or with a first one of this kind and at least twice as
    many references as when that was claimed.
    """
    select_due = _select_first(kind) if is_first else _select_due(kind)
    with database.read() as connection:
        due = connection.execute(select_due.limit(_CANDIDATES)).all()
    for row in random.sample(due, len(due)):
        until_us = rows.now_us() + round(CLAIM_S * 1e6)
        claim = CalibrationClaim(SceneKey(row.scene_id), kind, until_us, row.reference_count)
        with database.write() as connection:
            if _try_claim(connection, claim):
                return claim
    return None


def renew(database: Database, claim: CalibrationClaim) -> CalibrationClaim | None:
    """Renews a claim, so that it ends later; None if it was lost."""
    renewed = replace(claim, until_us=max(rows.now_us() + round(CLAIM_S * 1e6), claim.until_us + 1))
    with database.write() as connection:
        is_ours = connection.execute(_of(claim).values(due_time_us=renewed.until_us)).rowcount == 1
    return renewed if is_ours else None


def postpone(database: Database, claim: CalibrationClaim) -> float:
    """Ends the claim of a scene that failed; returns the seconds until it may be claimed again."""
    count = select(scene_calibration.c.failure_count).where(_is_it(claim))
    with database.write() as connection:
        wait_s, values = next_try(connection.scalar(count) or 0)
        connection.execute(_of(claim).values(values))
    return wait_s


def release(database: Database, claim: CalibrationClaim) -> None:
    """Ends the claim of a server that is closed, so that others may claim the scene at once."""
    with database.write() as connection:
        connection.execute(_of(claim).values(due_time_us=rows.now_us()))


def add(
    store: Store, claim: CalibrationClaim, calibration: SelfCalibration, wait_s: float, is_first: bool = False
) -> bool:
    """Stores the calibration of a claimed scene, and ends the claim; False if the claim was lost.

    It is not a change of the scene, but cached values of the scene are dropped. The scene may be calibrated again after
    `wait_s`, however often it changes. A first calibration leaves it due: instead of a generation, the number of
    references when the scene was claimed is stored beside it, negative.
    """
    data = codec.encode_calibration(calibration)
    sha256 = codec.sha256_for(rows.calibration_owner(claim.scene_key, claim.kind), data)
    due_us = rows.now_us() + round(wait_s * 1e6)
    generation = -claim.reference_count if is_first else calibration.generation
    values = {"generation": generation, "data": data, "sha256": sha256, "due_time_us": due_us}
    with store.changing() as connection:
        return connection.execute(_of(claim).values(**values, failure_count=0)).rowcount == 1


def list_newest(database: Database, scene_key: SceneKey, count: int) -> list[str]:
    """Ids of the surveyed references that were added to a scene last, the latest first."""
    column = reference.c
    is_adopted = (
        select(adopted_reference.c.reference_key).where(adopted_reference.c.reference_key == column.key).exists()
    )
    latest = select(column.reference_id).where(column.scene_id == scene_key, ~is_adopted)
    with database.read() as connection:
        return list(connection.scalars(latest.order_by(column.generation.desc(), column.key).limit(count)))


def discard_damaged(database: Database, kind: str) -> int:
    """Deletes damaged calibrations of a kind, so that they are made again; returns their number."""
    column = scene_calibration.c
    stored: Select[Any] = select(column.scene_id, column.kind, column.data, column.sha256)
    with database.read() as connection:
        found = connection.execute(stored.where(column.kind == kind, column.data.is_not(None))).all()
    damaged = [row.scene_id for row in found if rows.self_calibration(row) is None]
    for scene_id in damaged:
        with database.write() as connection:
            connection.execute(delete(scene_calibration).where(column.scene_id == scene_id, column.kind == kind))
    return len(damaged)


def count_waiting(database: Database, kind: str) -> int:
    """Number of scenes that have changed since their calibration."""
    with database.read() as connection:
        changed = _select_changed(kind).subquery()
        return connection.scalar(select(func.count()).select_from(changed)) or 0


def is_waiting(database: Database, scene_key: SceneKey, kind: str) -> bool:
    """Whether a scene has changed since its calibration."""
    with database.read() as connection:
        return connection.scalar(_select_changed(kind).where(scene.c.scene_id == scene_key)) is not None


def _select_changed(kind: str) -> Select[Any]:
    """Scenes with references that have changed since their calibration."""
    column, generation = scene_calibration.c, scene_generation.c
    of_kind = (column.scene_id == scene.c.scene_id) & (column.kind == kind)
    is_current: ColumnElement[bool] = column.generation == generation.generation
    return (
        select(scene.c.scene_id, scene.c.reference_count)
        .join(scene_generation, generation.scene_id == scene.c.scene_id)
        .outerjoin(scene_calibration, of_kind)
        .where(~is_detached(scene.c.scene_id), or_(column.generation.is_(None), ~is_current))
        .where(or_(scene.c.reference_count > 0, column.scene_id.is_not(None)))
    )


def _select_due(kind: str) -> Select[Any]:
    column = scene_calibration.c
    return _select_changed(kind).where(or_(column.due_time_us.is_(None), column.due_time_us <= rows.now_us()))


def _select_first(kind: str) -> Select[Any]:
    column, of_any_kind, count = scene_calibration.c, scene_calibration.alias().c, scene.c.reference_count
    is_calibrated = (
        select(literal(1)).where(of_any_kind.scene_id == scene.c.scene_id, of_any_kind.generation.is_not(None)).exists()
    )
    has_doubled = and_(column.generation < 0, count >= -2 * column.generation)
    return _select_due(kind).where(or_(~is_calibrated, has_doubled), count >= LEAST_REFERENCES)


def _try_claim(connection: Connection, claim: CalibrationClaim) -> bool:
    column = scene_calibration.c
    try:
        queries.read_generation(connection, claim.scene_key)
    except NotFound:
        return False
    free = update(scene_calibration).where(_is_it(claim), column.due_time_us <= rows.now_us())
    if connection.execute(free.values(due_time_us=claim.until_us)).rowcount == 1:
        return True
    row = {"scene_id": claim.scene_key, "kind": claim.kind, "due_time_us": claim.until_us}
    return queries.insert_new(connection, scene_calibration, row)


def _is_it(claim: CalibrationClaim) -> ColumnElement[bool]:
    column = scene_calibration.c
    return (column.scene_id == claim.scene_key) & (column.kind == claim.kind)


def _of(claim: CalibrationClaim) -> Any:
    return update(scene_calibration).where(_is_it(claim), scene_calibration.c.due_time_us == claim.until_us)
