"""A running server: opens its parts in order, and closes them in reverse order at the end of its block."""

from __future__ import annotations

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager, suppress
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING, Any

from mapless_server import __version__
from mapless_server.errors import RequestError
from mapless_server.observability.event_loop import watch_event_loop
from mapless_server.observability.exporter import MetricsServer
from mapless_server.observability.metrics import Metrics
from mapless_server.observability.scraped import gpu_memory
from mapless_server.observability.store_probe import StoreProbe
from mapless_server.rpc.descriptors import most_connections, open_connections, raise_limit, watch_connections
from mapless_server.scheduling import Fatal
from mapless_server.security import SecurityError
from mapless_server.security.protection import Protection
from mapless_server.security.reloading import keep_fresh
from mapless_server.services.capture.calls import CaptureError
from mapless_server.services.capture.recorder import open_recorder
from mapless_server.services.handlers import Services
from mapless_server.settings import Settings
from mapless_server.store import Store

from .listening import AddressTaken, GrpcServer, Listen
from .opening import MakeAdopter, MakeEngine, make_adopter, make_engine, open_store
from .startup import StartupError, what_is_missing

if TYPE_CHECKING:
    from mapless_server.engine.queue_engine import QueueEngine
    from mapless_server.observability.otlp import OtlpTracer

log = logging.getLogger(__name__)

_TRACES_FLUSH_S = 3.0

_HEARTBEAT_LIMIT_S = 5.0

QUIET_S = 10.0
"""A server that has computed nothing for so long is idle: fleets and imports have shorter gaps."""


@dataclass(frozen=True)
class Running:
    """A server that answers calls; addresses are "host:port", that of the metrics empty if they are not served.

    The future `failed` is done after an unrecoverable failure, when nothing will be computed any more.
    """

    address: str
    metrics_address: str
    engine: QueueEngine
    failed: asyncio.Future[Fatal]


@asynccontextmanager
async def running_server(
    settings: Settings,
    make: MakeEngine = make_engine,
    store: Store | None = None,
    listen: Listen = GrpcServer,
    adopting: MakeAdopter = make_adopter,
) -> AsyncIterator[Running]:
    """Runs a server within a program; it is drained at the end of the block.

    It listens at once, answers calls that need the store alone, and all calls after the warm-up.

    Args:
        settings: its settings; port 0 for any free one.
        make: function that makes the engine, called in a thread, because networks take long to load. The engine is
            closed at the end.
        store: store of the references; opened from the settings if None. Closed at the end, unless the settings'
            protection is rejected.
        listen: function that makes the listener.
        adopting: function that makes the adopter, for programs in which days pass faster.

    Raises:
        StartupError: weights or a device are missing, the data folder or a file cannot be used, a port is taken, or
            the first localization fails.
    """
    async with AsyncExitStack() as stack:
        try:
            running = await _start(stack, settings, make, store, listen, adopting)
        except (AddressTaken, CaptureError, SecurityError) as error:
            raise StartupError(str(error)) from error
        yield running


async def _start(
    stack: AsyncExitStack,
    settings: Settings,
    make: MakeEngine,
    store: Store | None,
    listen: Listen,
    adopting: MakeAdopter,
) -> Running:
    metrics = Metrics()
    raise_limit()
    protection = Protection.of(settings)  # first, so that a rejected start makes no store
    store = store or open_store(settings)
    store.observer = metrics
    stack.push_async_callback(asyncio.to_thread, store.close)
    tracer = _make_tracer(settings)
    if tracer is not None:
        stack.push_async_callback(asyncio.to_thread, tracer.close, _TRACES_FLUSH_S)
    metrics_address = _serve_metrics(settings, metrics, store, protection, stack)
    recorder = await asyncio.to_thread(open_recorder, settings, metrics)
    if recorder is not None:
        stack.push_async_callback(asyncio.to_thread, recorder.close)
    authenticate = protection.authenticator.authenticate
    services = Services(settings, store, metrics, authenticate=authenticate, tracer=tracer, recorder=recorder)
    stack.push_async_callback(services.close)
    await services.set_serving(False)
    listener = listen(settings, services, None if protection.tls is None else protection.tls.server_credentials())
    stack.push_async_callback(listener.close)
    await listener.start()
    services.starts("it loads its features and their weights")
    engine = await asyncio.to_thread(make, settings, store, metrics, protection.quota)
    stack.push_async_callback(engine.close)
    failed: asyncio.Future[Fatal] = asyncio.get_running_loop().create_future()
    _observe_engine(engine, metrics)
    engine.queue.on_fatal = lambda fatal: _on_fatal(fatal, failed, metrics)
    _run_task(stack, watch_event_loop(metrics, partial(engine.queue.is_alive_within, _HEARTBEAT_LIMIT_S)))
    if protection.refreshes:
        _run_task(stack, keep_fresh(protection.refreshes))
    _run_task(stack, watch_store(store, services.set_changeable))
    if port := _port_of(listener.address):
        connections = partial(open_connections, port)
        metrics.scraped.connections, metrics.scraped.most_connections = connections, most_connections
        _run_task(stack, watch_connections(connections))
    _run_task(stack, _stop_serving_after(failed, services))
    services.starts("it localizes its first photograph")
    await _warm_up(settings, engine, metrics)
    await _open(stack, settings, services, engine, store, metrics, adopting)
    _work_when_idle(stack, settings, engine)
    stack.push_async_callback(listener.stop)
    stack.push_async_callback(services.drain, settings.drain_delay_s, settings.drain_grace_s)
    return Running(listener.address, metrics_address, engine, failed)


async def _stop_serving_after(failed: asyncio.Future[Fatal], services: Services) -> None:
    await asyncio.wait({failed})
    await services.set_serving(False)


async def _open(
    stack: AsyncExitStack,
    settings: Settings,
    services: Services,
    engine: QueueEngine,
    store: Store,
    metrics: Metrics,
    adopting: MakeAdopter,
) -> None:
    """Answers all calls from now on, with what counts and adopts their photographs."""
    from .aging import watch_scenes  # what they import is loaded by now
    from .counting import Counting

    counting = Counting(engine, store, metrics, settings.report_days)
    adopter = adopting(engine, store, counting, settings.capture_hours)
    stack.push_async_callback(counting.close)
    _run_task(stack, counting.run())
    _run_task(stack, watch_scenes(store, settings.metrics_scenes, metrics.scraped))
    await services.open(engine, adopter.offer, counting.note)
    _run_task(stack, adopter.run())


def _work_when_idle(stack: AsyncExitStack, settings: Settings, engine: QueueEngine) -> None:
    """Releases memory, loads stronger features and matches references while nothing is asked."""
    from .idle import release_when_idle  # what it imports is loaded by now

    _run_task(stack, release_when_idle(engine.tiers, QUIET_S))
    if settings.warm_up:
        from .warm_up import warm_up_stronger

        _run_task(stack, warm_up_stronger(engine, QUIET_S))
    if engine.background is not None:
        engine.background.start(settings.background_matching)
        stack.push_async_callback(asyncio.to_thread, engine.background.close)


def _port_of(address: str) -> int:
    """The port of "host:port"; 0 where another program listens."""
    port = address.rpartition(":")[2]
    return int(port) if port.isdecimal() else 0


def _make_tracer(settings: Settings) -> OtlpTracer | None:
    if not settings.otlp_endpoint:
        return None
    try:
        from mapless_server.observability.otlp import make_otlp_tracer

        return make_otlp_tracer(settings.otlp_endpoint)
    except (ImportError, ValueError) as error:
        raise StartupError(what_is_missing(error)) from error


def _serve_metrics(
    settings: Settings, metrics: Metrics, store: Store, protection: Protection, stack: AsyncExitStack
) -> str:
    """Serves the metrics; returns "host:port", empty if the settings disable them."""
    metrics.scraped.reference_cache = lambda: store.reference_cache
    if protection.tls is not None:
        tls = protection.tls
        metrics.scraped.certificate_expiry = lambda: tls.expiry_s
    if not settings.metrics:
        return ""
    try:
        host, port = settings.metrics_host, settings.metrics_port
        exporter = MetricsServer(metrics.registry, host, port, metrics, StoreProbe(store.check))
    except OSError as error:
        where = f"{settings.metrics_host}:{settings.metrics_port}"
        raise StartupError(f"cannot serve metrics on {where}: {error.strerror or error}") from error
    stack.push_async_callback(asyncio.to_thread, exporter.close)
    where = f"{settings.metrics_host}:{exporter.port}"
    log.info("metrics on http://%s/metrics", where)
    return where


def _observe_engine(engine: QueueEngine, metrics: Metrics) -> None:
    first = engine.tiers[0]
    metrics.built(__version__, first.backend, first.features, first.weights_sha256)
    metrics.scraped.retrieval_index = lambda: engine.references.index_bytes
    metrics.scraped.index_files = lambda: engine.references.index_file_bytes
    metrics.watch_queue(engine.queue.load)
    metrics.scraped.gpu_memory = gpu_memory
    cache = getattr(first.pipeline.reconstructor, "cache", None)  # of tokens; networks have one
    if cache is not None:
        metrics.scraped.token_cache = lambda: cache.counters


async def _warm_up(settings: Settings, engine: QueueEngine, metrics: Metrics) -> None:
    from .warm_up import warm_up  # it computes, see `opening`

    engine.queue.start()
    if not settings.warm_up:
        return
    start_s = time.monotonic()
    try:
        await warm_up(engine)
    except Exception as error:
        log.critical("the first localization failed", exc_info=error)
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise StartupError(f"the first localization failed, so none would succeed: {reason}") from error
    metrics.warmed_up(time.monotonic() - start_s)
    log.info("warm after %.1f s", time.monotonic() - start_s)


def _on_fatal(fatal: Fatal, failed: asyncio.Future[Fatal], metrics: Metrics) -> None:
    if not failed.done():
        metrics.count("fatal")
        log.critical("the server ends after an unrecoverable failure: %s", fatal)
        failed.set_result(fatal)


def _run_task(stack: AsyncExitStack, work: Coroutine[Any, Any, None]) -> None:
    """Runs a task until the stack is closed; logs its failure at once."""
    task = asyncio.ensure_future(work)

    def log_failure(_: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) is not None:
            log.critical("a task of the server ended", exc_info=error)

    async def end() -> None:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)

    task.add_done_callback(log_failure)
    stack.push_async_callback(end)


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
