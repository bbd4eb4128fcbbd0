"""The gateway's process: from options to a server that listens, and its end."""

import asyncio
import math
import socket
import sys
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import uvicorn
from starlette.types import ASGIApp
from uvicorn.protocols.http.auto import AutoHTTPProtocol

from mapless import Client, ConnectOptions, Unauthenticated
from mapless.pem import without_marks
from mapless_server.rpc.descriptors import raise_limit
from mapless_server.security import is_loopback

from .app import GatewayOptions, gateway
from .client import ServerClient
from .rpc import rpc_application

_GRACE_S = 10
REQUEST_LIMIT_S = 15.0
"""For a TLS handshake, and then for the head of a request; the guard limits the time of its body."""


class _EndingIdle(AutoHTTPProtocol):  # type: ignore[misc,valid-type]
    """Ends a connection whose next request does not arrive: uvicorn would wait for its first for ever.

    It ends between one and two limits after its last request; one with a request that is being answered does not end.
    """

    _ends: asyncio.TimerHandle | None = None
    _last: Any = None

    def connection_made(self, transport: Any) -> None:
        """Extends the library's."""
        super().connection_made(transport)
        self._ends = self.loop.call_later(REQUEST_LIMIT_S, self._end_unless_busy)

    def connection_lost(self, exc: Exception | None) -> None:
        """Extends the library's."""
        if self._ends is not None:
            self._ends.cancel()
        super().connection_lost(exc)

    def _end_unless_busy(self) -> None:
        is_new, self._last = self.cycle is not self._last, self.cycle
        if self.cycle is None or (self.cycle.response_complete and not is_new):
            self.transport.close()
        else:
            self._ends = self.loop.call_later(REQUEST_LIMIT_S, self._end_unless_busy)


class _Server(uvicorn.Server):
    """Limits the time of TLS handshakes, too, which asyncio gives a minute and uvicorn leaves as it is."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Extends the library's."""
        loop: Any = asyncio.get_running_loop()
        if self.config.is_ssl:
            loop.create_server = partial(loop.create_server, ssl_handshake_timeout=REQUEST_LIMIT_S)
        await super().startup(sockets)


@dataclass(frozen=True)
class Binding:
    """Where to listen; port 0 for any free one, and no certificate (PEM, with its key) for no TLS.

    `insecure` allows to listen beyond this machine without TLS, or to a server without tokens.
    """

    host: str
    port: int
    certificate: Path | None = None
    key: Path | None = None
    insecure: bool = False

    def __post_init__(self) -> None:
        if (self.certificate is None) != (self.key is None):
            raise ValueError("--tls-certificate and --tls-key go together")
        for file in (self.certificate, self.key):
            if file is not None and not file.is_file():
                raise ValueError(f"{file} is no file")
            if file is not None and without_marks(data := file.read_bytes()) != data:
                raise ValueError(f"{file} has a byte order mark or is UTF-16: save it as ASCII")
        if self.certificate is None and not self.insecure and not self.is_loopback:
            raise ValueError(
                f"on {self.host} photographs and tokens would pass in clear: give --tls-certificate and --tls-key, "
                "listen on 127.0.0.1, or give --insecure if something in front encrypts"
            )

    @property
    def is_loopback(self) -> bool:
        """Whether only this machine can connect."""
        return is_loopback(self.host)


def run(server: str, connect: ConnectOptions, options: GatewayOptions, binding: Binding) -> None:
    """Serves until a signal ends it.

    ValueError if the server needs no token, and `insecure` is not set; MaplessError if it cannot be reached to find
    that out; OSError if the port is taken.
    """
    if not (binding.is_loopback or binding.insecure):
        _check_tokens(server, replace(connect, token=None))
    if connect.token is not None and not binding.is_loopback:
        print(
            "note: everybody who can reach this gateway localizes with the rights of the token that it was given; "
            "give it one of the role localize",
            file=sys.stderr,
        )
    raise_limit()
    # Its callers have the limit of time; the server may start after it.
    connect = replace(connect, connect_timeout_s=math.inf)
    rpc = rpc_application(lambda: ServerClient(server, connect), options.guard.max_body_bytes)
    application = gateway(lambda: ServerClient(server, connect), options, rpc)
    host, is_v6 = binding.host, ":" in binding.host
    family = socket.AF_INET6 if is_v6 else socket.AF_INET
    with socket.create_server((host, binding.port), family=family, backlog=128) as listening:
        scheme = "http" if binding.certificate is None else "https"
        name = f"[{host}]" if is_v6 else host
        # Read by programs that take any port: keep its form.
        print(f"mapless-server gateway is on {scheme}://{name}:{listening.getsockname()[1]}", flush=True)
        http_server(application, binding).run([listening])


def http_server(application: ASGIApp, binding: Binding) -> uvicorn.Server:
    """The server of an application, which ends connections that make no request; `run` takes the listening socket."""
    config = uvicorn.Config(
        application,
        http=_EndingIdle,
        log_level="warning",
        server_header=False,
        timeout_graceful_shutdown=_GRACE_S,
        ssl_certfile=binding.certificate,
        ssl_keyfile=binding.key,
    )
    return _Server(config)


def _check_tokens(server: str, connect: ConnectOptions) -> None:
    with Client(server, connect) as client:
        try:
            next(iter(client.list_scenes()), None)
        except Unauthenticated:
            return
    raise ValueError(
        "the server requires no tokens: through this gateway everybody who can reach it could read and delete all "
        "scenes; give the server tokens_file, or give --insecure if something in front restricts access"
    )
