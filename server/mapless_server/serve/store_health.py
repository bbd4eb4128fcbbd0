"""Health of the ReferenceService: NOT_SERVING while the store cannot be changed.

Queries still read memory and disk, so a disk that is full or read-only does not make the whole server unhealthy. A
database that servers share is not watched: if it fails, it fails for all of them.
"""

import asyncio
import logging
from collections.abc import Awaitable, Callable
from contextlib import suppress

from mapless_server.errors import RequestError
from mapless_server.store import Store

log = logging.getLogger(__name__)

CHECK_INTERVAL_S = 5.0
"""A check writes to the store only if its last change failed."""


async def watch_store(
    store: Store, notify: Callable[[bool], Awaitable[None]], interval_s: float = CHECK_INTERVAL_S
) -> None:
    """Reports each change of whether the store can be written, until it is cancelled.

    The store is written to once at the beginning; `notify` is called with the new value, which is True at first.
    """
    if store.database.is_shared:
        return
    could = True
    await _try(store)
    while True:
        can = not store.write_fault
        if can is not could:
            log.log(
                logging.INFO if can else logging.ERROR,
                "the store %s",
                "can be changed again" if can else f"cannot be changed: {store.write_fault}",
            )
            await notify(can)
        could = can
        await asyncio.sleep(interval_s)
        if store.write_fault:
            await _try(store)


async def _try(store: Store) -> None:
    with suppress(RequestError):  # the store keeps it as its write_fault
        await asyncio.to_thread(store.try_writing)
