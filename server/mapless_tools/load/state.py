"""What a server holds at a moment, seen from outside: from /proc, from its data folder, and from its own metrics."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, fields
from pathlib import Path

from .scrape import LOOP_LAG, Series, read_series
from .watch import read_process


@dataclass(frozen=True)
class ServerState:
    """A server at a moment.

    Attributes:
        at_s: by the event loop's clock.
        resident_mib: memory, with what it shares with other processes.
        unique_mib: memory that would be free without it.
        python_blocks: pieces of memory that Python's objects hold, whatever the allocator keeps beside.
        threads: how many.
        descriptors: open files and sockets.
        sockets: of these, sockets.
        data_mib: the data folder on the disk.
        waiting_jobs: in the queue.
        loop_lag_ms: how late timers of the event loop ran, on average since the moment before.
        cpu_s: used so far.
    """

    at_s: float
    resident_mib: float
    unique_mib: float
    python_blocks: float
    threads: float
    descriptors: float
    sockets: float
    data_mib: float
    waiting_jobs: float
    loop_lag_ms: float
    cpu_s: float


FIELDS = tuple(field.name for field in fields(ServerState) if field.name != "at_s")


@dataclass(frozen=True)
class Watched:
    """Whose state is looked at: the process, its metrics ("host:port"), and its data folder."""

    process_id: int
    metrics_address: str
    data_dir: Path


def read_state(watched: Watched, at_s: float, before: Series | None) -> tuple[ServerState, Series]:
    """The state now, and what the metrics said, for the next time.

    Raises:
        OSError: the process is gone, or its metrics do not answer.
    """
    process = read_process(watched.process_id, at_s)
    folder = Path(f"/proc/{watched.process_id}")
    series = read_series(watched.metrics_address)
    late_s, times = (
        series.total(f"{LOOP_LAG}_{what}") - (before.total(f"{LOOP_LAG}_{what}") if before else 0.0)
        for what in ("sum", "count")
    )
    state = ServerState(
        at_s=at_s,
        resident_mib=process.resident_mib,
        unique_mib=_unique_mib(folder),
        python_blocks=series.total("mapless_python_allocated_blocks"),
        threads=process.threads,
        descriptors=process.descriptors,
        sockets=_sockets(folder),
        data_mib=_size_mib(watched.data_dir),
        waiting_jobs=series.total("mapless_queue_depth"),
        loop_lag_ms=1000 * late_s / times if times else 0.0,
        cpu_s=process.cpu_s,
    )
    return state, series


@asynccontextmanager
async def states(watched: Watched, every_s: float) -> AsyncIterator[list[ServerState]]:
    """States of a server until the block is left: one at once, then one every so often."""
    loop = asyncio.get_running_loop()
    first, series = await asyncio.to_thread(read_state, watched, loop.time(), None)
    found = [first]

    async def keep_looking() -> None:
        nonlocal series
        due_s = loop.time()
        while True:
            due_s += every_s
            await asyncio.sleep(max(0.0, due_s - loop.time()))
            state, series = await asyncio.to_thread(read_state, watched, loop.time(), series)
            found.append(state)

    looking = asyncio.create_task(keep_looking())
    try:
        yield found
    finally:
        looking.cancel()
        (ended,) = await asyncio.gather(looking, return_exceptions=True)
        if not isinstance(ended, asyncio.CancelledError):
            raise RuntimeError("the server could not be watched any more") from ended


def column(samples: Sequence[ServerState], field: str) -> list[float]:
    """One of `FIELDS` of all states."""
    return [float(getattr(sample, field)) for sample in samples]


def _unique_mib(folder: Path) -> float:
    lines = (folder / "smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith("Private_")) / 1024


def _sockets(folder: Path) -> int:
    count = 0
    for descriptor in os.listdir(folder / "fd"):
        with suppress(FileNotFoundError):  # it has just been closed
            count += os.readlink(folder / "fd" / descriptor).startswith("socket:")
    return count


def _size_mib(folder: Path) -> float:
    size_bytes = 0
    for path in folder.rglob("*"):
        with suppress(FileNotFoundError):
            size_bytes += path.stat().st_size
    return size_bytes / 2**20
