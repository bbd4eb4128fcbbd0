"""A server as a child process: one that does not start is an error, and every one ends."""

import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from pydantic import SecretStr

from bench.search_path import with_search_path
from mapless import Client
from mapless_server.store.sqlite import DATABASE_FILE
from mapless_tools import child


def start_instead(monkeypatch: pytest.MonkeyPatch, program: str) -> list[subprocess.Popen[str]]:
    """Children run this program in place of a server; returns those that were started."""
    real, started = subprocess.Popen, []

    def popen(command: list[str], **options: Any) -> subprocess.Popen[str]:
        started.append(real([sys.executable, "-c", program], **options))
        return started[-1]

    monkeypatch.setattr("mapless_tools.child.subprocess.Popen", popen)
    return started


def test_a_server_that_does_not_start_is_reported(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    started = start_instead(monkeypatch, "import sys; sys.exit(7)")
    with pytest.raises(child.ServerFailed, match="exit code 7"), child.child_server(tmp_path):
        pass
    assert started[0].poll() == 7


def test_a_child_s_store_is_the_one_it_is_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Not the one of the environment: a measurement in a folder of its own must not write to a shared database."""
    asked: list[tuple[list[str], dict[str, str]]] = []

    def popen(command: list[str], env: dict[str, str], **_: Any) -> subprocess.Popen[str]:
        asked.append((command, env))
        raise child.ServerFailed

    monkeypatch.setattr("mapless_tools.child.subprocess.Popen", popen)
    monkeypatch.setenv("MAPLESS_DATABASE_URL", "postgresql://u:secret@theirs/db")
    for store in (tmp_path, SecretStr("postgresql://u:secret@ours/db")):
        with pytest.raises(child.ServerFailed), child.child_server(store):
            pass
    (command, _), (other_command, other_environment) = asked
    assert command[command.index("--data-dir") + 1] == str(tmp_path)
    assert "--data-dir" not in other_command
    assert "secret" not in " ".join(other_command)
    assert other_environment["MAPLESS_DATABASE_URL"] == "postgresql://u:secret@ours/db"


def test_a_log_file_has_the_output_of_a_child_that_failed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    log = tmp_path / "server.log"
    with (
        pytest.raises(child.ServerFailed, match=rf"is in {re.escape(str(log))}$"),
        child.child_server(tmp_path / "data", {"--workers": "none"}, log=log),
    ):
        pass
    assert "workers" in log.read_text()
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("module", [None, pytest.param("bench.load.no_op", marks=pytest.mark.nightly)])
def test_a_child_on_a_folder_does_not_reach_for_a_database(
    module: str | None, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    config = tmp_path / "mapless.toml"
    config.write_text('database_url = "postgresql://u:secret@127.0.0.1:1/db"\nwarm_up = false\n')
    monkeypatch.setenv("MAPLESS_CONFIG", str(config))
    monkeypatch.setenv("MAPLESS_DATABASE_URL", "postgresql://u:secret@127.0.0.1:1/db")
    data_dir = tmp_path / "data"
    data_dir.mkdir()
    started = (
        child.child_module(module, str(data_dir), environment=with_search_path())
        if module
        else child.child_server(data_dir)
    )
    with started as server, Client(server.address) as client:
        client.create_scene("mine")
        assert (data_dir / DATABASE_FILE).is_file()


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="finds the server's end in /proc")
def test_a_server_ends_with_a_tool_that_is_killed(tmp_path: Path) -> None:
    program = (
        "import os, signal, sys; from mapless_tools.child import child_module\n"
        "with child_module('bench.load.no_op', sys.argv[1]) as server:\n"
        "    print(server.process_id, flush=True); os.kill(os.getpid(), signal.SIGKILL)"
    )
    tool = subprocess.run(
        [sys.executable, "-c", program, str(tmp_path)],
        stdout=subprocess.PIPE,
        text=True,
        check=False,
        env=os.environ | with_search_path(),
    )
    assert tool.returncode == -signal.SIGKILL
    state = Path(f"/proc/{int(tool.stdout)}/stat")
    for _ in range(600):
        if not state.exists() or state.read_text().rpartition(")")[2].split()[0] == "Z":
            return
        time.sleep(0.1)
    os.kill(int(tool.stdout), signal.SIGKILL)
    pytest.fail("the server of a killed tool still runs after a minute")


def test_a_server_is_stopped_when_its_user_fails(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    announce = "print('mapless-server listening on 127.0.0.1:7', flush=True)"
    started = start_instead(monkeypatch, f"import time; {announce}; time.sleep(600)")

    def fail() -> None:
        with child.child_server(tmp_path) as server:
            raise ValueError(server.address)

    with pytest.raises(ValueError, match=r"127\.0\.0\.1:7"):
        fail()
    assert started[0].poll() is not None
