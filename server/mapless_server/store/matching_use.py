"""Which matchings are in use: pairs of those that no server has used for long are deleted.

Kinds of self-calibrations and of stored depths are recorded and deleted in the same way.

Servers with other settings may share a database, and a server that is stopped is started again; so a matching is kept
for `KEPT_S` after a server last recorded that it uses it. If a server with other features is started later than that,
its pairs are made again.
"""

import logging
from collections.abc import Callable, Collection

from sqlalchemy import Connection, delete, or_, select, update

from . import queries, rows
from .database import Database
from .tables import matching_use, reference_depth, reference_matching, reference_pair, scene_calibration

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
