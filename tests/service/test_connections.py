"""Connections that never become ready for calls are counted, end soon, and take nothing from others."""

import resource
import socket
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path

import pytest
from support.servers import make_scene, serving
from support.waiting import wait_until

from mapless import Client
from mapless_server.rpc import descriptors

BEGUN = {"nothing": b"", "half a preface": b"PRI * HTTP/2.0\r\n", "a preface": b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n"}
COUNT = 40


def test_connections_that_are_never_ready_end_and_disturb_nobody(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(descriptors, "HANDSHAKE_S", 2.0)
    monkeypatch.setattr(descriptors, "SHORT_HANDSHAKE_S", 2.0)
    with serving(tmp_path) as server, Client(server.address) as client, ExitStack() as stack:
        make_scene(client)
        host, _, port = server.address.rpartition(":")
        strangers = []
        for i in range(COUNT):
            connection = stack.enter_context(socket.create_connection((host, int(port)), timeout=20))
            connection.send([*BEGUN.values()][i % len(BEGUN)])
            strangers.append(connection)
        assert server.value("mapless_open_connections") >= COUNT
        with Client(server.address) as other:
            assert [it.scene_id for it in other.list_scenes()] == ["s"]
        for connection in strangers:
            while connection.recv(1024):  # the server's own part of the preface
                pass
        wait_until(lambda: server.value("mapless_open_connections") < COUNT)
        assert server.value("mapless_max_connections") == descriptors.most_connections()


def test_the_soft_limit_of_descriptors_becomes_the_hard_one() -> None:
    """And connections leave a part of it to all else."""
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if hard != resource.RLIM_INFINITY and hard < 1024:
        pytest.skip(f"the hard limit is {hard}")
    code = (
        "import resource\n"
        "resource.setrlimit(resource.RLIMIT_NOFILE, (256, 1024))\n"
        "from mapless_server.rpc import descriptors as it\n"
        "it.raise_limit()\n"
        "print(resource.getrlimit(resource.RLIMIT_NOFILE)[0], it.most_connections(), it.handshake_s())\n"
    )
    ran = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=120, check=True)
    assert ran.stdout.split() == ["1024", "768", "3.0"]
    assert "raise the hard limit" in ran.stderr
