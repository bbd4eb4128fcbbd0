"""mapless's own handlers on the gRPC server that Serve opens in every replica.

In Serve's HAProxy mode (RAY_SERVE_ENABLE_HA_PROXY=1) a call goes from the load balancer directly to a gRPC server in
the replica's process. Serve would read the request there, call a method of the deployment, and turn exceptions into
statuses, which loses the caller's deadline, the time limit of its message, rich error details and grpc.health.v1. So
mapless's own handlers are registered, and a caller sees no difference from a plain server.
"""

import asyncio
from collections.abc import Callable, Coroutine
from typing import Any, Protocol

import grpc
from grpc_health.v1 import health_pb2
from grpc_status import rpc_status

from mapless.v1 import localization_service_pb2, reference_service_pb2
from mapless_server.errors import Unavailable
from mapless_server.rpc import to_status
from mapless_server.serve.startup import StartupError
from mapless_server.services.handlers import Services
from mapless_server.settings import Settings

Stop = Callable[["float | None"], Coroutine[Any, Any, None]]

_HEALTH = health_pb2.DESCRIPTOR.services_by_name["Health"]
_SERVICES = (
    localization_service_pb2.DESCRIPTOR.services_by_name["LocalizationService"],
    reference_service_pb2.DESCRIPTOR.services_by_name["ReferenceService"],
    _HEALTH,
)


class ServeServer(Protocol):
    """The methods in use of Serve's gRPC server, a grpc.aio.Server."""

    async def stop(self, grace: float | None) -> None:
        """Serve calls this when HAProxy has removed the replica; running calls get `grace` seconds."""

    def add_passthrough_service(self, service_name: str) -> None:
        """Keeps Serve from replacing the service's handlers, which are added after this."""

    def add_generic_rpc_handlers(self, handlers: Any) -> None:
        """Registers handlers, as a grpc.aio.Server does."""


_LAST_BYTES_S = 5.0
"""Time for answers in transit when the last call has ended; long, since other replicas serve meanwhile."""


class Ingress:
    """Receives the calls of a replica; one a process. Implements `mapless_server.serve.listening.Listener`.

    The address is unknown, since Serve chooses and opens the port when the replica is ready.
    """

    address = "ray"
    current: "Ingress | None" = None

    def __init__(self, settings: Settings, services: Services, credentials: grpc.ServerCredentials | None) -> None:
        if credentials is not None:
            raise StartupError(
                "Serve's gRPC server has no TLS: unset tls_certificate, and terminate TLS at the gateway"
            )
        self.services = services
        self.loop = asyncio.get_running_loop()

    async def start(self) -> None:
        """Serve opens its server when the replica's constructor has returned."""
        Ingress.current = self

    async def stop(self) -> None:
        """Serve stops its server before it ends the replica."""

    def drained(self, stop: Stop) -> Stop:
        """Wraps a server's `stop` so that it drains the services first, because endless streams would delay it."""

        async def drain_and_stop(grace_s: float | None) -> None:
            await self.services.drain(0.0, grace_s or 0.0)
            await stop(_LAST_BYTES_S)

        return drain_and_stop

    async def close(self) -> None:
        """Does nothing: there is nothing to close."""
        Ingress.current = None


def add_services(_: object, server: ServeServer) -> None:
    """Adds the services to a gRPC server. Serve's config names it, and Serve calls it in each server's event loop."""
    ingress = Ingress.current
    if ingress is None:
        _add_refusals(server)
        return
    if asyncio.get_running_loop() is not ingress.loop:
        raise AssertionError("the replica runs in another event loop than its gRPC server: see `environment`")
    for service in ingress.services.handlers:
        server.add_passthrough_service(service)
    ingress.services.add_to(server)
    server.stop = ingress.drained(server.stop)  # type: ignore[assignment,method-assign]


def _add_refusals(server: ServeServer) -> None:
    """Adds handlers for Serve's proxies, which receive calls when no replica is ready: UNAVAILABLE, NOT_SERVING."""
    error = Unavailable("no replica is ready", reason="STARTING", retry_after_s=1.0)
    status = rpc_status.to_status(to_status(error))

    async def refuse(_: object, context: Any) -> None:
        await context.abort(status.code, status.details, status.trailing_metadata)

    async def is_healthy(_: bytes, __: object) -> bytes:
        response = health_pb2.HealthCheckResponse
        return bytes(response(status=response.NOT_SERVING).SerializeToString())

    for service in _SERVICES:
        server.add_passthrough_service(service.full_name)
        answers = {method.name: grpc.stream_unary_rpc_method_handler(refuse) for method in service.methods}
        if service is _HEALTH:
            answers["Check"] = grpc.unary_unary_rpc_method_handler(is_healthy)
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service.full_name, answers),))
