"""The gRPC server: what it listens with, its services, and its health from the start to the end."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Sequence

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

from .engine import Engine
from .errors import Unavailable
from .observability.metrics import Metrics
from .observability.tracing import Tracer
from .reference_service import ReferenceService
from .rpc import Authenticate, CallInterceptor
from .service import LocalizationService
from .settings import Settings
from .store import Store
from .watching import Watchers

log = logging.getLogger(__name__)

SERVICE_NAMES = (
    localization_service_pb2.DESCRIPTOR.services_by_name["LocalizationService"].full_name,
    reference_service_pb2.DESCRIPTOR.services_by_name["ReferenceService"].full_name,
)

LOCALIZE_METHODS = frozenset(f"/{SERVICE_NAMES[0]}/{name}" for name in ("Localize", "LocalizeRig", "LocalizeSequence"))

MAX_CONCURRENT_RPCS = 2048
"""Calls at a time, from all connections. Far above what the queue admits; health probes count, and calls of which only
the headers have come, each of which `receiving` gives but a time."""
MAX_CALLS_PER_CONNECTION = 128
"""Far below that, so that no connection can use it up; a client with more at a time sends them one after another."""

_LAST_BYTES_S = 0.5
"""For answers that are on their way when the last call has ended."""


class AddressTaken(Exception):
    """The address cannot be listened on; the message is for the operator."""


class GrpcServer:
    """Listens at once, says that it is starting until it is given an engine, and is drained in order.

    Attributes:
        address: "host:port".
    """

    def __init__(
        self,
        settings: Settings,
        store: Store,
        metrics: Metrics,
        *,
        authenticate: Authenticate | None = None,
        tracer: Tracer | None = None,
        credentials: grpc.ServerCredentials | None = None,
    ) -> None:
        """Binds its port.

        Raises:
            AddressTaken: another server has it, or it is not an address of ours.
        """
        self._metrics = metrics
        self._engine: Engine | None = None
        self._health = health.aio.HealthServicer()  # type: ignore[attr-defined]
        self._is_draining = False
        self._interceptor = CallInterceptor(
            settings.default_deadline_s,
            settings.max_deadline_s,
            authenticate=authenticate,
            check_door=self._check_door,
            observer=metrics,
            tracer=tracer,
        )
        self._server = grpc.aio.server(
            interceptors=[self._interceptor], options=_options(settings), maximum_concurrent_rpcs=MAX_CONCURRENT_RPCS
        )
        self._watchers = Watchers(settings.allow_watching, settings.max_message_mib * 2**20)
        self._references = ReferenceService(self._ready_engine, store)
        reference_service_pb2_grpc.add_ReferenceServiceServicer_to_server(self._references, self._server)
        localization_service_pb2_grpc.add_LocalizationServiceServicer_to_server(
            LocalizationService(self._ready_engine, metrics, store, self._watchers), self._server
        )
        health_pb2_grpc.add_HealthServicer_to_server(self._health, self._server)
        if settings.reflection:
            _enable_reflection(self._server, (*SERVICE_NAMES, health.SERVICE_NAME, reflection.SERVICE_NAME))
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        self.address = f"{host}:{self._bind(f'{host}:{settings.port}', credentials)}"

    def _bind(self, address: str, credentials: grpc.ServerCredentials | None) -> int:
        try:
            if credentials is None:
                return int(self._server.add_insecure_port(address))
            return int(self._server.add_secure_port(address, credentials))
        except RuntimeError as error:
            raise AddressTaken(f"cannot listen on {address}: in use, or not an address of ours") from error

    async def start(self) -> None:
        """Takes calls, and answers all but health and reflection with UNAVAILABLE."""
        await self.set_serving(False)
        await self._server.start()

    async def open(self, engine: Engine) -> None:
        """Serves with an engine that is warm."""
        self._engine = engine
        await self.set_serving(True)

    async def drain(self, delay_s: float, grace_s: float) -> None:
        """Says that it stops, and after a delay takes no new calls and gives the running ones a time to finish.

        Args:
            delay_s: for load balancers, which go on sending until they have looked at the health.
            grace_s: after which what runs is cut off.
        """
        await self.set_serving(False)
        if delay_s:
            await asyncio.sleep(delay_s)
        self._is_draining = True
        self._watchers.close()
        # Not by `stop`, which would wait for those who watch the health as well.
        await self._interceptor.wait_until_idle(grace_s)
        if self._engine is not None:
            self._engine.queue.drain()
        await self._server.stop(_LAST_BYTES_S)

    async def close(self) -> None:
        """Ends at once; returns when the store is not used any more."""
        await self._server.stop(0)
        await asyncio.to_thread(self._references.close)

    async def set_serving(self, is_serving: bool) -> None:
        """What health says from now on, of every service."""
        status = health_pb2.HealthCheckResponse
        for service in ("", *SERVICE_NAMES):
            await self._health.set(service, status.SERVING if is_serving else status.NOT_SERVING)
        self._metrics.set_serving(is_serving)

    def _check_door(self, method: str) -> None:
        """Raises Unavailable while the server starts or stops, and Overloaded while it has no room for any query."""
        if self._is_draining:
            raise Unavailable("the server is stopping", reason="DRAINING", retry_after_s=1.0)
        engine = self._ready_engine()
        if method in LOCALIZE_METHODS:
            engine.check_room()

    def _ready_engine(self) -> Engine:
        if self._engine is None:
            raise Unavailable("the server is starting", reason="STARTING", retry_after_s=1.0)
        return self._engine


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


def _options(settings: Settings) -> list[tuple[str, int]]:
    max_message_bytes = settings.max_message_mib * 2**20
    return [
        ("grpc.max_receive_message_length", max_message_bytes),
        ("grpc.max_send_message_length", max_message_bytes),
        # With reuseport, the default, a second server silently shares the port and takes half of the calls.
        ("grpc.so_reuseport", 0),
        ("grpc.max_concurrent_streams", MAX_CALLS_PER_CONNECTION),
        ("grpc.max_metadata_size", 16 * 1024),
        # Clients may ping every 30 s, but only while they have a call.
        ("grpc.http2.min_ping_interval_without_data_ms", 30_000),
        ("grpc.http2.max_ping_strikes", 2),
        ("grpc.keepalive_permit_without_calls", 0),
        # Notices clients that went away without a word, so that what they asked for is not computed.
        ("grpc.keepalive_time_ms", 60_000),
        ("grpc.keepalive_timeout_ms", 20_000),
        ("grpc.max_connection_idle_ms", 15 * 60_000),
        # Clients come back by another connection, and perhaps to another server that was added meanwhile.
        ("grpc.max_connection_age_ms", 30 * 60_000),
        ("grpc.max_connection_age_grace_ms", round(1000 * settings.max_deadline_s)),
    ]
