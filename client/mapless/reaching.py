"""Why a server is not reached: what gRPC's error hides is found by connecting once more."""

import re
import socket
import ssl
from typing import Any

import grpc

from .addresses import host_and_port
from .errors import REFUSED, USES_TLS, DeadlineExceeded, MaplessError, Unavailable, from_rpc_error, is_unconnected
from .options import ConnectOptions
from .proxies import proxy_of

_UNREACHED = re.compile(
    f"{REFUSED}|Cannot assign requested address|Network is unreachable|No route to host|Address family not supported"
)
"""In errors of an address at which no server was reached, as IPv6's in a container without IPv6."""
_CONNECT_LIMIT_S = 2.0  # also to shake hands
_ANSWER_LIMIT_S = 10.0  # a server with much to do, or a busy machine, may need seconds for a handshake


def connection_fault(family: int, endpoint: tuple[Any, ...]) -> OSError | None:
    """Why no connection can be made to an endpoint of `socket.getaddrinfo`; None if one can."""
    try:
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.settimeout(_CONNECT_LIMIT_S)
            probe.connect(endpoint)
    except OSError as error:
        return error
    return None


def explained(error: MaplessError, address: str, options: ConnectOptions) -> MaplessError:
    """Returns the error of a call, or one that says more about why no connection is made.

    That is which proxy was used, that the server uses TLS, or what is wrong at another address of the same host name.
    Connects again where that helps, which takes milliseconds. An address that does not answer takes 2 seconds; one that
    accepts connections and sends nothing, 10 seconds, or the options' timeout if that is less.
    """
    if not is_unconnected(error):
        return error
    if proxy := proxy_of(address):
        _, _, reason = error.message.partition(": ")
        reason = reason.replace(REFUSED, "no proxy listens there")
        return Unavailable("UNAVAILABLE", f"cannot connect to {address} through {proxy}: {reason}")
    found = _of_another_address(error, address, options)
    where = found.message.partition(": ")[0].removeprefix("cannot connect").removeprefix(" to ") or address
    if "closes the connection at once" in found.message and not options.tls and speaks_tls(where):
        return Unavailable("UNAVAILABLE", f"cannot connect to {where}: {USES_TLS}")
    return found


def speaks_tls(address: str) -> bool:
    """Whether the server at "host:port" answers a TLS handshake with a certificate, valid or not."""
    host, port = host_and_port(address)
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.set_alpn_protocols(["h2"])
    try:
        with (
            socket.create_connection((host, port), _CONNECT_LIMIT_S) as raw,
            context.wrap_socket(raw, server_hostname=host) as secure,
        ):
            return secure.version() is not None
    except OSError:
        return False


def _is_unreached(error: MaplessError) -> bool:
    """Whether the error says that no server was reached at an address; another of the name may have a better reason."""
    return is_unconnected(error) and _UNREACHED.search(error.message) is not None


def _of_another_address(error: MaplessError, address: str, options: ConnectOptions) -> MaplessError:
    host, port = host_and_port(address)
    if not host[:1].isalpha() or not _is_unreached(error):  # an IP address is the only one
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
        if other is not None and is_unconnected(other) and not _is_unreached(other):
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
