"""Addresses of servers: "host:port", several of them separated by commas, or one in a form of gRPC's own."""

import ipaddress
import re
import socket

_SCHEMES = ("dns", "ipv4", "ipv6", "unix", "unix-abstract", "vsock", "xds")
"""Schemes of gRPC's own forms of an address."""
_DEFAULT_PORT = "443"  # gRPC's
_LOCAL_NAMES = ("localhost", "localhost.localdomain", "ip6-localhost", "ip6-loopback")
_LOCAL_SCHEMES = ("unix:", "unix-abstract:", "vsock:")


def addresses_of(text: str) -> tuple[str, ...]:
    """The addresses of "host1:port,host2:port", each once, in their order; ValueError if one is none.

    Of servers that share a store, the client calls each in turn, and passes over one that does not answer. A list in
    gRPC's own form, "ipv4:127.0.0.1:50051,127.0.0.1:50052", is one address.
    """
    if is_of_grpc(text):
        return (text,)
    return tuple(dict.fromkeys(_checked(part.strip()) for part in text.split(",")))


def is_of_grpc(address: str) -> bool:
    """Whether an address has a form of gRPC's own, such as "dns:///mapless:50051" or "unix:/run/mapless.sock"."""
    scheme, colon, _ = address.partition(":")
    return bool(colon) and scheme in _SCHEMES


def _checked(address: str) -> str:
    """The address; ValueError if it is a URL."""
    if is_of_grpc(address):
        raise ValueError(f"several addresses are host:port,host:port, and {address!a} is another form")
    scheme, _, rest = address.partition(":")
    host = (rest if rest.startswith("//") else address).strip("/").partition("/")[0]
    if address != host or not host:
        tls = ", and encrypt with --tls (Python: tls)" if scheme in ("https", "grpcs") else ""
        example = host or "localhost:50051"
        raise ValueError(f"an address is host:port, without scheme and path: {example}{tls}, is {address!a}")
    port = re.search(r":(\d+)$", host)
    if port is not None and not 0 < int(port[1]) < 65536:
        raise ValueError(f"the port of an address must be 1 to 65535, is {port[1]}")
    return address


def host_and_port(address: str) -> tuple[str, int]:
    """Splits "host:port"; the host is empty for several addresses and gRPC's other forms of an address."""
    host, colon, port = address.rpartition(":")
    if not colon or (":" in host and not host.startswith("[")):
        host, port = address, _DEFAULT_PORT
    is_plain = not {"/", ","} & set(address) and not is_of_grpc(address)
    return (host.strip("[]"), int(port)) if is_plain and port.isdecimal() else ("", 0)


def hosts_and_ports(address: str) -> list[tuple[str, int]]:
    """Hosts and ports of one address in any form of TCP, "dns:///host:port" and "ipv4:a:1,b:2" included; else empty."""
    scheme, _, rest = address.partition(":") if is_of_grpc(address) else ("", "", address)
    if scheme not in ("", "dns", "ipv4", "ipv6"):
        return []
    parts = [host_and_port(part) for part in rest.rpartition("/")[2].split(",")]
    return parts if all(host for host, _ in parts) else []


def is_loopback(address: str) -> bool:
    """Whether an address, in any form, is on this machine."""
    if address.startswith(_LOCAL_SCHEMES):
        return True
    found = hosts_and_ports(address)
    return bool(found) and all(is_loopback_host(host) for host, _ in found)


def is_loopback_host(host: str) -> bool:
    """Whether a host's name or address is this machine's own, without asking a name server."""
    name = host.rstrip(".").lower()
    if name in _LOCAL_NAMES or name.endswith(".localhost"):
        return True
    ip = ip_of(name)
    return ip is not None and (ip.is_loopback or ip.is_unspecified)


def ip_of(host: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """The IP address that a text is, also in brackets, short as 127.1, or an IPv4 address within IPv6; else None."""
    text = host.strip("[]").partition("%")[0]
    try:
        ip = ipaddress.ip_address(text)
    except ValueError:
        if not re.fullmatch(r"[0-9][0-9a-fx.]*", text):
            return None
        try:
            return ipaddress.IPv4Address(socket.inet_aton(text))
        except OSError:
            return None
    mapped = ip.ipv4_mapped if isinstance(ip, ipaddress.IPv6Address) else None
    return mapped or ip
