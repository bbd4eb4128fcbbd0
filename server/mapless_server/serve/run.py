"""Runs the server until it is told to stop, or something inside it breaks."""

from __future__ import annotations

import asyncio
import gc
import logging
import os
import signal
import sys
from contextlib import AsyncExitStack
from typing import Any, NoReturn

from mapless_server.settings import Settings

from .assembly import MakeEngine, make_engine
from .running import running_server

log = logging.getLogger(__name__)

FATAL_EXIT_CODE = 70
"""EX_SOFTWARE: something inside is broken; whoever supervises the process starts it anew."""

LAST_WORDS_S = 1.0
"""For callers and health watchers to be told before a broken process ends."""

CLOSING_LIMIT_S = 15.0
"""After the calls' own time, for threads to be through with their step, traces and the store; then whatever still runs
hangs. With the drain's times it must be less than what the supervisor gives, see deploy/kubernetes."""

SWITCH_INTERVAL_S = 0.001
"""How long a computing thread keeps the interpreter from the event loop; Python's own 5 ms add up to late answers."""


async def serve(settings: Settings, make: MakeEngine = make_engine) -> None:
    """Serves until SIGTERM or SIGINT, then lets running calls finish; StartupError if it cannot begin.

    If something inside breaks that cannot be mended, even while it stops, or hangs when all calls have had their time,
    the process ends with FATAL_EXIT_CODE.
    """
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    stop = asyncio.Event()
    for number in (signal.SIGTERM, signal.SIGINT):
        asyncio.get_running_loop().add_signal_handler(number, stop.set)
    stopped = asyncio.ensure_future(stop.wait())
    async with AsyncExitStack() as stack:
        starting = asyncio.ensure_future(stack.enter_async_context(running_server(settings, make)))
        waited: set[asyncio.Future[Any]] = {starting, stopped}
        await asyncio.wait(waited, return_when=asyncio.FIRST_COMPLETED)
        if not starting.done():
            log.info("stopping before the start was over")
            starting.cancel()
            await asyncio.wait({starting})
            return
        running = starting.result()
        # What is there by now stays; going through it again and again would only stop the event loop.
        gc.collect()
        gc.freeze()
        # Read by programs that start a server on port 0: keep its form.
        print(f"mapless-server listening on {running.address}", flush=True)
        ended: set[asyncio.Future[Any]] = {stopped, running.failed}
        await asyncio.wait(ended, return_when=asyncio.FIRST_COMPLETED)
        if running.failed.done():
            await end_broken()
        log.info("stopping: running calls get %g s", settings.drain_grace_s)
        closing = asyncio.ensure_future(stack.aclose())
        limit_s = settings.drain_delay_s + settings.drain_grace_s + CLOSING_LIMIT_S
        ended = {closing, running.failed}
        await asyncio.wait(ended, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
        if running.failed.done():
            await end_broken()
        if not closing.done():
            log.critical("the server hangs: it has not stopped after %g s", limit_s)
            await end_broken()
        await closing


async def end_broken() -> NoReturn:
    """Ends the process when callers have been told; whoever supervises it starts it anew."""
    await asyncio.sleep(LAST_WORDS_S)
    logging.shutdown()
    os._exit(FATAL_EXIT_CODE)  # threads may hang, so none is waited for
