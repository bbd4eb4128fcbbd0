"""Options of a client's connection."""

import json
import re
import socket
from dataclasses import dataclass, field
from typing import Any

import grpc
import grpc.aio

from .errors import REFUSED, DeadlineExceeded, MaplessError, Unavailable, from_rpc_error

TOKEN_KEY = "authorization"
CLIENT_ID_KEY = "x-client-id"
_TOKEN = re.compile(r"[!-~]{1,4096}", re.ASCII)
_FIRST_RECONNECT_MS = 200
_TIMES = ("timeout_s", "upload_timeout_s", "max_reconnect_s", "keepalive_s", "keepalive_timeout_s")
_CLIENT_ID = re.compile(r"[A-Za-z0-9_.-]{1,64}", re.ASCII)  # it enters the server's log
_SCHEMES = ("dns", "ipv4", "ipv6", "unix", "unix-abstract", "vsock", "xds")
"""Of grpc's own forms of an address."""


def _checked(address: str) -> str:
    """The address; ValueError if it is a URL."""
    scheme, colon, rest = address.partition(":")
    if colon and scheme in _SCHEMES:
        return address
    host = (rest if rest.startswith("//") else address).strip("/").partition("/")[0]
    if address != host or not host:
        tls = ", and encrypt with --tls (Python: tls)" if scheme in ("https", "grpcs") else ""
        example = host or "localhost:50051"
        raise ValueError(f"an address is host:port, without scheme and path: {example}{tls}, is {address!a}")
    port = re.search(r":(\d+)$", host)
    if port is not None and not 0 < int(port[1]) < 65536:
        raise ValueError(f"the port of an address must be 1 to 65535, is {port[1]}")
    return address


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
        max_attempts: attempts of a call while the server is UNAVAILABLE; 1 for no retries at all. A server that sends
            RetryInfo, because it starts or is at its limit, is retried until the call's deadline.
        initial_backoff_s, max_backoff_s: pause before the second attempt, doubled for each further one up to the
            maximum; longer if the server's RetryInfo requests it.
        max_reconnect_s: longest pause between attempts to reconnect to a lost server; gRPC's own is two minutes.
        keepalive_s: idle time after which a connection in use is probed; servers refuse less than 30.
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
        for name in (*_TIMES, "batch_mib", "initial_backoff_s"):
            if not (value := getattr(self, name)) > 0:
                raise ValueError(f"{name} must be above 0, is {value:g}")
        for name in ("max_message_mib", "batch_count", "max_attempts"):
            if not (value := getattr(self, name)) >= 1:
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
        """A channel to "host:port"; it does not connect yet. ValueError for a URL or an address without a host.

        `host` is the name for which the server has its certificate, if it is not that of the address.
        """
        options = self.channel_options()
        if host:
            options.append(("grpc.ssl_target_name_override", host))
        channel: grpc.Channel = self._made(grpc, address, options)
        return channel

    def aio_channel(self, address: str) -> grpc.aio.Channel:
        """An asynchronous channel of the running event loop; otherwise as `channel`."""
        channel: grpc.aio.Channel = self._made(grpc.aio, address, self.channel_options())
        return channel

    def _made(self, library: Any, address: str, options: list[tuple[str, int | str]]) -> Any:
        address = _checked(address)
        if not self.tls:
            return library.insecure_channel(address, options=options)
        certificates = self.root_certificates, self.client_key, self.client_certificate
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
        # Several servers behind one name share the calls; a lost server is skipped.
        config: dict[str, Any] = {"loadBalancingConfig": [{"round_robin": {}}]}
        return [
            ("grpc.max_send_message_length", max_message_bytes),
            ("grpc.max_receive_message_length", max_message_bytes),
            ("grpc.initial_reconnect_backoff_ms", min(_FIRST_RECONNECT_MS, max_reconnect_ms)),
            ("grpc.max_reconnect_backoff_ms", max_reconnect_ms),
            ("grpc.use_local_subchannel_pool", 1),  # servers share their time among connections
            ("grpc.keepalive_time_ms", round(1000 * self.keepalive_s)),
            ("grpc.keepalive_timeout_ms", round(1000 * self.keepalive_timeout_s)),
            # gRPC itself repeats only calls that never reached a server, and only if they fit into this buffer, by
            # default 256 KiB, which is too small for a photograph.
            ("grpc.per_rpc_retry_buffer_size", max_message_bytes),
            ("grpc.service_config", json.dumps(config)),
        ]


_UNREACHED = re.compile(
    f"{REFUSED}|Cannot assign requested address|Network is unreachable|No route to host|Address family not supported"
)
"""In errors of an address at which no server was reached, as IPv6's in a container without IPv6."""
_DEFAULT_PORT = "443"  # gRPC's
_CONNECT_LIMIT_S = 2.0
_ANSWER_LIMIT_S = 10.0  # a server with much to do, or a busy machine, may need seconds for a handshake


def host_and_port(address: str) -> tuple[str, int]:
    """Splits "host:port"; the host is empty for gRPC's other forms of an address."""
    host, colon, port = address.rpartition(":")
    if not colon or (":" in host and not host.startswith("[")):
        host, port = address, _DEFAULT_PORT
    is_plain = "/" not in address and not address.startswith(tuple(f"{scheme}:" for scheme in _SCHEMES))
    return (host.strip("[]"), int(port)) if is_plain and port.isdecimal() else ("", 0)


def connection_fault(family: int, endpoint: tuple[Any, ...]) -> OSError | None:
    """Why no connection can be made to an endpoint of `socket.getaddrinfo`; None if one can."""
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.settimeout(_CONNECT_LIMIT_S)
            probe.connect(endpoint)
    except OSError as error:
        return error
    return None


def is_unreached(error: MaplessError) -> bool:
    """Whether the error says that no server was reached at an address; `explained` may then find a better reason."""
    return error.message.startswith("cannot connect") and _UNREACHED.search(error.message) is not None


def explained(error: MaplessError, address: str, options: ConnectOptions) -> MaplessError:
    """Returns the error, or that of another address of the same host name if it explains more.

    Connects to the other addresses, which takes milliseconds. An address that does not answer takes 2 seconds; one that
    accepts connections and sends nothing, 10 seconds, or the options' timeout if that is less.
    """
    host, port = host_and_port(address)
    if not host[:1].isalpha() or not is_unreached(error):  # an IP address is the only one
        return error
    try:
        found = {it[4][0]: it for it in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
    except OSError:
        return error
    refused = error if REFUSED in error.message else None
    for ip, (family, *_, endpoint) in found.items():
        one = f"[{ip}]:{port}" if family == socket.AF_INET6 else f"{ip}:{port}"
        if f" {one}: " in error.message:
            continue
        fault = connection_fault(family, endpoint)
        if isinstance(fault, ConnectionRefusedError):
            refused = refused or Unavailable("UNAVAILABLE", f"cannot connect to {one}: {REFUSED} (connection refused)")
        if fault is not None:
            continue
        other = _failure(one, host, options)
        if other is not None and other.message.startswith("cannot connect") and not is_unreached(other):
            return other
    return refused or error


def _failure(address: str, host: str, options: ConnectOptions) -> MaplessError | None:
    limit_s = min(options.timeout_s, _ANSWER_LIMIT_S)
    with options.channel(address, host) as channel:
        try:
            channel.unary_unary("/grpc.health.v1.Health/Check")(b"", timeout=limit_s)
        except grpc.RpcError as error:
            failure = from_rpc_error(error)
            if not isinstance(failure, DeadlineExceeded):
                return failure
            text = f"cannot connect to {address}: a connection is accepted, but nothing answers within {limit_s:g} s"
            return Unavailable("UNAVAILABLE", text)
    return None
