"""TLS with real handshakes on loopback: which clients connect, and what changes with the files."""

import asyncio
import codecs
import logging
import re
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import grpc
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec, ed448, ed25519, rsa
from cryptography.hazmat.primitives.serialization import (
    BestAvailableEncryption,
    Encoding,
    NoEncryption,
    PrivateFormat,
)
from cryptography.x509.oid import NameOID
from support.certificates import DAY, Pair, authority, options_of, signed

from mapless import Client, ConnectOptions
from mapless.__main__ import main
from mapless.errors import from_rpc_error
from mapless_server.security import Authenticator, Role, SecurityError
from mapless_server.security.tls import Tls, TlsFiles, read_material

METHOD = "/mapless.v1.ReferenceService/GetScene"
CALL = "/test.Who/Am"
AUTHORITY, STRANGER = authority(), authority("stranger")
PASSWORD = BestAvailableEncryption(b"password")


@pytest.fixture
def files(tmp_path: Path) -> TlsFiles:
    """A good pair, and no client authority."""
    files = TlsFiles(tmp_path / "server.pem", tmp_path / "server-key.pem")
    signed(AUTHORITY, "first").write(files.certificate, files.key)
    return files


@pytest.fixture
def mutual(files: TlsFiles, tmp_path: Path) -> TlsFiles:
    """The same for a server that asks clients for a certificate."""
    (tmp_path / "clients.pem").write_bytes(AUTHORITY.certificate_pem)
    return TlsFiles(files.certificate, files.key, tmp_path / "clients.pem")


@dataclass
class Serving:
    """A bare server that answers the caller's name, and health.

    Attributes:
        health_metadata: of the last health check.
    """

    port: int
    tls: Tls
    health_metadata: dict[str, str]

    def options(self, client: Pair | None = None, root: Pair | None = AUTHORITY, **more: Any) -> ConnectOptions:
        return options_of(client, root, **more)

    def who_am_i(self, options: ConnectOptions) -> str:
        with options.channel(f"localhost:{self.port}") as channel:
            answer: bytes = channel.unary_unary(CALL)(b"", timeout=10, metadata=options.metadata())
            return answer.decode()

    def is_serving(self, options: ConnectOptions) -> bool:
        with Client(f"127.0.0.1:{self.port}", options) as client:
            return client.is_serving()

    def shown_certificate(self, client: Pair | None = None, folder: Path | None = None) -> str:
        """The common name of the certificate that a new connection sees, by another implementation of TLS."""
        context = ssl.create_default_context(cadata=AUTHORITY.certificate_pem.decode())
        context.set_alpn_protocols(["h2"])
        if client and folder:
            client.write(folder / "own.pem", folder / "own-key.pem")
            context.load_cert_chain(folder / "own.pem", folder / "own-key.pem")
        with (
            socket.create_connection(("127.0.0.1", self.port), 10) as plain,
            context.wrap_socket(plain, server_hostname="localhost") as encrypted,
        ):
            subject: Any = (encrypted.getpeercert() or {})["subject"]
            return str(dict(pair for part in subject for pair in part)["commonName"])


@contextmanager
def serving(files: TlsFiles) -> Iterator[Serving]:
    """A server with these files, in a thread of its own."""
    tls = Tls(files)
    loop = asyncio.new_event_loop()
    server: Any = None
    health_metadata: dict[str, str] = {}

    async def answer(request: bytes, context: Any) -> bytes:
        principal = Authenticator(None).authenticate(context.invocation_metadata(), METHOD, context.auth_context())
        assert principal.role is Role.WRITE
        return principal.name.encode()

    async def healthy(request: bytes, context: Any) -> bytes:
        health_metadata.clear()
        health_metadata.update(context.invocation_metadata())
        return b"\x08\x01"

    async def start() -> int:
        nonlocal server
        server = grpc.aio.server()
        for service, method, handler in (("test.Who", "Am", answer), ("grpc.health.v1.Health", "Check", healthy)):
            handlers = {method: grpc.unary_unary_rpc_method_handler(handler)}
            server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(service, handlers),))
        port: int = server.add_secure_port("127.0.0.1:0", tls.server_credentials())
        await server.start()
        return port

    port = loop.run_until_complete(start())
    thread = threading.Thread(target=loop.run_forever)
    thread.start()
    try:
        yield Serving(port, tls, health_metadata)
    finally:
        asyncio.run_coroutine_threadsafe(server.stop(0), loop).result(30)
        loop.call_soon_threadsafe(loop.stop)
        thread.join(30)
        assert not thread.is_alive()
        loop.close()


def refused(call: Callable[[], object]) -> None:
    with pytest.raises(grpc.RpcError) as caught:
        call()
    assert from_rpc_error(caught.value).code == "UNAVAILABLE"


class TestConnections:
    def test_client_certificates_are_checked_and_name_the_caller(self, mutual: TlsFiles) -> None:
        with serving(mutual) as server:
            assert server.who_am_i(server.options(signed(AUTHORITY, "robot-7"))) == "robot-7"
            assert server.is_serving(server.options(signed(AUTHORITY, "robot-7")))

    @pytest.mark.parametrize(
        "client",
        [
            None,
            signed(STRANGER, "robot-7"),
            signed(AUTHORITY, "late", ends=-timedelta(hours=1)),
            signed(AUTHORITY, "early", begins=timedelta(hours=1)),
        ],
        ids=["none", "a stranger's", "expired", "not yet valid"],
    )
    def test_clients_without_a_valid_certificate_fail(self, mutual: TlsFiles, client: Pair | None) -> None:
        with serving(mutual) as server:
            refused(lambda: server.who_am_i(server.options(client)))


class TestChanges:
    def test_a_new_certificate_is_for_new_connections_only(self, files: TlsFiles) -> None:
        with serving(files) as server, server.options().channel(f"localhost:{server.port}") as channel:
            states: list[grpc.ChannelConnectivity] = []
            call = channel.unary_unary(CALL)
            assert call(b"", timeout=10) == b""
            channel.subscribe(states.append)
            assert server.shown_certificate() == "first"
            expiry_s = server.tls.expiry_s
            signed(AUTHORITY, "second", ends=3 * DAY).write(files.certificate, files.key)
            assert server.shown_certificate() == "first"
            assert server.tls.refresh()
            assert [server.shown_certificate() for _ in range(2)] == ["second"] * 2
            assert server.tls.expiry_s - expiry_s == pytest.approx(2 * 86400, abs=120)
            assert call(b"", timeout=10) == b""
            assert set(states) <= {grpc.ChannelConnectivity.READY}, "the old connection was cut"
            assert server.who_am_i(server.options()) == ""

    def test_a_new_client_authority_applies_to_new_connections(self, mutual: TlsFiles) -> None:
        assert mutual.client_ca
        with serving(mutual) as server:
            ours, theirs = signed(AUTHORITY, "ours"), signed(STRANGER, "theirs")
            assert server.who_am_i(server.options(ours)) == "ours"
            mutual.client_ca.write_bytes(STRANGER.certificate_pem)
            assert server.tls.refresh()
            assert server.who_am_i(server.options(theirs)) == "theirs"
            refused(lambda: server.who_am_i(server.options(ours)))

    @pytest.mark.parametrize("broken", ["key of another", "no PEM", "gone", "expired"])
    def test_unusable_files_leave_the_old_ones_in_use(
        self, files: TlsFiles, broken: str, caplog: pytest.LogCaptureFixture
    ) -> None:
        with serving(files) as server:
            if broken == "key of another":
                files.certificate.write_bytes(signed(AUTHORITY, "second").certificate_pem)
            elif broken == "no PEM":
                files.certificate.write_bytes(b"x")
            elif broken == "gone":
                files.key.unlink()
            else:
                signed(AUTHORITY, "old", ends=-timedelta(hours=1)).write(files.certificate, files.key)
            assert [server.tls.refresh() for _ in range(3)] == [False] * 3
            errors = [record for record in caplog.records if record.levelno == logging.ERROR]
            assert len(errors) == 1
            assert "stay in use" in errors[0].getMessage()
            assert server.shown_certificate() == "first"
            assert server.who_am_i(server.options()) == ""
            signed(AUTHORITY, "third").write(files.certificate, files.key)
            assert server.tls.refresh()
            assert server.shown_certificate() == "third"

    def test_a_redirected_link_is_a_change(self, tmp_path: Path) -> None:
        # As Kubernetes replaces a mounted secret.
        for name in ("one", "two"):
            (tmp_path / name).mkdir()
            signed(AUTHORITY, name).write(tmp_path / name / "tls.crt", tmp_path / name / "tls.key")
        (tmp_path / "data").symlink_to("one")
        with serving(TlsFiles(tmp_path / "data" / "tls.crt", tmp_path / "data" / "tls.key")) as server:
            assert server.shown_certificate() == "one"
            (tmp_path / "new").symlink_to("two")
            (tmp_path / "new").replace(tmp_path / "data")
            assert server.tls.refresh()
            assert server.shown_certificate() == "two"

    def test_a_new_certificate_in_the_middle_of_many_handshakes(self, mutual: TlsFiles, tmp_path: Path) -> None:
        with serving(mutual) as server:
            client = server.options(signed(AUTHORITY, "robot"))
            names: list[str] = []
            stop = threading.Event()

            def connect() -> None:
                while not stop.is_set():
                    names.append(server.who_am_i(client))

            threads = [threading.Thread(target=connect) for _ in range(3)]
            for thread in threads:
                thread.start()
            for i in range(10):
                signed(AUTHORITY, f"server-{i}").write(mutual.certificate, mutual.key)
                server.tls.refresh()
            stop.set()
            for thread in threads:
                thread.join(30)
                assert not thread.is_alive()
            assert len(names) >= 3
            assert set(names) == {"robot"}
            own = signed(AUTHORITY, "robot")
            assert server.shown_certificate(own, tmp_path) == "server-9"


class TestFilesAtTheStart:
    def test_good_files_are_read_and_the_key_is_never_shown(self, mutual: TlsFiles) -> None:
        material = read_material(mutual)
        assert material.certificate == mutual.certificate.read_bytes()
        assert material.client_ca == AUTHORITY.certificate_pem
        assert "PRIVATE" not in repr(material)

    def test_a_chain_begins_with_the_servers_own(self, files: TlsFiles) -> None:
        own = files.certificate.read_bytes()
        files.certificate.write_bytes(own + AUTHORITY.certificate_pem)
        assert read_material(files).certificate == own + AUTHORITY.certificate_pem
        files.certificate.write_bytes(AUTHORITY.certificate_pem + own)
        with pytest.raises(SecurityError, match="not that of the first certificate"):
            read_material(files)

    @pytest.mark.parametrize(
        ("which", "content", "error_text"),
        [
            ("certificate", None, "No such file"),
            ("key", None, "No such file"),
            ("client_ca", None, "No such file"),
            ("certificate", b"", "holds no certificate in PEM form"),
            ("certificate", b"\x30\x82\x00", "holds no certificate in PEM form"),
            ("key", b"-----BEGIN PRIVATE KEY-----\nAAAA\n-----END PRIVATE KEY-----\n", "no private key in PEM form"),
            ("key", AUTHORITY.certificate_pem, "no private key in PEM form"),
            ("key", AUTHORITY.key_pem, "is not that of the first certificate"),
            ("key", AUTHORITY.key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, PASSWORD), "encrypted"),
            ("client_ca", AUTHORITY.key_pem, "holds no certificate in PEM form"),
        ],
    )
    def test_an_error_is_one_sentence_that_names_the_file(
        self, mutual: TlsFiles, which: str, content: bytes | None, error_text: str
    ) -> None:
        path: Path = getattr(mutual, which)
        if content is None:
            path.unlink()
        else:
            path.write_bytes(content)
        with pytest.raises(SecurityError, match=error_text) as caught:
            Tls(mutual)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)

    @pytest.mark.parametrize(("begins", "ends", "what"), [(-3, -1, "expired at"), (1, 3, "not valid before")])
    def test_a_certificate_that_is_not_valid_now_is_rejected(
        self, files: TlsFiles, begins: int, ends: int, what: str
    ) -> None:
        signed(AUTHORITY, "x", begins * DAY, ends * DAY).write(files.certificate, files.key)
        with pytest.raises(SecurityError, match=what):
            Tls(files)

    @pytest.mark.parametrize("which", ["certificate", "key", "client_ca"])
    @pytest.mark.parametrize("mark", [codecs.BOM_UTF8, codecs.BOM_UTF16_LE], ids=["UTF-8", "UTF-16"])
    def test_a_byte_order_mark_does_no_harm(self, mutual: TlsFiles, which: str, mark: bytes) -> None:
        path: Path = getattr(mutual, which)
        pem = path.read_bytes() + (AUTHORITY.certificate_pem if which == "certificate" else b"")
        is_utf_16 = mark == codecs.BOM_UTF16_LE
        path.write_bytes(mark + (pem.decode().encode("utf-16-le") if is_utf_16 else pem.replace(b"\n", b"\r\n")))
        with serving(mutual) as server:
            assert server.who_am_i(server.options(signed(AUTHORITY, "robot-7"))) == "robot-7"

    def test_marks_of_a_clients_files_do_no_harm(self, mutual: TlsFiles) -> None:
        marked = signed(AUTHORITY, "robot-7")
        files = {"root_certificates": AUTHORITY.certificate_pem, "client_certificate": marked.certificate_pem}
        files["client_key"] = marked.key_pem
        with serving(mutual) as server:
            given: dict[str, Any] = {name: codecs.BOM_UTF8 + pem for name, pem in files.items()}
            assert server.who_am_i(ConnectOptions(tls=True, **given)) == "robot-7"

    @pytest.mark.parametrize(
        ("key", "kind"),
        [
            (ed25519.Ed25519PrivateKey.generate(), "Ed25519"),
            (ed448.Ed448PrivateKey.generate(), "Ed448"),
            (ec.generate_private_key(ec.SECP521R1()), "the curve secp521r1"),
            (ec.generate_private_key(ec.SECP256K1()), "the curve secp256k1"),
            (ec.generate_private_key(ec.SECP384R1()), ""),
            (rsa.generate_private_key(65537, 2048), ""),
        ],
        ids=["Ed25519", "Ed448", "P-521", "secp256k1", "P-384", "RSA"],
    )
    def test_a_key_that_no_client_accepts_is_refused(self, files: TlsFiles, key: Any, kind: str) -> None:
        name = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, "localhost")])
        now = datetime.now(timezone.utc)
        made = x509.CertificateBuilder(name, name, key.public_key(), x509.random_serial_number(), now - DAY, now + DAY)
        made = made.add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        own = made.sign(key, None if kind.startswith("Ed") else hashes.SHA256())
        files.certificate.write_bytes(own.public_bytes(Encoding.PEM))
        files.key.write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
        if kind:
            with pytest.raises(SecurityError, match=re.escape(f"do not accept ({kind}); make a key")):
                Tls(files)
            return
        with serving(files) as server:
            options = ConnectOptions(tls=True, root_certificates=files.certificate.read_bytes())
            assert server.who_am_i(options) == ""


class TestCommand:
    @pytest.fixture
    def server(self, mutual: TlsFiles) -> Iterator[Serving]:
        with serving(mutual) as server:
            yield server

    @pytest.fixture
    def flags(self, tmp_path: Path) -> dict[str, str]:
        signed(AUTHORITY, "robot-7").write(tmp_path / "own.pem", tmp_path / "own-key.pem")
        (tmp_path / "ca.pem").write_bytes(AUTHORITY.certificate_pem)
        (tmp_path / "token").write_text("mapless_x\n")
        files = {"--ca": "ca.pem", "--cert": "own.pem", "--key": "own-key.pem", "--token-file": "token"}
        return {flag: str(tmp_path / name) for flag, name in files.items()}

    def health(self, server: Serving, flags: dict[str, str]) -> int:
        arguments = [part for flag in flags.items() for part in flag]
        with pytest.raises(SystemExit) as caught:
            main(["--address", f"localhost:{server.port}", "--timeout", "5", *arguments, "health", "--text"])
        return int(caught.value.code or 0)

    def test_the_command_sends_certificates_and_the_files_token_first(
        self,
        server: Serving,
        flags: dict[str, str],
        monkeypatch: pytest.MonkeyPatch,
        capsys: pytest.CaptureFixture[str],
    ) -> None:
        monkeypatch.setenv("MAPLESS_TOKEN", "mapless_environment")
        file = flags.pop("--token-file")
        assert self.health(server, flags) == 0
        assert server.health_metadata["authorization"] == "Bearer mapless_environment"
        assert self.health(server, flags | {"--token-file": file, "--client-id": "r7"}) == 0
        assert server.health_metadata["authorization"] == "Bearer mapless_x"
        assert server.health_metadata["x-client-id"] == "r7"
        assert capsys.readouterr().out.splitlines()[0].split() == ["server", "SERVING"]

    @pytest.mark.parametrize(
        ("changes", "code", "error_text"),
        [
            ({"--key": None}, 2, "go together"),
            ({"--cert": None}, 2, "go together"),
            ({"--token-file": "absent"}, 2, "absent"),
            ({"--ca": "absent"}, 2, "absent"),
            ({"--cert": None, "--key": None}, 1, "UNAVAILABLE"),
        ],
    )
    def test_errors_name_the_file(
        self,
        server: Serving,
        flags: dict[str, str],
        capsys: pytest.CaptureFixture[str],
        changes: dict[str, str | None],
        code: int,
        error_text: str,
    ) -> None:
        given = {flag: value for flag, value in (flags | changes).items() if value is not None}
        assert self.health(server, given) == code
        said = capsys.readouterr().err
        assert error_text in said
        assert "mapless_x" not in said
