"""The HTTP proxy of the environment: which gRPC would use, and which addresses it is not used for.

gRPC reads grpc_proxy, https_proxy and http_proxy, in this order and in lower case only, and the exemptions in
no_grpc_proxy or no_proxy, whose entries it takes as the ends of names. Here the exemptions have the forms that curl,
Go and Python's requests know, and addresses of this machine are always exempt.
"""

import ipaddress
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from urllib.parse import urlsplit

from .addresses import hosts_and_ports, ip_of, is_loopback

_VARIABLES = ("grpc_proxy", "https_proxy", "http_proxy")
_EXEMPTIONS = ("no_grpc_proxy", "no_proxy", "NO_PROXY")
"""The first that is not empty counts."""


@dataclass(frozen=True)
class Proxy:
    """A proxy: the variable that names it, and its host:port."""

    variable: str
    address: str

    def __str__(self) -> str:
        return f"the proxy {self.address} (the environment's {self.variable}; no_proxy exempts hosts)"


def proxy_of(address: str, environment: Mapping[str, str] = os.environ) -> Proxy | None:
    """The proxy through which gRPC connects to an address; None if it connects directly."""
    variable = next((it for it in _VARIABLES if it in environment), "")
    try:
        url = urlsplit(environment.get(variable, ""))
    except ValueError:
        return None
    if url.scheme != "http" or not url.netloc or is_exempt(address, environment):
        return None
    return Proxy(variable, url.netloc.rpartition("@")[2])


def is_exempt(address: str, environment: Mapping[str, str] = os.environ) -> bool:
    """Whether no proxy is used for an address of gRPC: it is on this machine, or the environment exempts its hosts."""
    if is_loopback(address):
        return True
    entries = re.split(r"[,\s]+", next(filter(None, map(environment.get, _EXEMPTIONS)), ""))
    found = hosts_and_ports(address)
    return bool(found) and all(any(_matches(host, port, it) for it in entries if it) for host, port in found)


def _matches(host: str, port: int, entry: str) -> bool:
    """Whether an entry of no_proxy means a host: "*", a name and all below it, an address, a network; also with a port.

    ".example.com" and "*.example.com" are the same as "example.com".
    """
    if entry == "*":
        return True
    ip = ip_of(host)
    if "/" in entry:
        try:
            network = ipaddress.ip_network(entry.replace("[", "").replace("]", ""), strict=False)
        except ValueError:
            return False
        return ip is not None and ip.version == network.version and ip in network
    with_port = re.fullmatch(r"(\[.*\]|[^:]*):(\d+)", entry)
    if with_port:
        if int(with_port[2]) != port:
            return False
        entry = with_port[1]
    if ip is not None:
        return ip == ip_of(entry)
    name, domain = host.rstrip(".").lower(), entry.removeprefix("*").strip(".").lower()
    return bool(domain) and (name == domain or name.endswith(f".{domain}"))
