"""A server as its own process, which ends with the block that uses it."""

from __future__ import annotations

import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

START_TIMEOUT_S = 60.0
STOP_TIMEOUT_S = 20.0
READY = "mapless-server listening on "


@contextmanager
def running_server() -> Iterator[str]:
    """Start `mapless-server serve` on a free port with an empty store; gives its address, and always stops it.

    Raises:
        RuntimeError: it did not start; the message ends with its log.
    """
    with tempfile.TemporaryDirectory(prefix="mapless-demo-") as folder:
        log = Path(folder) / "server.log"
        command = [sys.executable, "-m", "mapless_server", "serve", "--host", "127.0.0.1", "--port", "0"]
        command += ["--data-dir", str(Path(folder) / "data")]
        with log.open("w") as log_file:
            process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=log_file, text=True)
        try:
            yield _address(process, log)
        finally:
            _stop(process)


def _stop(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.communicate(timeout=STOP_TIMEOUT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.communicate()


def _address(process: subprocess.Popen[str], log: Path) -> str:
    """The address that the server prints when it is ready; reading ends when the process does, or is made to."""
    assert process.stdout is not None
    alarm = threading.Timer(START_TIMEOUT_S, process.kill)
    alarm.start()
    try:
        for line in process.stdout:
            if line.startswith(READY):
                return line.removeprefix(READY).strip()
    finally:
        alarm.cancel()
    raise RuntimeError(f"the server did not start:\n{log.read_text()[-3000:]}")
