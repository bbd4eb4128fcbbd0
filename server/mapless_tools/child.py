"""The real server as a child process on the loopback interface. It ends with this process, however that ends."""

import os
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from pydantic import SecretStr

from mapless import Client, ConnectOptions
from mapless_server.settings import PREFIX

START_TIMEOUT_S = 120.0
GRACE_S = 1.0
_ANNOUNCEMENT = "mapless-server listening on "


ATTEMPTS = 4
"""Attempts of each call of its clients: a child that has ended does not come back."""

CONNECT = ConnectOptions(timeout_s=600.0, upload_timeout_s=3600.0, batch_count=8, max_attempts=ATTEMPTS)
"""For measuring: a late answer is measured, too, and photographs may be large."""


class ServerFailed(Exception):
    """The server did not start; the reason is on standard error."""


@dataclass(frozen=True)
class Memory:
    """Memory of a process, at present and at most so far (VmHWM)."""

    resident_mib: float
    peak_mib: float


@dataclass(frozen=True)
class ChildServer:
    """A running server."""

    address: str
    process_id: int

    def memory(self) -> Memory | None:
        """Memory of the process; None without /proc."""
        try:
            status = Path(f"/proc/{self.process_id}/status").read_text()
        except OSError:
            return None
        fields = dict(line.split(":", 1) for line in status.splitlines())
        if "VmRSS" not in fields or "VmHWM" not in fields:
            return None
        return Memory(int(fields["VmRSS"].split()[0]) / 1024, int(fields["VmHWM"].split()[0]) / 1024)


@contextmanager
def child_server(
    store: Path | SecretStr,
    more_flags: Mapping[str, str] | None = None,
    environment: Mapping[str, str] | None = None,
    log: Path | None = None,
) -> Iterator[ChildServer]:
    """Runs a server on a free port of the loopback interface until the end of the block.

    It uses the settings of the environment, except its address, its store (a data folder, or the URL of a database that
    servers share), and those of `more_flags` of the command `serve`. Its log is appended to a file, by default to this
    process's standard error. ServerFailed if it ended, or did not listen within `START_TIMEOUT_S`.
    """
    flags = {
        "--host": "127.0.0.1",
        "--port": "0",
        "--log-level": "warning",
        "--log-format": "text",
        "--drain-grace-s": str(GRACE_S),
        "--metrics-port": "0",
    } | dict(more_flags or {})
    environment = dict(environment or {})
    if isinstance(store, Path):
        flags["--data-dir"] = str(store)  # as a flag, it stands above any database of the environment
    else:
        environment[f"{PREFIX}DATABASE_URL"] = store.get_secret_value()  # all users can read a command line
    arguments = [part for flag in flags.items() for part in flag]
    with child_module("mapless_tools", "serve", *arguments, environment=environment, log=log) as server:
        yield server


@contextmanager
def temporary_server() -> Iterator[Client]:
    """A client of a server with an empty store, both removed at the end of the block. Errors as in `child_server`."""
    with (
        tempfile.TemporaryDirectory(prefix="mapless-") as data_dir,
        child_server(Path(data_dir)) as server,
        Client(server.address, CONNECT) as client,
    ):
        yield client


@contextmanager
def child_module(
    module: str, *arguments: str, environment: Mapping[str, str] | None = None, log: Path | None = None
) -> Iterator[ChildServer]:
    """Runs a module as a server that prints its address as `mapless-server serve` does; see `child_server`."""
    with nullcontext() if log is None else log.open("ab") as errors:
        process = subprocess.Popen(
            [sys.executable, "-m", "mapless_tools.with_parent", module, *arguments],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=errors,
            text=True,
            env=os.environ | (environment or {}),
        )
    try:
        yield ChildServer(_read_address(process, "above" if log is None else f"in {log}"), process.pid)
    finally:
        process.terminate()
        try:
            process.wait(GRACE_S + 30)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
        for pipe in filter(None, (process.stdin, process.stdout)):
            pipe.close()


def _read_address(process: subprocess.Popen[str], where: str) -> str:
    assert process.stdout is not None
    # Reading a pipe has no deadline; a child that is gone ends it.
    deadline = threading.Timer(START_TIMEOUT_S, process.kill)
    deadline.daemon = True
    deadline.start()
    try:
        for line in process.stdout:
            if line.startswith(_ANNOUNCEMENT):
                return line.removeprefix(_ANNOUNCEMENT).strip()
        was_late = deadline.finished.is_set()
    finally:
        deadline.cancel()
    if was_late:
        raise ServerFailed(f"the server was not ready within {START_TIMEOUT_S:g} s; is the machine busy?")
    raise ServerFailed(f"the server did not start (exit code {process.wait()}); its own message is {where}")
