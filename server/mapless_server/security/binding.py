"""Whether a server may listen where it is told to, given what protects it: nobody opens it to the world by accident."""

from __future__ import annotations

import ipaddress
import socket
from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum

Resolve = Callable[[str], list[str]]


class Verdict(Enum):
    """What to make of an advice."""

    FINE = "fine"
    """Worth a line in the log, if it says anything."""
    WARNING = "warning"
    """Worth a warning."""
    REFUSED = "refused"
    """The server must not start."""


@dataclass(frozen=True)
class Advice:
    """A verdict and a sentence for the operator, empty if there is nothing to say."""

    verdict: Verdict
    sentence: str = ""


def resolve_host(host: str) -> list[str]:
    """The addresses of a name or an address; none if it cannot be resolved."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return []
    return [str(address[0]) for *_, address in found]


def is_loopback(host: str, resolve: Resolve = resolve_host) -> bool:
    """Whether nobody but this machine can reach what listens there; False if the name cannot be resolved."""
    addresses = resolve(host)
    return bool(addresses) and all(map(_is_loopback, addresses))


def advise(
    host: str,
    *,
    tls: bool,
    client_certificates: bool,
    tokens: bool,
    insecure: bool,
    resolve: Resolve = resolve_host,
) -> Advice:
    """What is to be said of listening on a host.

    Args:
        host: the setting.
        tls: whether connections are encrypted.
        client_certificates: whether clients must show one.
        tokens: whether callers must show one.
        insecure: whether the operator wants it anyway.
        resolve: finds a host's addresses.
    """
    loopback = is_loopback(host, resolve)
    if not tls and not tokens:
        if loopback:
            return Advice(
                Verdict.FINE,
                "neither TLS nor tokens are set: everybody on this machine may do everything, and nobody else can "
                "connect",
            )
        open_to_all = f"on {host} everybody who can reach this machine could read and delete all scenes"
        if insecure:
            return Advice(Verdict.WARNING, f"neither TLS nor tokens are set: {open_to_all}")
        return Advice(
            Verdict.REFUSED,
            f"neither TLS nor tokens are set, and {open_to_all}: set tls_certificate and tls_key or tokens_file, or "
            "listen on 127.0.0.1, or set insecure if something else keeps strangers out",
        )
    if loopback:
        return Advice(Verdict.FINE)
    if not tls:
        return Advice(
            Verdict.WARNING, "tokens are set without TLS: they travel in clear, unless a proxy in front ends TLS"
        )
    if not tokens and not client_certificates:
        return Advice(
            Verdict.WARNING,
            f"connections are encrypted, but neither tokens nor clients' certificates are asked for: on {host} "
            "everybody who can reach this machine may do everything",
        )
    return Advice(Verdict.FINE)


def _is_loopback(text: str) -> bool:
    address = ipaddress.ip_address(text.partition("%")[0])
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback
