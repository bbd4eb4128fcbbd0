"""Stored matches of pairs of references, and which references are matched already, by any of the servers.

A *matching* names everything that determines the matches beside the two references: features, rule, options. A pair is
stored once, under the reference whose keypoints come first in it.

The pairs of a reference are those with references that precede it in its scene: every pair belongs to one reference,
also if others are added later. A server claims a reference, matches its pairs and stores them; a claim ends by itself
after `CLAIM_S`, so the unfinished work of a killed server is done by another server, or after a restart.
"""

import logging
import random
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from sqlalchemy import Connection, Row, Select, delete, func, literal, or_, select, update

from mapless_server.errors import NotFound
from mapless_server.method.features.matching import StoredPair
from mapless_server.security import SceneKey

from . import codec, queries, rows
from .database import Database, unless_damaged
from .queries import is_detached, is_retired
from .tables import (
    matching_use,
    reference,
    reference_depth,
    reference_matching,
    reference_pair,
    scene,
    scene_calibration,
    scene_generation,
)

CLAIM_S = 60.0
"""Far longer than the pairs of one reference take on an idle server; on a busy one, it is released before the end."""

FIRST_RETRY_S, LONGEST_RETRY_S = 30.0, 3600.0
"""After the first failure with a reference, twice as long after each further one."""

_CANDIDATES = 16
"""Servers that claim at the same time choose among so many, so that they seldom choose the same."""

Pair = tuple[str, str]
"""The keys of two references, in the order of the matches' columns."""


@dataclass(eq=False)
class Progress:
    """A server's knowledge of the claims of one matching, so that it reads only what has changed.

    Attributes:
        generations: by scene, the generation up to which every reference has been claimed.
        generation_sum: sum of the generations of all scenes that ever existed, when every reference had been claimed.
    """

    generations: dict[SceneKey, int] = field(default_factory=dict)
    generation_sum: int = -1


@dataclass(frozen=True)
class Claim:
    """A reference, with its id unique within the scene and its key, whose pairs one server matches."""

    scene_key: SceneKey
    reference_id: str
    key: str


class PairStore:
    """Matches of pairs in a store's database; thread-safe. Raises the same errors as `Store`."""

    def __init__(self, database: Database, claim_s: float = CLAIM_S) -> None:
        """`database` is that of the references; a claim ends by itself after `claim_s`."""
        self._database = database
        self._claim_s = claim_s

    def load(self, matching: str, pairs: Collection[Pair]) -> dict[Pair, StoredPair | None]:
        """Loads what is stored of these pairs; None for damaged ones."""
        column = reference_pair.c
        first, second = ({pair[side] for pair in pairs} for side in (0, 1))
        stored: Select[Any] = select(column.first_key, column.second_key, column.data, column.sha256, column.error_px)
        stored = stored.where(column.matching == matching, column.first_key.in_(first), column.second_key.in_(second))
        with self._database.read() as connection:
            found: Sequence[Row[Any]] = unless_damaged(connection, lambda: connection.execute(stored).all(), list)
        wanted = set(pairs)
        return {_pair(row): _decoded(matching, row) for row in found if _pair(row) in wanted}

    def list_errors(self, matching: str, scene_key: SceneKey, at_most: int) -> dict[Pair, float]:
        """The known errors of a scene's pairs, see `pairs.agreement`, pixels; some of a large scene's."""
        column = reference_pair.c
        known: Select[Any] = (
            select(column.first_key, column.second_key, column.error_px)
            .join(reference, reference.c.key == column.first_key)
            .where(reference.c.scene_id == scene_key, column.matching == matching, column.error_px.is_not(None))
            .order_by(column.first_key, column.second_key)  # so that the same pairs are taken each time
        )
        with self._database.read() as connection:
            return {_pair(row): row.error_px for row in connection.execute(known.limit(at_most))}

    def list_scenes_with_errors(self, matching: str, above_px: float, at_most: int) -> list[SceneKey]:
        """Scenes with a pair whose error is larger."""
        column = reference_pair.c
        found: Select[Any] = (
            select(reference.c.scene_id)
            .join(reference_pair, reference.c.key == column.first_key)
            .where(column.matching == matching, column.error_px > above_px)
            .distinct()
        )
        with self._database.read() as connection:
            return [SceneKey(it) for it in connection.scalars(found.limit(at_most))]

    def list_existing(self, keys: Collection[str]) -> set[str]:
        """Those of these references' keys that exist."""
        with self._database.read() as connection:
            return set(connection.scalars(select(reference.c.key).where(reference.c.key.in_(keys))))

    def claim(self, matching: str, progress: Progress) -> Claim | None:
        """Claims a reference whose pairs are not matched; None if none may be claimed now.

        `progress` is this server's with this matching, new at first; it is updated.
        """
        while True:
            with self._database.read() as connection:
                candidates = _due(connection, matching) or _new(connection, matching, progress)
            if not candidates:
                return None
            for row in random.sample(candidates, len(candidates)):
                if self._claim(matching, row.key):
                    return Claim(SceneKey(row.scene_id), row.reference_id, row.key)

    def _claim(self, matching: str, key: str) -> bool:
        column, begin_us = reference_matching.c, rows.now_us()
        until_us = begin_us + round(self._claim_s * 1e6)
        row = {"reference_key": key, "matching": matching, "due_time_us": until_us}
        with self._database.write() as connection:
            try:
                queries.lock_reference(connection, key)
            except NotFound:
                return False
            is_free = (
                update(reference_matching)
                .where(column.reference_key == key, column.matching == matching, column.due_time_us <= begin_us)
                .values(due_time_us=row["due_time_us"])
            )
            return connection.execute(is_free).rowcount == 1 or queries.insert_new(connection, reference_matching, row)

    def list_missing(self, matching: str, claim: Claim, others: Sequence[str], at_most: int) -> list[str]:
        """The first `at_most` of these keys that precede the claimed reference in its scene and have no stored pair."""
        column, pair = reference.c, reference_pair.c
        generation = select(column.generation).where(column.key == claim.key).scalar_subquery()
        precedes = or_(column.generation < generation, (column.generation == generation) & (column.key < claim.key))
        earlier = select(column.key).where(column.key.in_(others), column.scene_id == claim.scene_key, precedes)
        stored = select(pair.first_key, pair.second_key).where(
            pair.matching == matching,
            or_(
                (pair.first_key == claim.key) & pair.second_key.in_(others),
                (pair.second_key == claim.key) & pair.first_key.in_(others),
            ),
        )
        with self._database.read() as connection:
            preceding = set(connection.scalars(earlier))
            found = {key for pair in connection.execute(stored) for key in pair}
        return [key for key in [key for key in others if key in preceding][:at_most] if key not in found]

    def add(self, matching: str, claim: Claim, made: Mapping[Pair, StoredPair], is_complete: bool) -> None:
        """Stores pairs of a claimed reference and ends the claim; if not complete, others may claim it at once.

        Pairs of references that were deleted meanwhile, and pairs that are stored already, are ignored.
        """
        data = {pair: codec.encode_matches(it.matches) for pair, it in made.items()}
        with self._database.write() as connection:
            present = _locked(connection, {claim.key, *(key for pair in made for key in pair)})
            for pair in sorted(pair for pair in data if present.issuperset(pair)):
                row = {
                    "first_key": pair[0],
                    "second_key": pair[1],
                    "matching": matching,
                    "data": data[pair],
                    "error_px": made[pair].error_px,
                    "sha256": codec.sha256_for(_owner(matching, pair, made[pair].error_px), data[pair]),
                }
                queries.insert_new(connection, reference_pair, row)
            due_us = None if is_complete else rows.now_us()
            connection.execute(_of_claim(matching, claim).values(due_time_us=due_us, failure_count=0))

    def postpone(self, matching: str, claim: Claim, is_damaged: bool = False) -> float:
        """Ends the claim of a reference that failed; returns the seconds until it may be claimed again.

        Only one that `is_damaged` counts as complete, see `count_complete`: its number of failures is positive.
        """
        column = reference_matching.c
        count = select(column.failure_count).where(column.reference_key == claim.key, column.matching == matching)
        with self._database.write() as connection:
            wait_s, values = next_try(abs(connection.scalar(count) or 0))
            values["failure_count"] *= 1 if is_damaged else -1
            connection.execute(_of_claim(matching, claim).values(values))
        return wait_s

    def discard(self, matching: str, pairs: Iterable[Pair]) -> None:
        """Deletes damaged pairs; their references are claimed again."""
        pair, progress = reference_pair.c, reference_matching.c
        with self._database.write() as connection:
            for first, second in pairs:
                is_it = (pair.first_key == first) & (pair.second_key == second) & (pair.matching == matching)
                connection.execute(delete(reference_pair).where(is_it))
                of_them = progress.reference_key.in_([first, second]) & (progress.matching == matching)
                again = update(reference_matching).where(of_them, progress.due_time_us.is_(None))
                connection.execute(again.values(due_time_us=rows.now_us()))

    def count_complete(self, scene_key: SceneKey, matchings: Collection[str]) -> dict[str, int]:
        """Numbers of references of a scene whose pairs are all stored, by matching; and of all of them, by "".

        Damaged ones, which are tried again after a while, count as if theirs were.
        """
        column = reference_matching.c
        complete: Select[Any] = (
            select(column.matching, func.count())
            .join(reference, reference.c.key == column.reference_key)
            .where(reference.c.scene_id == scene_key, column.matching.in_(matchings))
            .where(or_(column.due_time_us.is_(None), column.failure_count > 0), ~is_retired(reference.c.key))
            .group_by(column.matching)
        )
        of_scene = select(func.count()).select_from(reference).where(reference.c.scene_id == scene_key)
        of_scene = of_scene.where(~is_retired(reference.c.key))
        with self._database.read() as connection:
            counts = {row[0]: row[1] for row in connection.execute(complete)}
            return {name: counts.get(name, 0) for name in matchings} | {"": connection.scalar(of_scene) or 0}

    def count_waiting(self, matching: str) -> int:
        """Number of references whose pairs are not all stored."""
        column = reference_matching.c
        is_complete = (
            select(literal(1))
            .where(column.reference_key == reference.c.key, column.matching == matching, column.due_time_us.is_(None))
            .exists()
        )
        waiting = select(func.count()).select_from(reference).where(~is_detached(reference.c.scene_id), ~is_complete)
        waiting = waiting.where(~is_retired(reference.c.key))
        with self._database.read() as connection:
            return connection.scalar(waiting) or 0


def next_try(failure_count: int) -> tuple[float, dict[str, int]]:
    """Seconds until a claim that failed after so many other failures may be tried again, and its row's new values."""
    wait_s = min(LONGEST_RETRY_S, FIRST_RETRY_S * 2.0 ** min(failure_count, 20))
    return wait_s, {"due_time_us": rows.now_us() + round(wait_s * 1e6), "failure_count": failure_count + 1}


def _due(connection: Connection, matching: str) -> Sequence[Row[Any]]:
    """References whose claim, or whose wait after a failure, has ended."""
    column = reference_matching.c
    due: Select[Any] = (
        select(reference.c.key, reference.c.scene_id, reference.c.reference_id)
        .join(reference_matching, column.reference_key == reference.c.key)
        .where(column.matching == matching, column.due_time_us <= rows.now_us(), ~is_detached(reference.c.scene_id))
        .where(~is_retired(reference.c.key))
    )
    return connection.execute(due.limit(_CANDIDATES)).all()


def _new(connection: Connection, matching: str, progress: Progress) -> Sequence[Row[Any]]:
    """References of one scene that no server has claimed yet, the oldest first."""
    column = scene_generation.c
    generation_sum = connection.scalar(select(func.sum(column.generation))) or 0
    if generation_sum == progress.generation_sum:
        return []
    scenes = select(column.scene_id, column.generation).join(scene, scene.c.scene_id == column.scene_id)
    generations = {SceneKey(row.scene_id): row.generation for row in connection.execute(scenes)}
    known = progress.generations
    for gone in known.keys() - generations.keys():
        del known[gone]
    is_claimed = (
        select(literal(1))
        .where(reference_matching.c.reference_key == reference.c.key, reference_matching.c.matching == matching)
        .exists()
    )
    # In any order, so that a scene of many references does not keep the others waiting.
    for scene_key, generation in random.sample(list(generations.items()), len(generations)):
        since = known.get(scene_key, -1)
        if since == generation:
            continue
        if since > generation:  # the database was replaced by a backup
            since = -1
        new: Select[Any] = (
            select(reference.c.key, reference.c.scene_id, reference.c.reference_id)
            .where(reference.c.scene_id == scene_key, reference.c.generation > since, ~is_claimed)
            .where(~is_retired(reference.c.key))
            .order_by(reference.c.generation, reference.c.key)
        )
        found = connection.execute(new.limit(_CANDIDATES)).all()
        if found:
            return found
        known[scene_key] = generation
    progress.generation_sum = generation_sum
    return []


def _locked(connection: Connection, keys: Collection[str]) -> set[str]:
    """Those of these references that exist; they cannot be deleted before the transaction ends."""
    existing = select(reference.c.key).where(reference.c.key.in_(keys)).order_by(reference.c.key)
    return set(connection.scalars(existing.with_for_update(read=True, key_share=True)))


def _of_claim(matching: str, claim: Claim) -> Any:
    column = reference_matching.c
    return update(reference_matching).where(column.reference_key == claim.key, column.matching == matching)


def _pair(row: Row[Any]) -> Pair:
    return row.first_key, row.second_key


def _decoded(matching: str, row: Row[Any]) -> StoredPair | None:
    owner = _owner(matching, _pair(row), row.error_px)
    try:
        return StoredPair(codec.decode_matches(owner, row.data, row.sha256), row.error_px)
    except codec.Damaged:
        return None


def _owner(matching: str, pair: Pair, error_px: float | None) -> str:
    """Owner of a pair's matches, for `codec.sha256_for`; with the pair's error, if it is known."""
    return f"{pair[0]}+{pair[1]} {matching}" + ("" if error_px is None else f" {error_px!r}")


log = logging.getLogger(__name__)

KEPT_S = 7 * 86_400.0
"""After the last use: a server may be stopped for a weekend, and the clocks of servers differ by less."""

_REFERENCES_AT_A_TIME = 50
"""Per transaction: their pairs are some megabytes, and other writers wait for a fraction of a second."""


def record_use(database: Database, matchings: Collection[str]) -> None:
    """Records that a server uses these matchings now; to be called much more often than every `KEPT_S`."""
    with database.write() as connection:
        for name in sorted(matchings):
            row = {"matching": name, "used_time_us": rows.now_us()}
            if not queries.insert_new(connection, matching_use, row):
                connection.execute(update(matching_use).where(matching_use.c.matching == name).values(row))


def delete_unused(database: Database, check: Callable[[], None]) -> None:
    """Deletes pairs of matchings that were not used for `KEPT_S`, in portions; calls `check` between portions."""
    limit_us = rows.now_us() - round(KEPT_S * 1e6)
    with database.read() as connection:
        unused = list(connection.scalars(select(matching_use.c.matching).where(matching_use.c.used_time_us < limit_us)))
    for name in unused:
        log.info("deleting pairs of references that no server has used for %.0f days: %s", KEPT_S / 86_400, name)
        is_left = True
        while is_left:
            check()
            with database.write() as connection:
                is_left = _delete_portion(connection, name, limit_us)


def _delete_portion(connection: Connection, name: str, limit_us: int) -> bool:
    """Deletes the pairs of some references; whether more may be left. Stops if a server uses the matching again."""
    is_it = (matching_use.c.matching == name) & (matching_use.c.used_time_us < limit_us)
    if connection.scalar(select(matching_use.c.matching).where(is_it).with_for_update()) is None:
        return False
    progress, pair = reference_matching.c, reference_pair.c
    some = select(progress.reference_key).where(progress.matching == name).limit(_REFERENCES_AT_A_TIME)
    keys = list(connection.scalars(some))
    if not keys:
        # Of references that were not claimed.
        connection.execute(delete(reference_depth).where(reference_depth.c.kind == name))
        connection.execute(delete(scene_calibration).where(scene_calibration.c.kind == name))
        connection.execute(delete(matching_use).where(is_it))
        return False
    of_them = or_(pair.first_key.in_(keys), pair.second_key.in_(keys))
    connection.execute(delete(reference_pair).where(pair.matching == name, of_them))
    depth = reference_depth.c
    connection.execute(delete(reference_depth).where(depth.kind == name, depth.reference_key.in_(keys)))
    connection.execute(delete(reference_matching).where(progress.matching == name, progress.reference_key.in_(keys)))
    return True
