"""Checks that a server does not listen beyond this machine without protection by accident."""

import ipaddress
import logging
import socket
from collections.abc import Callable

from mapless_server.settings import Settings

Resolve = Callable[[str], list[str]]


def resolve_host(host: str) -> list[str]:
    """The addresses of a host's name or address; empty if it cannot be resolved."""
    try:
        found = socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)
    except (OSError, UnicodeError):
        return []
    return [str(address[0]) for *_, address in found]


def is_loopback(host: str, resolve: Resolve = resolve_host) -> bool:
    """Whether only this machine can connect to the host; False if its name cannot be resolved."""
    addresses = resolve(host)
    return bool(addresses) and all(map(_is_loopback, addresses))


def assess_binding(settings: Settings, resolve: Resolve = resolve_host) -> tuple[int, str]:
    """Rates the danger of listening on the settings' host with the settings' protection.

    Returns a level of `logging`, of which CRITICAL means that the server must not start, and a sentence for the
    operator, which may be empty.
    """
    host, tls, tokens = settings.host, settings.tls_certificate is not None, settings.tokens_file is not None
    if tokens:
        if tls or is_loopback(host, resolve):
            return logging.INFO, ""
        return logging.WARNING, "tokens are set without TLS: they are sent in clear, unless a proxy terminates TLS"
    if settings.tls_client_ca is not None:
        return logging.INFO, ""
    if is_loopback(host, resolve):
        return logging.INFO, "" if tls else (
            "neither TLS nor tokens are set: every user of this machine has all rights, and no other machine can "
            "connect"
        )
    problem = (
        f"{'TLS alone keeps nobody out' if tls else 'neither TLS nor tokens are set'}, and on {host} everybody who can "
        "reach this machine could read and delete all scenes"
    )
    if settings.insecure:
        return logging.WARNING, problem
    return logging.CRITICAL, (
        f"{problem}: set tokens_file{'' if tls else ', with tls_certificate and tls_key'} (mapless-server token "
        "create), or tls_client_ca, or listen on 127.0.0.1, or set insecure if another program restricts access"
    )


def _is_loopback(text: str) -> bool:
    address = ipaddress.ip_address(text.partition("%")[0])
    mapped = address.ipv4_mapped if isinstance(address, ipaddress.IPv6Address) else None
    return (mapped or address).is_loopback
