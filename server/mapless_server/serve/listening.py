"""Receives the calls of a running server: gRPC at its address, whose limits are set here."""

from __future__ import annotations

import errno
import socket
from collections.abc import Callable
from typing import Protocol

import grpc

from mapless_server.rpc.descriptors import handshake_s, most_connections
from mapless_server.services.handlers import Services
from mapless_server.settings import Settings

MAX_CONCURRENT_RPCS = 2048
"""Calls at a time, of all connections. Far above what the queue admits: health probes count, and calls of which only
the headers have come, whose time `rpc.receiving` limits."""
MAX_CALLS_PER_CONNECTION = 128
"""Far below that, so that one connection cannot take all; a client sends further calls as earlier ones end."""

_MOST_OF_GRPC = 2**31 - 1

_LAST_BYTES_S = 0.5
"""Time for answers in transit when the last call has ended."""


class Listener(Protocol):
    """Receives the calls of the services; bound to its address, "host:port", when it is made."""

    address: str

    async def start(self) -> None:
        """Accepts calls."""

    async def stop(self) -> None:
        """Stops accepting calls; all calls are answered, but the last bytes may still be in transit."""

    async def close(self) -> None:
        """Ends immediately; may be called after `stop`."""


Listen = Callable[[Settings, Services, grpc.ServerCredentials | None], Listener]


class AddressTaken(Exception):
    """The address cannot be listened on; the message is for the operator."""


class GrpcServer:
    """Receives the calls of the services at its address, "host:port"."""

    def __init__(
        self, settings: Settings, services: Services, credentials: grpc.ServerCredentials | None = None
    ) -> None:
        """Binds its port; AddressTaken if another server uses the address, or it is not an address of this machine."""
        self._server = grpc.aio.server(options=_options(settings), maximum_concurrent_rpcs=MAX_CONCURRENT_RPCS)
        services.add_to(self._server)
        host = f"[{settings.host}]" if ":" in settings.host else settings.host
        self.address = f"{host}:{self._bind(f'{host}:{settings.port}', credentials)}"

    def _bind(self, address: str, credentials: grpc.ServerCredentials | None) -> int:
        try:
            if credentials is None:
                return int(self._server.add_insecure_port(address))
            return int(self._server.add_secure_port(address, credentials))
        except RuntimeError as error:
            raise AddressTaken(f"cannot listen on {address}: {_why_not(address, credentials)}") from error

    async def start(self) -> None:
        """Accepts calls."""
        await self._server.start()

    async def stop(self) -> None:
        """Stops accepting calls; answers that are being sent get a moment."""
        await self._server.stop(_LAST_BYTES_S)

    async def close(self) -> None:
        """Ends immediately."""
        await self._server.stop(0)


def _why_not(address: str, credentials: grpc.ServerCredentials | None) -> str:
    """Why gRPC cannot listen on an address, which it says in its own log only: the address is tried once more."""
    host, _, port = address.rpartition(":")
    try:
        found = socket.getaddrinfo(host.strip("[]"), int(port), type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE)
    except OSError:
        return f"the name {host} cannot be resolved"
    for family, *_, endpoint in found:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            try:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(endpoint)
                probe.listen(1)
            except OSError as error:
                if error.errno == errno.EADDRINUSE:
                    return "in use by another program"
                if error.errno == errno.EADDRNOTAVAIL:
                    return "not an address of this machine"
                return error.strerror or str(error)
    return (
        "gRPC refuses it" if credentials is None else "the address is free; gRPC cannot use the certificate or its key"
    )


def _options(settings: Settings) -> list[tuple[str, int]]:
    max_message_bytes = settings.max_message_mib * 2**20
    return [
        ("grpc.max_receive_message_length", max_message_bytes),
        ("grpc.max_send_message_length", max_message_bytes),
        # Without them a connection that never becomes ready for calls would last for two minutes.
        ("grpc.server_handshake_timeout_ms", round(1000 * handshake_s())),
        ("grpc.max_allowed_incoming_connections", min(most_connections(), _MOST_OF_GRPC)),
        # With reuseport, the default, a second server shares the port silently and gets half of the calls.
        ("grpc.so_reuseport", 0),
        ("grpc.max_concurrent_streams", MAX_CALLS_PER_CONNECTION),
        ("grpc.max_metadata_size", 16 * 1024),
        # Clients may ping every 10 s, the least that gRPC's own allow, with a call or without; a ping may be early.
        ("grpc.http2.min_ping_interval_without_data_ms", 5_000),
        ("grpc.http2.max_ping_strikes", 2),
        ("grpc.keepalive_permit_without_calls", 1),
        # Detects clients that vanished, so that their queries are not computed, and their connections end.
        ("grpc.keepalive_time_ms", 60_000),
        ("grpc.keepalive_timeout_ms", 20_000),
        ("grpc.max_connection_idle_ms", 15 * 60_000),
        # Clients connect again, perhaps to a server that was added meanwhile.
        ("grpc.max_connection_age_ms", 30 * 60_000),
        ("grpc.max_connection_age_grace_ms", round(1000 * settings.max_deadline_s)),
    ]
