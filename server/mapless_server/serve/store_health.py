"""Whether scenes can be changed: health says of the ReferenceService alone that it does not serve while they cannot.

Queries go on, of what is in memory and what can be read; so neither the server as a whole nor its other service is to
be taken out of service because of a disk that is full or can only be read. Of a database that servers share nothing is
said: while it is away, none of them could do better.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from contextlib import suppress

from mapless_server.errors import RequestError
from mapless_server.store import Store

log = logging.getLogger(__name__)

LOOK_EVERY_S = 5.0
"""Between looks; only a store whose last change failed is then tried by writing to it."""


async def watch_store(store: Store, tell: Callable[[bool], Awaitable[None]], every_s: float = LOOK_EVERY_S) -> None:
    """Tells whether the store can be changed, when that is other than it was, until it is cancelled.

    Args:
        store: what is looked at; it is tried once at the beginning.
        tell: hears of it; told nothing, it believes that the store can be changed.
        every_s: between looks.
    """
    if store.database.is_shared:
        return  # where a database is away, no other server could do better
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
            await tell(can)
        could = can
        await asyncio.sleep(every_s)
        if store.write_fault:
            await _try(store)


async def _try(store: Store) -> None:
    with suppress(RequestError):  # the store notes it
        await asyncio.to_thread(store.try_writing)
