"""Connections that never become ready for calls are counted, end soon, and take nothing from others."""

import socket
import ssl
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import pytest
from support.certificates import authority, options_of, signed
from support.servers import make_scene, serving
from support.waiting import wait_until

from mapless import Client, ConnectOptions
from mapless_server.rpc import descriptors

COUNT = 40
PREFACE = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"


def connected(port: int) -> socket.socket:
    return socket.create_connection(("127.0.0.1", port), timeout=20)


def sending(data: bytes) -> Callable[[int], socket.socket]:
    """Makes a connection on which only this is sent."""

    def make(port: int) -> socket.socket:
        connection = connected(port)
        connection.send(data)
        return connection

    return make


def hello() -> bytes:
    """The first message of a TLS handshake."""
    incoming, outgoing = ssl.MemoryBIO(), ssl.MemoryBIO()
    with pytest.raises(ssl.SSLWantReadError):
        ssl.create_default_context().wrap_bio(incoming, outgoing, server_hostname="localhost").do_handshake()
    return outgoing.read()


def shaken(data: bytes) -> Callable[[int], socket.socket]:
    """Makes a connection on which this is sent after a TLS handshake."""
    context = ssl.create_default_context()
    context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
    context.set_alpn_protocols(["h2"])

    def make(port: int) -> socket.socket:
        connection = context.wrap_socket(connected(port), server_hostname="localhost")
        if data:
            connection.send(data)
        return connection

    return make


PLAIN = [sending(b""), sending(PREFACE[:10]), sending(PREFACE)]
OVER_TLS = [sending(b""), sending(hello()[:50]), sending(hello()), shaken(b""), shaken(PREFACE[:10]), shaken(PREFACE)]


@pytest.mark.parametrize("uses_tls", [False, True], ids=["plain", "tls"])
def test_connections_that_are_never_ready_end_and_disturb_nobody(
    uses_tls: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With any part of TLS and HTTP/2's preface, but without HTTP/2's settings."""
    monkeypatch.setattr(descriptors, "HANDSHAKE_S", 2.0)
    monkeypatch.setattr(descriptors, "SHORT_HANDSHAKE_S", 2.0)
    root, files, options = authority(), dict[str, Any](), ConnectOptions()
    if uses_tls:
        files = {"tls_certificate": tmp_path / "certificate.pem", "tls_key": tmp_path / "key.pem"}
        signed(root, "server").write(*files.values())
        options = options_of(root=root)
    kinds = OVER_TLS if uses_tls else PLAIN
    with serving(tmp_path, **files) as server, Client(server.address, options) as client, ExitStack() as stack:
        make_scene(client)
        port = int(server.address.rpartition(":")[2])
        strangers = [stack.enter_context(kinds[i % len(kinds)](port)) for i in range(COUNT)]
        assert server.value("mapless_open_connections") >= COUNT
        with Client(server.address, options) as other:
            assert [it.scene_id for it in other.list_scenes()] == ["s"]
        for connection in strangers:
            with suppress(ConnectionError):
                while connection.recv(1024):  # the server's own part of the handshake and preface
                    pass
        wait_until(lambda: server.value("mapless_open_connections") < COUNT)
        assert server.value("mapless_max_connections") == descriptors.most_connections()
