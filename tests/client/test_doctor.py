"""`mapless doctor` against what can be wrong with a server, an address, a token and a clock."""

import http.server
import json
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import grpc
import pytest
from support.certificates import DAY, authority, signed
from support.commands import run_client
from support.servers import CAMERA, PHOTO, RunningServer, make_scene, serving

from mapless import Client
from mapless.cli import doctor
from mapless_server.security import create_token

CHECKS = ["address", "protocol", "services", "token", "clock", "version", "limits", "query"]
OURS = authority()


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with certificates, and a file of tokens with one that may read."""
    folder = tmp_path_factory.mktemp("doctor")
    (folder / "ca.pem").write_bytes(OURS.certificate_pem)
    signed(OURS, "server").write(folder / "tls.pem", folder / "tls.key")
    (folder / "wrong").write_text("mapless_unknown")
    (folder / "read").write_text(create_token(folder / "tokens.json", "reader", "default", "read", None))
    return folder


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningServer]:
    with serving(tmp_path_factory.mktemp("plain")) as server:
        yield server


@pytest.fixture(scope="module")
def guarded(tmp_path_factory: pytest.TempPathFactory, files: Path) -> Iterator[RunningServer]:
    """A server with TLS and tokens, and a scene."""
    data_dir = tmp_path_factory.mktemp("guarded")
    with serving(data_dir) as server, Client(server.address) as client:
        make_scene(client)
    tls: dict[str, Any] = {"tls_certificate": files / "tls.pem", "tls_key": files / "tls.key"}
    with serving(data_dir, tokens_file=files / "tokens.json", **tls) as server:
        yield server


def findings(capsys: pytest.CaptureFixture[str], address: str, *flags: object, code: int = 1) -> dict[str, Any]:
    """The findings, by check; the command ends with a code and prints no error."""
    ended, printed, error = run_client(capsys, "doctor", "--address", address, "--json", *flags)
    assert (ended, error) == (code, "")
    found = {it["check"]: it for it in json.loads(printed)}
    assert list(found) == CHECKS
    return found


def assert_stops(found: dict[str, Any], check: str, *texts: str) -> None:
    """All checks before this one are passed, it says what is wrong and what to do, and those after it are skipped."""
    position = CHECKS.index(check)
    states = [found[it]["state"] for it in CHECKS]
    assert states == ["ok"] * position + ["wrong"] + ["skipped"] * (len(CHECKS) - position - 1)
    said = f"{found[check]['message']}; {found[check]['advice']}"
    assert all(text in said for text in texts), said


def test_a_server_with_references_is_well(capsys: pytest.CaptureFixture[str], plain: RunningServer) -> None:
    found = findings(capsys, plain.address, code=0)
    assert found["query"]["state"] == "note"
    assert "no scene has references" in found["query"]["message"]
    with Client(plain.address) as client:
        make_scene(client, "hall", 2)
        found = findings(capsys, plain.address, code=0)
        client.delete_scene("hall")
    assert {it["state"] for it in found.values()} == {"ok"}
    assert "reference r0 of scene hall was localized" in found["query"]["message"]


def test_addresses_without_a_server(capsys: pytest.CaptureFixture[str]) -> None:
    with closing(socket.create_server(("127.0.0.1", 0))) as taken:
        free = taken.getsockname()[1]
        silent = findings(capsys, f"127.0.0.1:{free}", "--timeout", "0.5")
    assert_stops(silent, "protocol", "nothing answers")
    nothing = findings(capsys, f"127.0.0.1:{free}")
    assert_stops(nothing, "address", "Connection refused", "mapless-server serve")
    assert_stops(findings(capsys, "no.such.host.invalid:50051"), "address", "cannot be resolved", "spelling")


class Silent(http.server.BaseHTTPRequestHandler):
    """Answers in HTTP/1, and logs nothing."""

    def log_message(self, format: str, *args: object) -> None:
        pass


def test_a_port_that_speaks_http_1(capsys: pytest.CaptureFixture[str]) -> None:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Silent) as web:
        threading.Thread(target=web.serve_forever, daemon=True).start()
        found = findings(capsys, f"127.0.0.1:{web.server_port}")
        web.shutdown()
    assert_stops(found, "protocol", "does not speak gRPC")


def test_tls_on_one_side_only(
    capsys: pytest.CaptureFixture[str], plain: RunningServer, guarded: RunningServer, files: Path
) -> None:
    assert_stops(findings(capsys, plain.address, "--tls"), "protocol", "does not use TLS", "leave out --tls")
    assert_stops(findings(capsys, guarded.address), "protocol", "uses TLS", "--ca FILE")
    assert_stops(findings(capsys, guarded.address, "--tls"), "protocol", "not signed by a known authority")


def test_an_expired_certificate(capsys: pytest.CaptureFixture[str], files: Path) -> None:
    """The server is another program than ours, which does not start with its certificate."""
    expired = signed(OURS, "server", -2 * DAY, -DAY)
    server = grpc.server(ThreadPoolExecutor(1))
    credentials = grpc.ssl_server_credentials([(expired.key_pem, expired.certificate_pem)])
    port = server.add_secure_port("127.0.0.1:0", credentials)
    server.start()
    found = findings(capsys, f"127.0.0.1:{port}", "--ca", files / "ca.pem")
    server.stop(None).wait()
    assert_stops(found, "protocol", "has expired", "clock")


def test_tokens(capsys: pytest.CaptureFixture[str], guarded: RunningServer, files: Path) -> None:
    ca = ("--ca", files / "ca.pem")
    assert_stops(findings(capsys, guarded.address, *ca), "token", "TOKEN_MISSING", "--token-file")
    wrong = findings(capsys, guarded.address, *ca, "--token-file", files / "wrong")
    assert_stops(wrong, "token", "TOKEN_INVALID", "token create")
    reads = findings(capsys, guarded.address, *ca, "--token-file", files / "read")
    assert_stops(reads, "query", "ROLE_TOO_LOW", "role localize")


@pytest.mark.parametrize(("offset_s", "where"), [(3600.0, "ahead of"), (-90.0, "behind")])
def test_a_clock_that_is_wrong(
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    plain: RunningServer,
    offset_s: float,
    where: str,
) -> None:
    shifted = SimpleNamespace(time=lambda: time.time() + offset_s, monotonic=time.monotonic)
    monkeypatch.setattr(doctor, "time", shifted)
    found = findings(capsys, plain.address)
    assert found["clock"]["state"] == "wrong"
    assert f"is {abs(offset_s):.0f} s {where} the server's" in found["clock"]["message"]
    assert found["version"]["state"] == "ok"


def test_a_scene_that_is_misspelled(capsys: pytest.CaptureFixture[str], plain: RunningServer) -> None:
    with Client(plain.address) as client:
        make_scene(client, "hall")
        found = findings(capsys, plain.address, "--scene", "hal")
        client.delete_scene("hall")
    assert_stops(found, "query", "there is no scene 'hal'; did you mean 'hall'?")


def test_a_server_that_stops(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    with serving(tmp_path) as server, Client(server.address) as client, ThreadPoolExecutor(1) as thread:
        make_scene(client)
        with server.method.held():
            running = thread.submit(client.localize, PHOTO, CAMERA, "s")
            assert server.method.started.acquire(timeout=20)
            server.stop()
            while client.is_serving():
                time.sleep(0.02)
            found = findings(capsys, server.address)
        assert running.result(20)
    assert_stops(found, "services", "not serving: the server, ", "it stops")
