"""Explains why a server cannot be reached whose host name has several addresses, such as ::1 and 127.0.0.1.

gRPC tries all of them and reports the last failure. If nothing listens at one address, this may hide the failure at the
other, at which the server listens.
"""

import re
import socket

import grpc

from .errors import REFUSED, DeadlineExceeded, MaplessError, Unavailable, from_rpc_error
from .options import ConnectOptions

_UNREACHED = re.compile(
    f"{REFUSED}|Cannot assign requested address|Network is unreachable|No route to host|Address family not supported"
)
"""In errors of an address at which no server was reached, as IPv6's in a container without IPv6."""
_NAMED = re.compile(r"([A-Za-z][A-Za-z0-9.-]*)(?::(\d+))?")
_DEFAULT_PORT = "443"  # gRPC's
_CONNECT_LIMIT_S = 2.0
_ANSWER_LIMIT_S = 10.0  # a server with much to do, or a busy machine, may need seconds for a handshake


def is_unreached(error: MaplessError) -> bool:
    """Whether the error says that no server was reached at an address; `explained` may then find a better reason."""
    return error.message.startswith("cannot connect") and _UNREACHED.search(error.message) is not None


def explained(error: MaplessError, address: str, options: ConnectOptions) -> MaplessError:
    """Returns the error, or that of another address of the same host name if it explains more.

    Connects to the other addresses, which takes milliseconds. An address that does not answer takes 2 seconds; one that
    accepts connections and sends nothing, 10 seconds, or the options' timeout if that is less.
    """
    named = _NAMED.fullmatch(address)
    if named is None or not is_unreached(error):
        return error
    host, port = named[1], named[2] or _DEFAULT_PORT
    try:
        found = {it[4][0]: it for it in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
    except OSError:
        return error
    refused = error if REFUSED in error.message else None
    for ip, (family, *_, endpoint) in found.items():
        one = f"[{ip}]:{port}" if family == socket.AF_INET6 else f"{ip}:{port}"
        if f" {one}: " in error.message:
            continue
        try:
            with socket.socket(family, socket.SOCK_STREAM) as probe:
                probe.settimeout(_CONNECT_LIMIT_S)
                probe.connect(endpoint)
        except ConnectionRefusedError:
            refused = refused or Unavailable("UNAVAILABLE", f"cannot connect to {one}: {REFUSED} (connection refused)")
            continue
        except OSError:
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
