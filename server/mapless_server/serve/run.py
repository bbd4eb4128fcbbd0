"""Runs the server until a signal or an internal failure stops it."""

import asyncio
import gc
import logging
import os
import signal
import sys
from contextlib import AsyncExitStack
from typing import Any, NoReturn

from mapless_server.settings import Settings

from .opening import MakeEngine, make_engine
from .running import running_server

log = logging.getLogger(__name__)

FATAL_EXIT_CODE = 70
"""EX_SOFTWARE: the process failed, and its supervisor should restart it."""

NOTIFY_S = 1.0
"""Time to notify callers and health watchers before a failed process ends."""

CLOSING_LIMIT_S = 15.0
"""Time after the drain for threads to end their step, for traces and for the store; then the process hangs. Together
with the drain's times it must be less than the supervisor's limit, see deploy/kubernetes."""

STOP_STARTING_S = 0.5
"""Time for what has been opened to be closed, if a signal comes before the start is over; killing the process loses
nothing that is stored."""

SWITCH_INTERVAL_S = 0.001
"""Longest time that a computing thread blocks the event loop; Python's default of 5 ms adds up to late answers."""


async def serve(settings: Settings, make: MakeEngine = make_engine) -> None:
    """Serves until SIGTERM or SIGINT, then lets running calls finish; StartupError if it cannot start.

    After an unrecoverable failure, also while it stops, or if it hangs after the drain, the process ends with
    FATAL_EXIT_CODE.
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
            await asyncio.wait({starting}, timeout=STOP_STARTING_S)
            logging.shutdown()
            os._exit(0)  # the thread that loads networks cannot be ended
        running = starting.result()
        # Present objects stay; scanning them again would only block the event loop.
        gc.collect()
        gc.freeze()
        gc.enable()
        # Parsed by programs that start a server on port 0: keep its form.
        print(f"mapless-server listening on {running.address}", flush=True)
        ended: set[asyncio.Future[Any]] = {stopped, running.failed}
        await asyncio.wait(ended, return_when=asyncio.FIRST_COMPLETED)
        if running.failed.done():
            await exit_failed()
        log.info("stopping: running calls get %g s", settings.drain_grace_s)
        closing = asyncio.ensure_future(stack.aclose())
        limit_s = settings.drain_delay_s + settings.drain_grace_s + CLOSING_LIMIT_S
        ended = {closing, running.failed}
        await asyncio.wait(ended, timeout=limit_s, return_when=asyncio.FIRST_COMPLETED)
        if running.failed.done():
            await exit_failed()
        if not closing.done():
            log.critical("the server hangs: it has not stopped after %g s", limit_s)
            await exit_failed()
        await closing


async def exit_failed() -> NoReturn:
    """Ends the process after callers have been notified, so that its supervisor restarts it."""
    await asyncio.sleep(NOTIFY_S)
    logging.shutdown()
    os._exit(FATAL_EXIT_CODE)  # not waiting for threads, which may hang
