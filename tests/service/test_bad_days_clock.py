"""The wall clock jumps by hours, as after a wrong time was set: only dates are affected.

A real server runs with a library that moves its wall clock alone (`tests/support/wall_clock.c`). Deadlines, queues,
rates and the detection of hanging stages must use the monotonic clock, which the system never sets.
"""

import json
import shutil
import subprocess
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from support import programs
from support.programs import Program, program
from support.servers import CAMERA, PHOTO, pose
from support.waiting import wait_until

from mapless import Client, ConnectOptions, DeadlineExceeded, LocalizationResult, NewReference, Unauthenticated
from mapless_server.security import create_token

JUMPS_H = ((5.0, 2.0), (-7.0, 12.0))
"""And the deadline of a call meanwhile, seconds: the server learns from the first what calls take."""
COMPILER = shutil.which("cc") or shutil.which("gcc")

pytestmark = pytest.mark.skipif(COMPILER is None, reason="needs a C compiler")


class Clock:
    """The wall clock of a server."""

    def __init__(self, folder: Path) -> None:
        self._file, self._library = folder / "clock", folder / "wall_clock.so"
        self.set(0.0)
        source = Path(programs.__file__).with_name("wall_clock.c")
        command = [str(COMPILER), "-O1", "-shared", "-fPIC", "-o", str(self._library), str(source)]
        subprocess.run(command, check=True, timeout=60)

    def set(self, hours: float) -> None:
        """From now on it is off by so much."""
        new = self._file.with_suffix(".new")
        new.write_text(f"{3600 * hours:.0f}")
        new.rename(self._file)

    @property
    def environment(self) -> dict[str, Any]:
        """A process with this clock."""
        return {"LD_PRELOAD": str(self._library), "WALL_CLOCK_FILE": str(self._file)}


@contextmanager
def jumping(folder: Path, **settings: object) -> Iterator[tuple[Program, Clock]]:
    """The program whose method waits for the gate, and its clock."""
    folder.mkdir()
    clock = Clock(folder)
    given = [f"{name}={value}" for name, value in settings.items()]
    with program(folder, [*programs.GATED, str(folder), "asks", *given], **clock.environment) as server:
        yield server, clock


def has_begun(server: Program, calls: int) -> bool:
    return server.began >= calls


@pytest.mark.nightly
def test_jumps_of_the_wall_clock_change_no_deadline(tmp_path: Path) -> None:
    settings = {"workers": 2, "tenant_rate_ms": 100_000, "max_queued_s": 1000, "stall_limit_s": 40}
    with (
        ThreadPoolExecutor(2) as pool,
        jumping(tmp_path / "server", **settings) as (server, clock),
        Client(server.address, ConnectOptions(max_attempts=1)) as client,
    ):
        client.create_scene("s")
        client.add_reference("s", NewReference("first", PHOTO, CAMERA, pose(0)))
        created: list[tuple[float, datetime]] = []
        for hours, hurry_s in JUMPS_H:
            (server.folder / "gate").unlink(missing_ok=True)
            began = server.began
            waits = pool.submit(client.localize, PHOTO, CAMERA, "s", timeout_s=59.0)
            wait_until(partial(has_begun, server, began + 1))
            hurries = pool.submit(client.localize, PHOTO, CAMERA, "s", timeout_s=hurry_s)
            wait_until(partial(has_begun, server, began + 2))
            clock.set(hours)  # both are in the middle of their calls
            begun_s = time.monotonic()
            assert isinstance(hurries.exception(30), DeadlineExceeded)
            assert time.monotonic() - begun_s < 30
            server.open_gate()
            assert isinstance(waits.result(60), LocalizationResult)
            new = client.add_reference("s", NewReference(f"r{len(created)}", PHOTO, CAMERA, pose(0)))
            created.append((hours, new.create_time))
            assert client.is_serving()
        now = datetime.now(timezone.utc)
        for hours, time_of_creation in created:
            assert abs(time_of_creation - (now + timedelta(hours=hours))) < timedelta(minutes=10)
        assert server.process.poll() is None
        assert all(json.loads(line)["ts"] for line in server.log.splitlines() if line.startswith("{"))


def test_a_token_expires_by_the_wall_clock_and_may_return(tmp_path: Path) -> None:
    tokens = tmp_path / "tokens"
    token = create_token(tokens, "robot", "default", "write", datetime.now(timezone.utc) + timedelta(hours=2))
    with (
        jumping(tmp_path / "server", tokens_file=tokens) as (server, clock),
        Client(server.address, ConnectOptions(max_attempts=1, token=token)) as client,
    ):
        client.create_scene("s")
        clock.set(5.0)
        with pytest.raises(Unauthenticated) as caught:
            client.get_scene("s")
        assert caught.value.reason == "TOKEN_EXPIRED"
        clock.set(-7.0)
        assert client.get_scene("s").reference_count == 0
