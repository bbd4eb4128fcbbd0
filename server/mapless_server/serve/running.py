"""A running server: opens its parts in order, and closes them in reverse order at the end of its block."""

import asyncio
import logging
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import AsyncExitStack, asynccontextmanager
from dataclasses import dataclass
from typing import Any, Protocol

import grpc

from mapless_server import __version__
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.observability.event_loop import watch_event_loop
from mapless_server.observability.exporter import MetricsServer
from mapless_server.observability.metrics import Metrics
from mapless_server.observability.scraped import gpu_memory
from mapless_server.observability.tracing import Tracer
from mapless_server.scheduling import Fatal
from mapless_server.security import SecurityError
from mapless_server.security.protection import Protection
from mapless_server.security.reloading import keep_fresh
from mapless_server.services.capture.calls import CaptureError
from mapless_server.services.capture.recorder import open_recorder
from mapless_server.services.handlers import Services
from mapless_server.settings import Settings
from mapless_server.store import Store

from .assembly import MakeEngine, StartupError, make_engine, open_store, what_is_missing
from .listening import AddressTaken, GrpcServer
from .store_health import watch_store
from .warm_up import warm_up, warm_up_stronger

log = logging.getLogger(__name__)

_TRACES_FLUSH_S = 3.0

_HEARTBEAT_LIMIT_S = 5.0


class Listener(Protocol):
    """Receives the calls of the services; bound to its address, "host:port", when it is made."""

    address: str

    async def start(self) -> None:
        """Accepts calls."""

    async def stop(self) -> None:
        """Stops accepting calls; all calls are answered, but the last bytes may still be in transit."""

    async def close(self) -> None:
        """Ends immediately; may be called after `stop`."""


Listen = Callable[[Settings, Services, "grpc.ServerCredentials | None"], Listener]


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
    settings: Settings, make: MakeEngine = make_engine, store: Store | None = None, listen: Listen = GrpcServer
) -> AsyncIterator[Running]:
    """Runs a server within a program; it is drained at the end of the block.

    It listens at once, and answers calls after the warm-up.

    Args:
        settings: its settings; port 0 for any free one.
        make: function that makes the engine, called in a thread, because networks take long to load. The engine is
            closed at the end.
        store: store of the references; opened from the settings if None. Closed at the end, unless the settings'
            protection is rejected.
        listen: function that makes the listener.

    Raises:
        StartupError: weights or a device are missing, the data folder or a file cannot be used, a port is taken, or
            the first localization fails.
    """
    async with AsyncExitStack() as stack:
        try:
            running = await _start(stack, settings, make, store, listen)
        except (AddressTaken, CaptureError, SecurityError) as error:
            raise StartupError(str(error)) from error
        yield running


async def _start(
    stack: AsyncExitStack, settings: Settings, make: MakeEngine, store: Store | None, listen: Listen
) -> Running:
    metrics = Metrics()
    protection = Protection.of(settings)  # first, so that a rejected start makes no store
    store = store or open_store(settings)
    store.observer = metrics
    stack.push_async_callback(asyncio.to_thread, store.close)
    tracer = _make_tracer(settings)
    stack.push_async_callback(asyncio.to_thread, tracer.close, _TRACES_FLUSH_S)
    metrics_address = _serve_metrics(settings, metrics, store, protection, stack)
    recorder = await asyncio.to_thread(open_recorder, settings, store, metrics)
    if recorder is not None:
        stack.push_async_callback(asyncio.to_thread, recorder.close)
    authenticate = protection.authenticator.authenticate
    services = Services(settings, store, metrics, authenticate=authenticate, tracer=tracer, recorder=recorder)
    stack.push_async_callback(services.close)
    await services.set_serving(False)
    listener = listen(settings, services, None if protection.tls is None else protection.tls.server_credentials())
    stack.push_async_callback(listener.close)
    await listener.start()
    engine = await asyncio.to_thread(make, settings, store, metrics, protection.quota)
    stack.push_async_callback(engine.close)
    failed: asyncio.Future[Fatal] = asyncio.get_running_loop().create_future()
    _observe_engine(engine, metrics)
    engine.queue.on_fatal = lambda fatal: _on_fatal(fatal, failed, metrics)
    _run_task(stack, watch_event_loop(metrics, lambda: engine.queue.is_alive_within(_HEARTBEAT_LIMIT_S)))
    _run_task(stack, keep_fresh(protection.refreshes))
    _run_task(stack, watch_store(store, services.set_changeable))

    async def stop_serving() -> None:
        await asyncio.wait({failed})
        await services.set_serving(False)

    _run_task(stack, stop_serving())
    await _warm_up(settings, engine, metrics)
    await services.open(engine)
    if settings.warm_up:
        _run_task(stack, warm_up_stronger(engine))
    if engine.background is not None:
        engine.background.start(settings.background_matching)
        stack.push_async_callback(asyncio.to_thread, engine.background.close)
    stack.push_async_callback(listener.stop)
    stack.push_async_callback(services.drain, settings.drain_delay_s, settings.drain_grace_s)
    return Running(listener.address, metrics_address, engine, failed)


def _make_tracer(settings: Settings) -> Tracer:
    if not settings.otlp_endpoint:
        return Tracer()
    try:
        from mapless_server.observability.otlp import make_otlp_tracer

        return make_otlp_tracer(settings.otlp_endpoint)
    except ImportError as error:
        raise StartupError(what_is_missing(error)) from error
    except ValueError as error:
        raise StartupError(str(error)) from error


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
        exporter = MetricsServer(metrics.registry, settings.metrics_host, settings.metrics_port, metrics)
    except OSError as error:
        address = f"{settings.metrics_host}:{settings.metrics_port}"
        raise StartupError(f"cannot serve metrics on {address}: {error.strerror or error}") from error
    stack.push_async_callback(asyncio.to_thread, exporter.close)
    address = f"{settings.metrics_host}:{exporter.port}"
    log.info("metrics on http://%s/metrics", address)
    return address


def _observe_engine(engine: QueueEngine, metrics: Metrics) -> None:
    first = engine.tiers[0]
    metrics.built(__version__, first.backend, first.features, first.weights_sha256)
    metrics.scraped.retrieval_index = lambda: engine.references.index_bytes
    metrics.watch_queue(engine.queue.load)
    metrics.scraped.gpu_memory = gpu_memory
    cache = getattr(first.pipeline.reconstructor, "cache", None)  # of tokens; networks have one
    if cache is not None:
        metrics.scraped.token_cache = lambda: cache.counters


async def _warm_up(settings: Settings, engine: QueueEngine, metrics: Metrics) -> None:
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
