"""A server as a child process: it is told apart from one that does not start, and always ends."""

import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from mapless_server import child


def start_instead(monkeypatch: pytest.MonkeyPatch, program: str) -> list[subprocess.Popen[str]]:
    """Children run this program in place of a server; returns those that were started."""
    real, started = subprocess.Popen, []

    def popen(command: list[str], **options: Any) -> subprocess.Popen[str]:
        started.append(real([sys.executable, "-c", program], **options))
        return started[-1]

    monkeypatch.setattr("mapless_server.child.subprocess.Popen", popen)
    return started


def test_a_server_that_does_not_start_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    started = start_instead(monkeypatch, "import sys; sys.exit(7)")
    with pytest.raises(child.ServerFailed, match="exit code 7"), child.child_server(tmp_path):
        pass
    assert started[0].poll() == 7


def test_a_server_is_stopped_when_its_user_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    announce = "print('mapless-server listening on 127.0.0.1:7', flush=True)"
    started = start_instead(monkeypatch, f"import time; {announce}; time.sleep(600)")

    def fail() -> None:
        with child.child_server(tmp_path) as server:
            raise ValueError(server.address)

    with pytest.raises(ValueError, match=r"127\.0\.0\.1:7"):
        fail()
    assert started[0].poll() is not None
