"""Connections that cannot be made, and the message for a person."""

import re
import socket
import ssl
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path
from typing import Any

import grpc
import pytest
from support.certificates import authority, signed

from mapless import Client, ConnectOptions, MaplessError, Unavailable
from mapless.errors import REFUSED, _message
from mapless.reaching import explained

OURS, ANOTHER = authority(), authority("another")
CERTIFICATE = signed(OURS, "server")


@pytest.fixture(scope="module")
def addresses() -> Iterator[dict[str, str]]:
    """Servers that answer nothing, one with TLS, one without; and a port without a listener."""
    plain, tls = (grpc.server(ThreadPoolExecutor(1)) for _ in range(2))
    credentials = grpc.ssl_server_credentials([(CERTIFICATE.key_pem, CERTIFICATE.certificate_pem)])
    ports = {"plain": plain.add_insecure_port("127.0.0.1:0"), "tls": tls.add_secure_port("127.0.0.1:0", credentials)}
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        ports["nobody"] = taken.getsockname()[1]
        for server in (plain, tls):
            server.start()
        yield {kind: f"127.0.0.1:{port}" for kind, port in ports.items()}
        for server in (plain, tls):
            server.stop(None).wait()


@pytest.mark.parametrize(
    ("kind", "certificates", "expected"),
    [
        ("tls", None, "the server uses TLS; give --tls"),
        ("tls", ANOTHER.certificate_pem, "is not signed by a known authority"),
        ("tls", b"no certificate", "must be PEM"),
        ("plain", OURS.certificate_pem, "does not use TLS"),
        ("nobody", None, "no server listens there"),
    ],
)
def test_a_failed_connection_is_explained(
    addresses: dict[str, str], kind: str, certificates: bytes | None, expected: str
) -> None:
    options = ConnectOptions(tls=certificates is not None, root_certificates=certificates, max_attempts=1)
    with Client(addresses[kind], options) as client, pytest.raises(MaplessError) as caught:
        client.is_serving()
    assert caught.value.code == "UNAVAILABLE"
    assert caught.value.message.startswith(f"cannot connect to {addresses[kind]}: ")
    assert expected in caught.value.message


@pytest.mark.parametrize("offered", [[], ["http/1.1"]], ids=["none", "HTTP/1.1"])
def test_a_server_without_http_2_in_its_handshake_is_named(offered: list[str], tmp_path: Path) -> None:
    """As nginx or a load balancer whose port is configured for HTTP/1."""
    CERTIFICATE.write(tmp_path / "tls.pem", tmp_path / "tls.key")
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(tmp_path / "tls.pem", tmp_path / "tls.key")
    if offered:
        context.set_alpn_protocols(offered)
    options = ConnectOptions(tls=True, root_certificates=OURS.certificate_pem, max_attempts=1)
    with socket.create_server(("127.0.0.1", 0)) as listening:

        def shake_hands() -> None:  # again, as the client does where localhost has other addresses
            with suppress(OSError):
                while True:
                    raw = listening.accept()[0]
                    with suppress(OSError), raw, context.wrap_socket(raw, server_side=True) as secure:
                        secure.recv(1)

        thread = threading.Thread(target=shake_hands)
        thread.start()
        with (
            Client(f"localhost:{listening.getsockname()[1]}", options) as client,
            pytest.raises(MaplessError) as caught,
        ):
            client.get_scene("hall", timeout_s=20.0)
        listening.shutdown(socket.SHUT_RDWR)  # ends the thread's wait
        thread.join(20)
    assert not thread.is_alive()
    assert "does not offer HTTP/2 (ALPN h2)" in caught.value.message


@pytest.mark.parametrize("certificates", [None, ANOTHER.certificate_pem])
def test_localhost_says_what_is_wrong_where_the_server_is(
    addresses: dict[str, str], certificates: bytes | None
) -> None:
    """Nothing listens at its IPv6 address, which gRPC reports as often as the other."""
    address = addresses["tls"].replace("127.0.0.1", "localhost")
    options = ConnectOptions(tls=certificates is not None, root_certificates=certificates, max_attempts=1)
    expected = "is not signed by a known authority" if certificates else "the server uses TLS; give --tls"
    for _ in range(4):
        with Client(address, options) as client, pytest.raises(MaplessError) as caught:
            client.is_serving()
        assert caught.value.message.startswith(f"cannot connect to {addresses['tls']}: ")
        assert expected in caught.value.message


def has_two_addresses(monkeypatch: pytest.MonkeyPatch, host: str, port: int) -> None:
    """Every name: IPv6's loopback, and this."""
    found = [
        (socket.AF_INET6, socket.SOCK_STREAM, 0, "", ("::1", port, 0, 0)),
        (socket.AF_INET, socket.SOCK_STREAM, 0, "", (host, port)),
    ]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)


def test_a_hidden_reason_is_found(addresses: dict[str, str], monkeypatch: pytest.MonkeyPatch) -> None:
    """The address reported, of a name's two, is the one where nothing listens."""
    host, port = addresses["tls"].split(":")
    has_two_addresses(monkeypatch, host, int(port))
    reported = MaplessError("UNAVAILABLE", f"cannot connect to [::1]:{port}: {REFUSED} (connection refused)")
    shown = explained(reported, f"localhost:{port}", ConnectOptions())
    assert shown.message.startswith(f"cannot connect to {addresses['tls']}: the server uses TLS")
    nowhere = addresses["nobody"].rpartition(":")[2]
    assert explained(reported, f"localhost:{nowhere}", ConnectOptions()) is reported
    assert explained(reported, f"[::1]:{port}", ConnectOptions()) is reported


@pytest.mark.parametrize(("kind", "expected"), [("tls", "the server uses TLS"), ("nobody", REFUSED)])
def test_an_address_without_a_route_hides_nothing(
    addresses: dict[str, str], monkeypatch: pytest.MonkeyPatch, kind: str, expected: str
) -> None:
    """As ::1 in a container without IPv6, which gRPC tries last and reports."""
    host, port = addresses[kind].split(":")
    has_two_addresses(monkeypatch, host, int(port))
    details = (
        f"connections to all backends failing; last error: UNKNOWN: ipv6:%5B::1%5D:{port}: Failed to connect to remote "
        "host: connect: Cannot assign requested address (99)"
    )
    shown = explained(MaplessError("UNAVAILABLE", _message(details)), f"localhost:{port}", ConnectOptions())
    assert shown.message.startswith(f"cannot connect to {addresses[kind]}: {expected}")


def test_an_address_that_accepts_and_is_silent_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a busy server is, whose handshake takes long: that nothing listens is true of the other address only."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        host, port = silent.getsockname()
        has_two_addresses(monkeypatch, host, port)
        reported = MaplessError("UNAVAILABLE", f"cannot connect to [::1]:{port}: {REFUSED} (connection refused)")
        shown = explained(reported, f"localhost:{port}", ConnectOptions(timeout_s=0.2))
    assert shown.message.startswith(f"cannot connect to {host}:{port}: a connection is accepted, but nothing answers")


def test_a_silent_server_takes_no_longer_than_asked() -> None:
    """It accepts a connection and sends nothing: gRPC alone waits 20 s for it."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        start_s = time.monotonic()
        with (
            Client(address, ConnectOptions(connect_timeout_s=1.0)) as client,
            pytest.raises(MaplessError, match=f"cannot connect to {address}: a connection is accepted"),
        ):
            client.get_scene("s")
    assert 0.5 < time.monotonic() - start_s < 10


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("http://localhost:50051", "host:port, without scheme and path: localhost:50051, is 'http://localhost:50051'"),
        ("https://vps.example/", "without scheme and path: vps.example, and encrypt with --tls"),
        ("grpc://[::1]:50051/mapless", r"without scheme and path: [::1]:50051, is"),
        ("localhost:50051/", "without scheme and path: localhost:50051, is"),
        ("", "without scheme and path: localhost:50051, is ''"),
    ],
)
def test_an_address_that_is_a_url_is_corrected(address: str, expected: str) -> None:
    with pytest.raises(ValueError, match=re.escape(expected)):
        Client(address)


@pytest.mark.parametrize(
    "address", ["localhost", "[::1]:50051", "dns:///mapless:50051", "unix:/run/mapless.sock", "a.b:1"]
)
def test_addresses_of_grpc_are_accepted(address: str) -> None:
    Client(address).close()


@pytest.mark.parametrize(
    ("address", "expected"),
    [
        ("ipv4:127.0.0.1:443", "cannot connect to 127.0.0.1:443: no server .*; an address without a port has port 443"),
        ("ipv6:%5B::1%5D:50051", r"cannot connect to \[::1\]:50051: no server listens there"),
    ],
)
def test_an_address_that_was_not_meant_is_explained(address: str, expected: str) -> None:
    details = f"failed: connections to all backends failing; last error: UNKNOWN: {address}: Connection refused (111)"
    assert re.match(expected, _message(details.removeprefix("failed: ")))


def test_the_servers_own_message_is_kept(addresses: dict[str, str]) -> None:
    with Client(addresses["plain"]) as client, pytest.raises(MaplessError, match="UNIMPLEMENTED: Method not found!"):
        client.is_serving()


def test_neither_token_nor_key_is_shown() -> None:
    options = ConnectOptions(tls=True, client_certificate=b"cert", client_key=b"SECRET", token="SECRET")
    assert "SECRET" not in repr(options)
    assert options.metadata() == (("authorization", "Bearer SECRET"),)


def test_without_token_and_client_id_nothing_is_sent() -> None:
    assert ConnectOptions().metadata() == ()
    assert ConnectOptions(client_id="r7").metadata() == (("x-client-id", "r7"),)


@pytest.mark.parametrize(
    ("wrong", "error_text"),
    [
        ({"client_certificate": b"x"}, "go together"),
        ({"client_key": b"x", "tls": True}, "go together"),
        ({"client_certificate": b"x", "client_key": b"x"}, "needs tls"),
        ({"token": "SECRET\n"}, "token must be"),
        ({"token": ""}, "token must be"),
        ({"token": "SECRET\N{BULLET}"}, "token must be"),
        ({"client_id": "a b"}, "client_id must be"),
        ({"client_id": "a\n"}, "client_id must be"),
    ],
)
def test_a_malformed_secret_is_rejected_without_showing_it(wrong: dict[str, Any], error_text: str) -> None:
    with pytest.raises(ValueError, match=error_text) as caught:
        ConnectOptions(**wrong)
    assert "SECRET" not in str(caught.value)


def test_a_server_that_goes_away_is_unavailable() -> None:
    """It, or one behind a load balancer, ends calls that it does not answer as CANCELLED."""

    class GoingAway(grpc.GenericRpcHandler):
        def service(self, handler_call_details: grpc.HandlerCallDetails) -> Any:
            return grpc.unary_unary_rpc_method_handler(
                lambda _, call: call.abort(grpc.StatusCode.CANCELLED, "CANCELLED")
            )

    server = grpc.server(ThreadPoolExecutor(1), handlers=(GoingAway(),))
    port = server.add_insecure_port("127.0.0.1:0")
    server.start()
    with Client(f"127.0.0.1:{port}", ConnectOptions(max_attempts=1)) as client, pytest.raises(Unavailable) as caught:
        client.get_scene("hall")
    server.stop(None).wait()
    assert caught.value.code == "CANCELLED"
