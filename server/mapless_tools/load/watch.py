"""What the server's process holds and uses, from /proc."""

from __future__ import annotations

import asyncio
import os
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

SAMPLE_EVERY_S = 1.0
NICENESS_STEP = 5


@dataclass(frozen=True)
class ProcessSample:
    """A process at one moment.

    Attributes:
        at_s: by the event loop's clock.
        resident_mib: memory.
        threads: how many.
        descriptors: open files and sockets.
        cpu_s: used so far by all its threads; the system counts in hundredths.
    """

    at_s: float
    resident_mib: float
    threads: int
    descriptors: int
    cpu_s: float


def read_process(process_id: int, at_s: float) -> ProcessSample:
    """The process now.

    Raises:
        OSError: it is gone, or the system has no /proc.
    """
    folder = Path(f"/proc/{process_id}")
    fields = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    # The name, in parentheses, may hold anything; user and system time are the 14th and 15th field of all.
    times = (folder / "stat").read_text().rpartition(")")[2].split()[11:13]
    return ProcessSample(
        at_s=at_s,
        resident_mib=int(fields["VmRSS"].split()[0]) / 1024,
        threads=int(fields["Threads"]),
        descriptors=len(os.listdir(folder / "fd")),
        cpu_s=sum(map(int, times)) / os.sysconf("SC_CLK_TCK"),
    )


@contextmanager
def going_first(process_id: int) -> Iterator[None]:
    """Lets this process go before another, where both want a core, until the block is left.

    Callers are elsewhere in earnest: one that waits for a core would take its own waiting for the server's. Only who
    may do so raises its own priority; else the other's is lowered, which lets everybody else go before it, too.

    Raises:
        OSError: the process is gone, or the system has no /proc.
    """
    own_id, own = os.getpid(), os.getpriority(os.PRIO_PROCESS, 0)
    try:
        _set_niceness(own_id, own - NICENESS_STEP)
    except PermissionError:
        _set_niceness(process_id, os.getpriority(os.PRIO_PROCESS, process_id) + NICENESS_STEP)
        yield
        return
    try:
        yield
    finally:
        _set_niceness(own_id, own)


@asynccontextmanager
async def watched(process_id: int, every_s: float = SAMPLE_EVERY_S) -> AsyncIterator[list[ProcessSample]]:
    """Samples of a process: one at once, one at the end of the block, and in between every so often."""
    loop = asyncio.get_running_loop()
    samples = [read_process(process_id, loop.time())]

    async def keep_reading() -> None:
        while True:
            await asyncio.sleep(every_s)
            samples.append(read_process(process_id, loop.time()))

    reading = asyncio.create_task(keep_reading())
    try:
        yield samples
    finally:
        reading.cancel()
        await asyncio.gather(reading, return_exceptions=True)
    samples.append(read_process(process_id, loop.time()))


def _set_niceness(process_id: int, niceness: int) -> None:
    """Of all threads; those they start later inherit it."""
    for thread in os.listdir(f"/proc/{process_id}/task"):
        with suppress(ProcessLookupError):  # it has just ended
            os.setpriority(os.PRIO_PROCESS, int(thread), niceness)
