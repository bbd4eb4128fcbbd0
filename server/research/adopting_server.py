"""A server in this process whose days pass as a program says, so that weeks of photographs are adopted in minutes."""

import asyncio
import re
import socket
import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import datetime, timedelta, timezone
from functools import partial
from pathlib import Path
from urllib.request import urlopen

from mapless_server.serve.adoption.adopter import Adopter
from mapless_server.serve.opening import make_engine
from mapless_server.serve.running import Running, running_server
from mapless_server.settings import Settings

KEPT_HOURS = 8784.0
"""A year: as long as captured calls may be kept."""
QUIET_S = 0.02
"""A photograph is considered so soon after its answer; the program asks for nothing meanwhile."""
START_S, STOP_S = 300.0, 60.0
CONSIDERING_S = 300.0
"""Longest time for considering a photograph; the machine may be busy."""


@dataclass
class Calendar:
    """The adopter's clock: so many days after the program's start."""

    day: float = 0.0
    start: datetime = field(default_factory=lambda: datetime.now(timezone.utc))

    def now(self) -> datetime:
        """The time on this day."""
        return self.start + timedelta(days=self.day)


@dataclass(frozen=True)
class MetricsPage:
    """The metrics of a server, at a port of this machine."""

    port: int

    def counts(self, name: str, label: str) -> dict[str, int]:
        """Values of a counter, by those of its label."""
        with urlopen(f"http://127.0.0.1:{self.port}/metrics", timeout=60) as page:
            found = re.findall(rf'{name}\{{[^}}]*{label}="(\w+)"[^}}]*\}} (\S+)', page.read().decode())
        counts = dict[str, int]()
        for value, count in found:
            counts[value] = counts.get(value, 0) + round(float(count))
        return counts

    @property
    def outcomes(self) -> dict[str, int]:
        """Photographs that were considered, by what became of them."""
        return self.counts("mapless_adoptions_total", "result")

    @property
    def considered(self) -> int:
        """Photographs that were considered."""
        return sum(self.outcomes.values())

    def wait_for(self, count: int) -> None:
        """Returns when so many were considered; TimeoutError after `CONSIDERING_S`."""
        end_s = time.monotonic() + CONSIDERING_S
        while self.considered < count:
            if time.monotonic() > end_s:
                raise TimeoutError(f"the server has considered {self.considered} photographs, not {count}")
            time.sleep(0.2)


def free_port() -> int:
    """A port that no program listens on."""
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return int(found.getsockname()[1])


@contextmanager
def adopting_server(data_dir: Path, calendar: Calendar) -> Iterator[Running]:
    """Runs a server with the settings of the environment in a thread, until the block is left."""
    settings = Settings(host="127.0.0.1", port=0, data_dir=data_dir, metrics_port=0, capture_hours=KEPT_HOURS)
    started: Future[Running] = Future()
    loop, stopping = asyncio.new_event_loop(), asyncio.Event()
    adopting = partial(Adopter, quiet_s=QUIET_S, now=calendar.now)

    async def run() -> None:
        async with running_server(settings, make_engine, adopting=adopting) as running:
            started.set_result(running)
            await stopping.wait()

    def run_loop() -> None:
        try:
            loop.run_until_complete(run())
        except BaseException as error:
            if started.done():
                raise
            started.set_exception(error)
        finally:
            loop.close()

    thread = threading.Thread(target=run_loop, name="server")
    thread.start()
    try:
        yield started.result(START_S)
    finally:
        if not loop.is_closed():
            loop.call_soon_threadsafe(stopping.set)
        thread.join(STOP_S)
