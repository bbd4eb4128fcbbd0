"""The commands say on standard error what they wait for: a server that is away, and one that does not answer."""

import socket
import threading
import time
from pathlib import Path

import pytest
from support.clients import failing, status
from support.servers import CAMERA, PHOTO, make_scene, serving

from mapless import Client, ConnectOptions, MaplessError
from mapless.cli import waiting
from mapless.cli.waiting import WaitingClient


@pytest.fixture(autouse=True)
def short(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(waiting, "NOTICE_S", 0.3)


def test_a_server_that_is_away_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as unused:
        address = f"127.0.0.1:{unused.getsockname()[1]}"
    with WaitingClient(address, ConnectOptions(timeout_s=2.5)) as client, pytest.raises(MaplessError):
        client.get_scene("s")
    with (
        WaitingClient(address, ConnectOptions(timeout_s=30, connect_timeout_s=1.5)) as client,
        pytest.raises(MaplessError),
    ):
        client.get_scene("s")
    line, other = capsys.readouterr().err.splitlines()
    assert line.startswith(f"mapless: cannot connect to {address}: no server listens there")
    assert line.endswith("; trying for up to 2 s more")
    assert other.endswith("; trying for up to 1 s more")


def test_an_address_that_is_silent_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with (
            WaitingClient(address, ConnectOptions(timeout_s=2.5), "tool") as client,
            pytest.raises(MaplessError, match=f"no connection to {address} in time"),
        ):
            client.get_scene("s")
    assert capsys.readouterr().err.startswith(f"tool: no connection to {address} yet; trying for up to ")


def test_a_server_that_is_at_its_limit_is_said(capsys: pytest.CaptureFixture[str]) -> None:
    with (
        failing([status("RESOURCE_EXHAUSTED", 0.5)]) as (address, _),
        WaitingClient(address, ConnectOptions()) as client,
    ):
        assert [*client.list_scenes()] == []
    assert capsys.readouterr().err.startswith("mapless: planted; trying for up to ")


def test_a_server_that_computes_is_not_waited_for(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with serving(tmp_path) as server:
        with Client(server.address) as client:
            make_scene(client)
        server.method.gate.clear()
        opening = threading.Timer(2.0, server.method.gate.set)
        opening.start()
        begin_s = time.monotonic()
        with WaitingClient(server.address, ConnectOptions()) as client:
            client.localize(PHOTO, CAMERA, "s")
        assert time.monotonic() - begin_s > 1.5
    assert capsys.readouterr().err == ""
