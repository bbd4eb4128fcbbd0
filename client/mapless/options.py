"""How a client connects."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from typing import Any

import grpc
import grpc.aio

TOKEN_KEY = "authorization"
CLIENT_ID_KEY = "x-client-id"
_TOKEN = re.compile(r"[!-~]{1,4096}", re.ASCII)
_FIRST_RECONNECT_MS = 200
_CLIENT_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}", re.ASCII)  # it enters the server's log


@dataclass(frozen=True)
class ConnectOptions:
    """Options of a connection.

    Attributes:
        timeout_s: for a call that is given none of its own. Every call has a deadline, retries included: without one a
            lost server would block the caller for ever.
        upload_timeout_s: the same for one message of a bulk upload; it returns when its photographs are described.
        max_message_mib: largest message that is sent or received; the server's own limit (32 by default) holds too.
        batch_mib: a bulk upload sends messages of about this size at most; must fit the server's limit. Large ones take
            the server longer to receive, which its other callers feel.
        batch_count: and of so many references at most, so that progress shows.
        max_attempts: tries of a call that finds the server UNAVAILABLE; 1: nothing is ever tried again. A server that
            says when to come back, because it starts or is at its limit, is asked again until the call's deadline.
        initial_backoff_s, max_backoff_s: pause before the second try, doubled for each further one up to the maximum; a
            longer one if the server asks for it.
        max_reconnect_s: a server that went away is looked for again at least so often, where gRPC would leave up to two
            minutes between two looks.
        keepalive_s: a connection in use is probed after so much silence; servers refuse less than 30.
        keepalive_timeout_s: a connection is given up whose probe, or whose data, was not acknowledged for so long: a
            network that a robot has left behind. Calls on it are UNAVAILABLE, and tried again over another.
        tls: whether to encrypt, and to check the server's certificate.
        root_certificates: PEM bytes to check it with; None for the system's.
        client_certificate, client_key: PEM bytes, for servers that ask clients for a certificate; with tls only.
        token: shown to the server with every call. Without tls it travels in clear.
        client_id: which of the token's users this is, 1 to 64 of A-Z a-z 0-9 _ . -; the server is fair between them,
            and its log names them.
    """

    timeout_s: float = 30.0
    upload_timeout_s: float = 300.0
    max_message_mib: int = 64
    batch_mib: float = 8.0
    batch_count: int = 32
    max_attempts: int = 4
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
        times_s = (
            self.timeout_s,
            self.upload_timeout_s,
            self.max_reconnect_s,
            self.keepalive_s,
            self.keepalive_timeout_s,
        )
        if not all(time_s > 0 for time_s in times_s):
            raise ValueError("times must be above 0")
        if not (self.max_message_mib >= 1 and 0 < self.batch_mib <= self.max_message_mib and self.batch_count >= 1):
            raise ValueError("batch_mib must be above 0 and at most max_message_mib, counts at least 1")
        if not (self.max_attempts >= 1 and 0 < self.initial_backoff_s <= self.max_backoff_s):
            raise ValueError("max_attempts must be at least 1 and initial_backoff_s above 0 and at most max_backoff_s")
        if (self.client_certificate is None) != (self.client_key is None):
            raise ValueError("client_certificate and client_key go together")
        if self.client_certificate is not None and not self.tls:
            raise ValueError("client_certificate needs tls")
        if self.token is not None and not _TOKEN.fullmatch(self.token):
            raise ValueError("token must be visible ASCII characters, without spaces or line breaks")
        if self.client_id and not _CLIENT_ID.fullmatch(self.client_id):
            raise ValueError(f"client_id must be 1 to 64 characters of A-Z a-z 0-9 _ . -, is {self.client_id!a}")

    def channel(self, address: str) -> grpc.Channel:
        """A channel to "host:port"; it does not connect yet."""
        credentials, options = self._credentials(), self.channel_options()
        channel: grpc.Channel = (
            grpc.secure_channel(address, credentials, options=options)
            if credentials is not None
            else grpc.insecure_channel(address, options=options)
        )
        return channel

    def aio_channel(self, address: str) -> grpc.aio.Channel:
        """The same for the running event loop."""
        credentials, options = self._credentials(), self.channel_options()
        if credentials is not None:
            return grpc.aio.secure_channel(address, credentials, options=options)
        return grpc.aio.insecure_channel(address, options=options)

    def _credentials(self) -> grpc.ChannelCredentials | None:
        if not self.tls:
            return None
        credentials: grpc.ChannelCredentials = grpc.ssl_channel_credentials(
            self.root_certificates, self.client_key, self.client_certificate
        )
        return credentials

    def metadata(self) -> tuple[tuple[str, str], ...]:
        """What every call carries. Not call credentials, which grpc sends on encrypted channels only."""
        token = ((TOKEN_KEY, f"Bearer {self.token}"),) if self.token is not None else ()
        client_id = ((CLIENT_ID_KEY, self.client_id),) if self.client_id else ()
        return token + client_id

    def channel_options(self) -> list[tuple[str, int | str]]:
        """The options as grpc takes them."""
        max_message_bytes = self.max_message_mib * 2**20
        max_reconnect_ms = round(1000 * self.max_reconnect_s)
        # Of several servers behind one name each gets its share, and one that goes away is left out.
        config: dict[str, Any] = {"loadBalancingConfig": [{"round_robin": {}}]}
        return [
            ("grpc.max_send_message_length", max_message_bytes),
            ("grpc.max_receive_message_length", max_message_bytes),
            ("grpc.initial_reconnect_backoff_ms", min(_FIRST_RECONNECT_MS, max_reconnect_ms)),
            ("grpc.max_reconnect_backoff_ms", max_reconnect_ms),
            ("grpc.keepalive_time_ms", round(1000 * self.keepalive_s)),
            ("grpc.keepalive_timeout_ms", round(1000 * self.keepalive_timeout_s)),
            # gRPC itself repeats only what surely never came to a server, and that only if it fits into this buffer,
            # 256 KiB unless set: no photograph would.
            ("grpc.per_rpc_retry_buffer_size", max_message_bytes),
            ("grpc.service_config", json.dumps(config)),
        ]
