"""Deletion of scenes: a scene is detached at once, so that readers do not find it; its rows are deleted in portions.

Detaching changes one short row per reference; deleting means megabytes. If the server is stopped in between, the rows
that are left are deleted when the store is opened again, or with the next scene that is deleted.
"""

import logging
import threading
import time
import uuid
from bisect import bisect_right
from collections.abc import Sequence
from itertools import accumulate

from sqlalchemy import (
    Column,
    ColumnElement,
    Connection,
    ScalarSelect,
    delete,
    func,
    insert,
    literal,
    select,
    tuple_,
    update,
)

from mapless_server.errors import Overloaded
from mapless_server.security import SceneKey

from .database import DamagedPages, Database, with_room_to_delete
from .queries import DETACHED, is_detached
from .tables import (
    depth,
    features,
    global_descriptor,
    image,
    mask,
    reference,
    reference_depth,
    reference_pair,
    scene,
    scene_count,
)

logger = logging.getLogger(__name__)

PORTION_BYTES = 4 * 2**20
"""Photographs, features, descriptors and matches deleted in one transaction, unless a single reference has more.

SQLite overwrites what it deletes, so it writes as much to its journal, which needs the space until the transaction is
over. This is as much as it collects there anyway: the journal stays small, and others wait for a fraction of a second.
"""
REFERENCES_AT_A_TIME = 100
"""Most references per transaction; other writers of SQLite wait as long."""
COUNTS_AT_A_TIME = 5000
"""Most rows of `scene_count` per transaction: other writers wait for about as long."""
PAUSE_S = 0.01
"""Between transactions, so that other writers get SQLite's lock, which is given in no order."""

AGAIN_S = 30.0
"""Between attempts where the disk is full."""

_DAMAGED = f"{DETACHED}damaged"
"""Key of the references that were deleted but whose pages cannot be freed, since the database cannot read them."""


class PendingDeletions:
    """Deletes the rows of detached scenes; thread-safe."""

    def __init__(self, database: Database) -> None:
        self._database = database
        self._closing = threading.Event()
        self._starting = threading.Lock()  # one thread, which `close` waits for
        self._thread: threading.Thread | None = None

    def resume(self) -> None:
        """Starts a thread that completes interrupted deletions, if there are any; never raises."""
        if self._database.only_reads:
            return
        try:
            is_pending = self._is_pending()
        except Exception as error:
            _log_failure(error)
            return
        if is_pending:
            logger.info("completing deletions of scenes that were interrupted")
            self._start(0.0)

    def try_again(self) -> None:
        """Starts a thread, unless there is one, that deletes what the disk had no room for, until it has."""
        with self._starting:
            if self._thread is None or not self._thread.is_alive():
                self._start(AGAIN_S)

    def _start(self, pause_s: float) -> None:
        self._thread = threading.Thread(target=self._run_thread, args=[pause_s], name="deletions", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Ends the thread after its current portion."""
        self._closing.set()
        if self._thread is not None:
            self._thread.join()

    def run(self) -> None:
        """Deletes the rows of all detached scenes; references on pages that cannot be freed are moved aside.

        Overloaded if the disk has too little space even to delete one reference.
        """
        if self._is_pending():
            with_room_to_delete(self._database, self._run)

    def _run(self) -> None:
        at_most = count = REFERENCES_AT_A_TIME
        was_full = False
        while True:
            # First, because a transaction that runs out of space would leave too little for this.
            self._database.free_space()
            keys: list[str] = []
            try:
                if not self._delete_portion(count, keys):
                    return
                count, was_full = at_most, False
            except DamagedPages:
                if count == 1 and not keys:  # not the reference is damaged, but what it is looked up in
                    raise
                if count == 1:
                    with self._database.write() as connection:
                        move_aside(connection, keys[0])
                count, was_full = 1 if count > 1 else at_most, False
            except Overloaded:
                if was_full:
                    raise
                at_most, count, was_full = 1, 1, True
            if self._closing.wait(PAUSE_S):
                return

    def _is_pending(self) -> bool:
        with self._database.read() as connection:
            return is_pending(connection)

    def _delete_portion(self, count: int, keys: list[str]) -> bool:
        """Deletes a portion; returns whether more is left. `keys` receives those of the portion before its deletion."""
        with self._database.write() as connection:  # changes nothing that readers see
            keys += next_portion(connection, count)
            delete_references(connection, *keys)
            delete_empty(connection)
            return bool(keys) and is_pending(connection)

    def _run_thread(self, pause_s: float) -> None:
        while not self._closing.wait(pause_s) and not self._is_completed():
            pause_s = AGAIN_S

    def _is_completed(self) -> bool:
        """Runs; False if the disk is too full."""
        try:
            self.run()
        except Overloaded as error:
            logger.warning("what is left of deleted scenes is deleted when there is room: %s", error)
            return False
        except Exception as error:
            _log_failure(error)
        return True


def _log_failure(error: Exception) -> None:
    logger.warning("what is left of deleted scenes stays until the next start or deletion of a scene: %s", error)


def delete_counts_where(database: Database, are_wanted: ColumnElement[bool]) -> int:
    """Deletes rows of `scene_count`, in portions; returns their number."""
    key, total = tuple_(*scene_count.primary_key), 0
    portion = select(*scene_count.primary_key).where(are_wanted).limit(COUNTS_AT_A_TIME)
    while True:
        with database.write() as connection:
            count = connection.execute(delete(scene_count).where(key.in_(portion))).rowcount
        total += count
        if count < COUNTS_AT_A_TIME:
            return total
        time.sleep(PAUSE_S)


# The statements; each runs in the caller's transaction.


def detach_scene(connection: Connection, scene_key: SceneKey) -> str:
    """Deletes a scene, but keeps its references' rows under the returned key; the caller has the scene's lock."""
    key = f"{DETACHED}{uuid.uuid4().hex}"
    # It gets no generation, so no other statement takes it for a scene.
    connection.execute(insert(scene).values(scene_id=key, create_time_us=0))
    connection.execute(update(reference).where(reference.c.scene_id == scene_key).values(scene_id=key))
    connection.execute(delete(scene).where(scene.c.scene_id == scene_key))
    return key


def move_aside(connection: Connection, key: str) -> None:
    """Detaches a reference for good, because its damaged pages prevent its deletion."""
    if connection.scalar(select(scene.c.scene_id).where(scene.c.scene_id == _DAMAGED)) is None:
        connection.execute(insert(scene).values(scene_id=_DAMAGED, create_time_us=0))
    connection.execute(update(reference).where(reference.c.key == key).values(scene_id=_DAMAGED, reference_id=key))


def is_pending(connection: Connection) -> bool:
    """Whether rows of detached scenes are still to be deleted."""
    column = scene.c.scene_id
    return connection.scalar(select(column).where(is_detached(column), column != _DAMAGED).limit(1)) is not None


def next_portion(connection: Connection, at_most: int) -> Sequence[str]:
    """Keys of the references to delete next: at most this many, and together at most `PORTION_BYTES`.

    References that another server is deleting are skipped.
    """
    column = reference.c
    pending = select(column.key).where(is_detached(column.scene_id), column.scene_id != _DAMAGED).order_by(column.key)
    keys = connection.scalars(pending.limit(at_most).with_for_update(skip_locked=True)).all()
    if len(keys) <= 1:  # where pages are damaged even the size may not be readable
        return keys
    owners = [it.c.reference_key for it in (image, mask, depth, features, global_descriptor, reference_depth)]
    size_bytes = sum(map(_size_bytes, [*owners, reference_pair.c.first_key]), literal(0))
    sizes = connection.scalars(select(size_bytes).where(column.key.in_(keys)).order_by(column.key))
    return keys[: max(1, bisect_right(list(accumulate(sizes)), PORTION_BYTES))]


def _size_bytes(owner: Column[str]) -> ScalarSelect[int]:
    """Size of a reference's rows in the table with this column of keys, without reading the bytes."""
    total = select(func.coalesce(func.sum(func.length(owner.table.c.data)), 0))
    return total.where(owner == reference.c.key).scalar_subquery()


def delete_references(connection: Connection, *keys: str) -> None:
    """Deletes references with everything that belongs to them."""
    connection.execute(delete(reference).where(reference.c.key.in_(keys)))


def delete_empty(connection: Connection) -> None:
    """Deletes detached scenes without references."""
    is_empty = ~select(reference.c.key).where(reference.c.scene_id == scene.c.scene_id).exists()
    connection.execute(delete(scene).where(is_detached(scene.c.scene_id), is_empty))


def delete_detached(connection: Connection) -> None:
    """Deletes all detached scenes at once."""
    connection.execute(delete(scene).where(is_detached(scene.c.scene_id)))
