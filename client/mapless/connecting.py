"""Why a server cannot be reached whose name has several addresses, such as ::1 and 127.0.0.1 of localhost.

gRPC tries all of them and reports the last failure. Where nothing listens at one address, that may hide what is wrong
at the other, at which the server listens.
"""

from __future__ import annotations

import re
import socket

import grpc

from .errors import REFUSED, MaplessError, from_rpc_error
from .options import ConnectOptions

_NAMED = re.compile(r"([A-Za-z][A-Za-z0-9.-]*)(?::(\d+))?")
_DEFAULT_PORT = "443"  # gRPC's
_LIMIT_S = 2.0


def explained(error: MaplessError, address: str, options: ConnectOptions) -> MaplessError:
    """The error; if it is a refused connection, rather that of another address of the name that says more.

    Connects to the other addresses, which takes milliseconds and 2 seconds at most each.
    """
    named = _NAMED.fullmatch(address)
    if named is None or REFUSED not in error.message:
        return error
    host, port = named[1], named[2] or _DEFAULT_PORT
    try:
        found = {it[4][0]: it[0] for it in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)}
    except OSError:
        return error
    for ip, family in found.items():
        one = f"[{ip}]:{port}" if family == socket.AF_INET6 else f"{ip}:{port}"
        if f" {one}: " not in error.message:
            other = _failure(one, host, options)
            if other is not None and other.message.startswith("cannot connect") and REFUSED not in other.message:
                return other
    return error


def _failure(address: str, host: str, options: ConnectOptions) -> MaplessError | None:
    with options.channel(address, host) as channel:
        try:
            channel.unary_unary("/grpc.health.v1.Health/Check")(b"", timeout=_LIMIT_S)
        except grpc.RpcError as error:
            return from_rpc_error(error)
    return None
