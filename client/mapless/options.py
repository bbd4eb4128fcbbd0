"""Options of a client's connection."""

import json
import math
import re
from dataclasses import dataclass, field
from typing import Any

import grpc
import grpc.aio

from .addresses import addresses_of
from .pem import without_marks
from .proxies import is_exempt

TOKEN_KEY = "authorization"
CLIENT_ID_KEY = "x-client-id"
_TOKEN = re.compile(r"[!-~]{1,4096}", re.ASCII)
_FIRST_RECONNECT_MS = 200
_TIMES = ("timeout_s", "upload_timeout_s", "connect_timeout_s", "max_reconnect_s", "keepalive_s", "keepalive_timeout_s")
_MAX_CONNECT_S = 20.0
"""Longest attempt to connect, by gRPC's own limit."""
_CLIENT_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}", re.ASCII)  # it enters the server's log


@dataclass(frozen=True)
class ConnectOptions:
    """Options of a connection.

    Attributes:
        timeout_s: default deadline of a call, with its retries. There is always one: without it, a lost server would
            block the caller for ever.
        upload_timeout_s: the same for one message of a bulk upload, which returns when all features are computed.
        max_message_mib: largest message sent or received; the server's own limit (32 by default) holds too.
        batch_mib: largest message of a bulk upload, approximately; at most the server's limit. Receiving a large
            message delays the server's other callers.
        batch_count: largest number of references in such a message, so that progress is visible.
        connect_timeout_s: time in which the first connection must be made. Until a server has been reached once, a call
            that finds none, or one that accepts connections and is silent, fails after it; later, calls outlive the
            server's absence until their deadline. By default the first one does so, too. Each attempt to connect ends
            after this time, too, and after 20 s at most.
        max_attempts: attempts of a call while the server is away, UNAVAILABLE or lost during the answer; 1 for no
            retries at all; None for as many as the call's deadline permits. A server that sends RetryInfo, because it
            starts or is at its limit, is retried until the deadline unless this is 1.
        initial_backoff_s, max_backoff_s: pause before the second attempt, doubled for each further one up to the
            maximum; longer if the server's RetryInfo requests it.
        max_reconnect_s: longest pause between attempts to reconnect to a lost server, whose name is then resolved
            again; gRPC's own is two minutes. Where there are several servers, one that was lost is passed over so long.
        keepalive_s: idle time after which a connection in use is probed; servers of mapless accept 10 and more.
        keepalive_timeout_s: time without acknowledgement after which a connection counts as lost, for example because
            a robot has left the network. Its calls are UNAVAILABLE and retried over another connection.
        tls: whether to encrypt the connection and to verify the server's certificate.
        root_certificates: PEM bytes to verify it with; None for the system's.
        client_certificate, client_key: PEM bytes, for servers that require a client certificate; with tls only.
        token: sent with every call; without tls in clear text.
        client_id: identifies this user among those of the token, 1 to 64 of A-Z a-z 0-9 _ . -; the server treats
            them fairly and logs the id.
    """

    timeout_s: float = 30.0
    upload_timeout_s: float = 300.0
    max_message_mib: int = 64
    batch_mib: float = 8.0
    batch_count: int = 32
    connect_timeout_s: float = math.inf
    max_attempts: int | None = None
    initial_backoff_s: float = 0.2
    max_backoff_s: float = 2.0
    max_reconnect_s: float = 2.0
    keepalive_s: float = 60.0
    keepalive_timeout_s: float = 10.0
    tls: bool = False
    root_certificates: bytes | None = None
    client_certificate: bytes | None = None
    client_key: bytes | None = field(default=None, repr=False)
    token: str | None = field(default=None, repr=False)
    client_id: str = ""

    def __post_init__(self) -> None:
        for name in (*_TIMES, "batch_mib", "initial_backoff_s"):
            if not (value := getattr(self, name)) > 0:
                raise ValueError(f"{name} must be above 0, is {value:g}")
        for name in ("max_message_mib", "batch_count", "max_attempts"):
            value = getattr(self, name)
            if value is not None and not value >= 1:
                raise ValueError(f"{name} must be at least 1, is {value:g}")
        for name, limit in (("batch_mib", "max_message_mib"), ("initial_backoff_s", "max_backoff_s")):
            value, maximum = getattr(self, name), getattr(self, limit)
            if not value <= maximum:
                raise ValueError(f"{name} must be at most {limit} ({maximum:g}), is {value:g}")
        if (self.client_certificate is None) != (self.client_key is None):
            raise ValueError("client_certificate and client_key must go together")
        if self.client_certificate is not None and not self.tls:
            raise ValueError("client_certificate needs tls")
        if self.token is not None and not _TOKEN.fullmatch(self.token):
            raise ValueError("token must be visible ASCII characters, without spaces or line breaks")
        if self.client_id and not _CLIENT_ID.fullmatch(self.client_id):
            raise ValueError(f"client_id must be 1 to 64 characters of A-Z a-z 0-9 _ . -, is {self.client_id!a}")

    def channel(self, address: str, host: str = "") -> grpc.Channel:
        """A channel to "host:port", or an address of gRPC's own; it does not connect yet. ValueError for another.

        `host` is the name for which the server has its certificate, if it is not that of the address.
        """
        channel: grpc.Channel = self._made(grpc, address, [("grpc.ssl_target_name_override", host)] if host else [])
        return channel

    def aio_channel(self, address: str) -> grpc.aio.Channel:
        """An asynchronous channel of the running event loop; otherwise as `channel`."""
        channel: grpc.aio.Channel = self._made(grpc.aio, address, [])
        return channel

    def _made(self, library: Any, address: str, more: list[tuple[str, int | str]]) -> Any:
        if len(addresses_of(address)) > 1:
            raise ValueError(f"a channel has one address, not {address!a}")
        options = [*self.channel_options(), ("grpc.enable_http_proxy", int(not is_exempt(address))), *more]
        if not self.tls:
            return library.insecure_channel(address, options=options)
        files = self.root_certificates, self.client_key, self.client_certificate
        certificates = [None if it is None else without_marks(it) for it in files]
        return library.secure_channel(address, grpc.ssl_channel_credentials(*certificates), options=options)

    def metadata(self) -> tuple[tuple[str, str], ...]:
        """Metadata of every call; not as call credentials, which grpc sends on encrypted channels only."""
        token = ((TOKEN_KEY, f"Bearer {self.token}"),) if self.token is not None else ()
        client_id = ((CLIENT_ID_KEY, self.client_id),) if self.client_id else ()
        return token + client_id

    def channel_options(self) -> list[tuple[str, int | str]]:
        """The options in grpc's form."""
        max_message_bytes = self.max_message_mib * 2**20
        max_reconnect_ms = round(1000 * self.max_reconnect_s)
        connect_ms = round(1000 * min(self.connect_timeout_s, _MAX_CONNECT_S))
        # Several servers behind one name share the calls; a lost server is skipped.
        config: dict[str, Any] = {"loadBalancingConfig": [{"round_robin": {}}]}
        return [
            ("grpc.max_send_message_length", max_message_bytes),
            ("grpc.max_receive_message_length", max_message_bytes),
            ("grpc.initial_reconnect_backoff_ms", min(_FIRST_RECONNECT_MS, max_reconnect_ms)),
            ("grpc.max_reconnect_backoff_ms", max_reconnect_ms),
            ("grpc.min_reconnect_backoff_ms", max(connect_ms, 1)),  # after which gRPC gives up an attempt to connect
            # A server that was moved has another address; by default gRPC asks for it every 30 s.
            ("grpc.dns_min_time_between_resolutions_ms", max_reconnect_ms),
            ("grpc.use_local_subchannel_pool", 1),  # servers share their time among connections
            ("grpc.keepalive_time_ms", round(1000 * self.keepalive_s)),
            ("grpc.keepalive_timeout_ms", round(1000 * self.keepalive_timeout_s)),
            # gRPC itself repeats only calls that never reached a server's handlers, and only if they fit into this
            # buffer, by default 256 KiB, which is too small for a photograph.
            ("grpc.per_rpc_retry_buffer_size", max_message_bytes),
            ("grpc.service_config", json.dumps(config)),
        ]
