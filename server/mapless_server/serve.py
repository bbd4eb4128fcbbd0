"""Puts the server together and runs it until it is told to stop."""

from __future__ import annotations

import asyncio
import logging
import signal
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager

import grpc
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection, reflection_pb2
from grpc_reflection.v1alpha._async import ReflectionServicer

from mapless.v1 import (
    localization_service_pb2,
    localization_service_pb2_grpc,
    reference_service_pb2,
    reference_service_pb2_grpc,
)

from .assembly import make_tiers, what_is_missing
from .decode import ImageLimits
from .engine import Engine, EngineOptions
from .reference_service import ReferenceService
from .rpc import CallInterceptor
from .service import LocalizationService
from .settings import Settings
from .store import Store, StoreError
from .weights import WeightsError, WeightsMissing

log = logging.getLogger(__name__)

SERVICE_NAMES = (
    localization_service_pb2.DESCRIPTOR.services_by_name["LocalizationService"].full_name,
    reference_service_pb2.DESCRIPTOR.services_by_name["ReferenceService"].full_name,
)


class StartupError(Exception):
    """The server cannot start; the message is one sentence for the operator."""


def image_limits(settings: Settings) -> ImageLimits:
    """The limits of images that the settings ask for."""
    return ImageLimits(
        max_bytes=settings.max_image_mib * 2**20, max_pixels=round(settings.max_image_megapixels * 1_000_000)
    )


def open_store(settings: Settings) -> Store:
    """The store in the settings' data folder; StartupError if it cannot be opened."""
    try:
        return Store.open(settings.data_dir, settings.reference_cache_mib * 2**20)
    except StoreError as error:
        raise StartupError(str(error)) from error


def make_engine(settings: Settings, store: Store) -> Engine:
    """The engine that the settings ask for; StartupError if they name what is not known or not there."""
    options = EngineOptions(
        workers=settings.workers,
        max_waiting=settings.max_waiting,
        max_candidates=settings.retrieval_max_references,
        image_limits=image_limits(settings),
    )
    try:
        return Engine(store, make_tiers(settings), options)
    except (ImportError, WeightsMissing) as error:
        raise StartupError(what_is_missing(error)) from error
    except (ValueError, WeightsError) as error:
        raise StartupError(str(error)) from error


class Server:
    """The gRPC server around an engine and a store, which it closes when it stops."""

    def __init__(self, settings: Settings, engine: Engine, store: Store) -> None:
        self._settings = settings
        self._engine = engine
        self._store = store
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined]
        self._references = ReferenceService(engine, store)
        self._server = grpc.aio.server(
            interceptors=[CallInterceptor(settings.default_deadline_s)], options=_server_options(settings)
        )

    async def start(self) -> str:
        """Listens; returns "host:port".

        Raises:
            StartupError: the address cannot be listened on.
        """
        server, settings = self._server, self._settings
        localization_service_pb2_grpc.add_LocalizationServiceServicer_to_server(
            LocalizationService(self._engine), server
        )
        reference_service_pb2_grpc.add_ReferenceServiceServicer_to_server(self._references, server)
        health_pb2_grpc.add_HealthServicer_to_server(self._health, server)
        if settings.reflection:
            names = (*SERVICE_NAMES, health.SERVICE_NAME, reflection.SERVICE_NAME)
            _enable_reflection(server, names)
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        try:
            port = server.add_insecure_port(f"{host}:{settings.port}")
        except RuntimeError as error:
            raise StartupError(f"cannot listen on {host}:{settings.port}: in use, or not an address of ours") from error
        await server.start()
        await self._set_health(health_pb2.HealthCheckResponse.SERVING)
        return f"{host}:{port}"

    async def stop(self, grace_s: float) -> None:
        """Takes no new calls, gives the running ones `grace_s` to finish, and closes everything."""
        await self._set_health(health_pb2.HealthCheckResponse.NOT_SERVING)
        await self._server.stop(grace_s)
        # Threads may still compute for calls that were cut off.
        await asyncio.to_thread(self._close)

    def _close(self) -> None:
        self._engine.close()
        self._references.close()
        self._store.close()

    async def _set_health(self, status: int) -> None:
        for service in ("", *SERVICE_NAMES):
            await self._health.set(service, status)


@asynccontextmanager
async def running_server(
    settings: Settings, engine: Engine | None = None, store: Store | None = None
) -> AsyncIterator[str]:
    """A running server, for use within a program; gives its "host:port".

    Args:
        settings: port 0 takes any free one.
        engine: what computes; made from the settings if None. Closed at the end either way, as is the store.
        store: what the engine reads; opened from the settings if None.

    Raises:
        StartupError: no such backend or features, the data folder cannot be used, the port is taken.
    """
    store = store or open_store(settings)
    try:
        engine = engine or make_engine(settings, store)
    except BaseException:
        store.close()
        raise
    server = Server(settings, engine, store)
    try:
        yield await server.start()
    finally:
        await server.stop(settings.drain_grace_s)


async def serve(settings: Settings) -> None:
    """Serves until SIGTERM or SIGINT, then lets running calls finish; StartupError if it cannot begin."""
    stop = asyncio.Event()
    loop = asyncio.get_running_loop()
    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop.set)
    async with running_server(settings) as address:
        # Read by programs that start a server on port 0: keep its form.
        print(f"mapless-server listening on {address}", flush=True)
        await stop.wait()
        log.info("stopping: running calls get %g s", settings.drain_grace_s)


def _enable_reflection(server: grpc.aio.Server, service_names: Sequence[str]) -> None:
    """Both versions of the protocol: the package has v1alpha only, and v1 is the same bytes under another name."""
    reflection.enable_server_reflection(service_names, server)
    method = grpc.stream_stream_rpc_method_handler(
        ReflectionServicer(service_names).ServerReflectionInfo,
        request_deserializer=reflection_pb2.ServerReflectionRequest.FromString,
        response_serializer=reflection_pb2.ServerReflectionResponse.SerializeToString,
    )
    v1 = grpc.method_handlers_generic_handler("grpc.reflection.v1.ServerReflection", {"ServerReflectionInfo": method})
    server.add_generic_rpc_handlers((v1,))


def _server_options(settings: Settings) -> list[tuple[str, int]]:
    max_message_bytes = settings.max_message_mib * 2**20
    return [
        ("grpc.max_receive_message_length", max_message_bytes),
        ("grpc.max_send_message_length", max_message_bytes),
        # With reuseport, the default, a second server silently shares the port and takes half of the calls.
        ("grpc.so_reuseport", 0),
        # Above the engine's own bound, so that callers are told of overload instead of waiting unseen in their channel.
        ("grpc.max_concurrent_streams", settings.workers + settings.max_waiting + 100),
        ("grpc.max_metadata_size", 16 * 1024),
        # Clients may ping every 30 s, but only while they have a call.
        ("grpc.http2.min_recv_ping_interval_without_data_ms", 30_000),
        ("grpc.http2.max_ping_strikes", 2),
        ("grpc.keepalive_permit_without_calls", 0),
        # Forgets clients that went away without a word.
        ("grpc.max_connection_idle_ms", 15 * 60_000),
    ]
