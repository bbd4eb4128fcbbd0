"""Observes a server from outside: its metrics, its process in /proc, and its data folder."""

import asyncio
import math
import os
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Mapping, Sequence
from contextlib import asynccontextmanager, contextmanager, suppress
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TypeVar

from prometheus_client.parser import text_string_to_metric_families

from mapless.addresses import is_loopback

TIMEOUT_S = 30.0  # one late scrape on a busy machine must not end a soak
LOCALIZE = "Localize"
LOOP_LAG = "mapless_event_loop_lag_seconds"


@dataclass(frozen=True)
class Scrape:
    """Metrics at one time, or the difference of two.

    `started` calls of Localize began, and `handled` ended, by status; admitted jobs ended by outcome. `lag_buckets` are
    cumulative numbers of the event loop's delays, by upper edge, seconds; `totals` the sum of each metric over its
    labels.
    """

    started: int
    handled: Mapping[str, int]
    terminated: Mapping[str, int]
    lag_buckets: Mapping[float, int]
    totals: Mapping[str, float] = field(default_factory=dict)

    def since(self, before: "Scrape") -> "Scrape":
        """The difference from an earlier time."""
        return Scrape(
            self.started - before.started,
            _difference(self.handled, before.handled),
            _difference(self.terminated, before.terminated),
            {edge: number - before.lag_buckets.get(edge, 0) for edge, number in self.lag_buckets.items()},
            {name: value - before.totals.get(name, 0.0) for name, value in self.totals.items()},
        )

    @property
    def longest_lag_s(self) -> float | None:
        """Upper bound of the event loop's delays; infinite beyond the last edge, None without the metric."""
        return self.lag_s(1.0)

    def lag_s(self, share: float) -> float | None:
        """Upper bound of this share of the delays, the shortest ones; as `longest_lag_s`."""
        total = self.lag_buckets.get(math.inf, 0)
        if total == 0:
            return None
        return min(edge for edge, number in self.lag_buckets.items() if number >= share * total)

    @property
    def mean_lag_ms(self) -> float:
        """Mean delay of the event loop's timers, milliseconds; 0 if there were none."""
        count = self.totals.get(f"{LOOP_LAG}_count", 0.0)
        return 1000 * self.totals[f"{LOOP_LAG}_sum"] / count if count else 0.0


@dataclass(frozen=True)
class Reconciliation:
    """Comparison of the client's and the server's counts.

    All calls have ended for the client, but some perhaps not by the server's count (`running`). `missing` are calls, by
    a status that only a server can give, which the server did not count; `surplus` those that it counted beyond those
    that ended for the client and those it cancelled; `unseen` those that the client gave up before the server began
    with them.
    """

    sent: int
    handled: int
    running: int
    missing: Mapping[str, int]
    surplus: int
    unseen: int

    @property
    def complete(self) -> bool:
        """Whether all calls are accounted for."""
        return not self.missing and self.surplus == 0 and self.running == 0 and self.unseen >= 0


def read_metrics(address: str) -> Scrape | None:
    """Reads the server's metrics; None if it serves no metrics, OSError if it does not answer."""
    proxies = urllib.request.ProxyHandler({} if is_loopback(address) else None)
    try:
        with urllib.request.build_opener(proxies).open(f"http://{address}/metrics", timeout=TIMEOUT_S) as response:
            return parse_metrics(response.read().decode())
    except urllib.error.URLError as error:
        if isinstance(error.reason, ConnectionRefusedError):
            return None
        raise


def parse_metrics(page: str) -> Scrape:
    """Parses a page of metrics."""
    started = 0
    handled: Counter[str] = Counter()
    terminated: Counter[str] = Counter()
    lag: Counter[float] = Counter()
    totals: dict[str, float] = {}
    for sample in (sample for family in text_string_to_metric_families(page) for sample in family.samples):
        value, labels = round(sample.value) if math.isfinite(sample.value) else 0, sample.labels
        totals[sample.name] = totals.get(sample.name, 0.0) + sample.value
        if sample.name == "grpc_server_started_total" and labels["grpc_method"] == LOCALIZE:
            started += value
        elif sample.name == "grpc_server_handled_total" and labels["grpc_method"] == LOCALIZE:
            handled[labels["grpc_code"]] += value
        elif sample.name == "mapless_jobs_terminated_total":
            terminated[labels["outcome"]] += value
        elif sample.name == f"{LOOP_LAG}_bucket":
            lag[float(labels["le"])] += value
    return Scrape(started, dict(handled), dict(terminated), dict(lag), totals)


def reconcile(codes: Sequence[str], server: Scrape) -> Reconciliation:
    """Compares the statuses of a client's calls with the server's counts in the same time.

    The two may differ in calls that the client gave up, by cancelling or at their deadline: the server may have
    finished these already, or never have begun.
    """
    counts = Counter(codes)
    given_up = counts["CANCELLED"] + counts["DEADLINE_EXCEEDED"]
    certain = {code: number for code, number in counts.items() if code not in ("CANCELLED", "DEADLINE_EXCEEDED")}
    missing = {code: n - server.handled.get(code, 0) for code, n in certain.items() if n > server.handled.get(code, 0)}
    handled = sum(server.handled.values())
    others = handled - sum(min(n, server.handled.get(code, 0)) for code, n in certain.items())
    return Reconciliation(
        sent=len(codes),
        handled=handled,
        running=server.started - handled,
        missing=missing,
        surplus=max(0, others - given_up),
        unseen=given_up - others,
    )


def _difference(after: Mapping[str, int], before: Mapping[str, int]) -> dict[str, int]:
    return {key: number - before.get(key, 0) for key, number in after.items() if number != before.get(key, 0)}


T = TypeVar("T")

SAMPLE_EVERY_S = 1.0
NICENESS_STEP = 5


@dataclass(frozen=True)
class ServerUnderLoad:
    """The process of the server that is measured, and its metrics and data folder, if they are observed."""

    process_id: int
    metrics_address: str = ""
    data_dir: Path = Path()

    def scrape(self) -> Scrape | None:
        """Reads its metrics; None if it serves none."""
        return read_metrics(self.metrics_address) if self.metrics_address else None


@dataclass(frozen=True)
class ProcessSample:
    """A process at one time, by the event loop's clock.

    Memory includes what is shared with other processes, descriptors are open files and sockets; processor time is that
    of all its threads so far, in steps of 0.01 s.
    """

    at_s: float
    resident_mib: float
    threads: int
    descriptors: int
    cpu_s: float


@dataclass(frozen=True)
class ServerState(ProcessSample):
    """The state of a server at one time: its process, and more.

    `unique_mib` would be free without it; `python_blocks` are memory blocks that Python's objects use; `loop_lag_ms` is
    the mean delay of the event loop's timers since the previous state.
    """

    unique_mib: float
    python_blocks: float
    sockets: int
    data_mib: float
    waiting_jobs: float
    loop_lag_ms: float


FIELDS = tuple(field.name for field in fields(ServerState) if field.name != "at_s")


def read_process(process_id: int, at_s: float) -> ProcessSample:
    """Samples the process now; OSError if it has ended, or the system has no /proc."""
    folder = Path(f"/proc/{process_id}")
    status = dict(line.split(":", 1) for line in (folder / "status").read_text().splitlines())
    # The name, in parentheses, may hold anything; user and system time are the 14th and 15th field of all.
    times = (folder / "stat").read_text().rpartition(")")[2].split()[11:13]
    return ProcessSample(
        at_s=at_s,
        resident_mib=int(status["VmRSS"].split()[0]) / 1024,
        threads=int(status["Threads"]),
        descriptors=len(os.listdir(folder / "fd")),
        cpu_s=sum(map(int, times)) / os.sysconf("SC_CLK_TCK"),
    )


def read_state(server: ServerUnderLoad, at_s: float, before: Scrape | None) -> tuple[ServerState, Scrape]:
    """The present state, and the metrics for the next call; OSError if the process has ended or does not answer."""
    process, folder = read_process(server.process_id, at_s), Path(f"/proc/{server.process_id}")
    scrape = server.scrape()
    if scrape is None:
        raise ConnectionRefusedError(f"there are no metrics on {server.metrics_address}")
    state = ServerState(
        **vars(process),
        unique_mib=_unique_mib(folder),
        python_blocks=scrape.totals.get("mapless_python_allocated_blocks", 0.0),
        sockets=_sockets(folder),
        data_mib=_size_mib(server.data_dir),
        waiting_jobs=scrape.totals.get("mapless_queue_depth", 0.0),
        loop_lag_ms=(scrape if before is None else scrape.since(before)).mean_lag_ms,
    )
    return state, scrape


@asynccontextmanager
async def process_samples(process_id: int, every_s: float = SAMPLE_EVERY_S) -> AsyncIterator[list[ProcessSample]]:
    """Samples a process: once at the beginning, once at the end of the block, and regularly in between."""
    loop = asyncio.get_running_loop()
    async with _sampled(lambda: read_process(process_id, loop.time()), every_s) as samples:
        yield samples
    samples.append(read_process(process_id, loop.time()))


@asynccontextmanager
async def server_states(server: ServerUnderLoad, every_s: float) -> AsyncIterator[list[ServerState]]:
    """Reads states of a server until the end of the block: once at the beginning, then regularly."""
    loop = asyncio.get_running_loop()
    before: Scrape | None = None

    def read() -> ServerState:
        nonlocal before
        state, before = read_state(server, loop.time(), before)
        return state

    async with _sampled(read, every_s) as states:
        yield states


@asynccontextmanager
async def _sampled(read: Callable[[], T], every_s: float) -> AsyncIterator[list[T]]:
    """Calls `read` in a thread, at once and then regularly; RuntimeError once it fails."""
    loop = asyncio.get_running_loop()
    samples = [await asyncio.to_thread(read)]

    async def keep_reading() -> None:
        due_s = loop.time()
        while True:
            due_s += every_s
            await asyncio.sleep(max(0.0, due_s - loop.time()))
            samples.append(await asyncio.to_thread(read))

    reading = asyncio.create_task(keep_reading())
    try:
        yield samples
    finally:
        reading.cancel()
        (ended,) = await asyncio.gather(reading, return_exceptions=True)
        if not isinstance(ended, asyncio.CancelledError):
            raise RuntimeError("the server can no longer be watched") from ended


def column(samples: Sequence[ServerState], field: str) -> list[float]:
    """One of `FIELDS` of all states."""
    return [float(getattr(sample, field)) for sample in samples]


@contextmanager
def priority_over(process_id: int) -> Iterator[None]:
    """Gives this process priority over another one until the end of the block; OSError if that has ended.

    Real callers are on other machines; here, a generator that waits for a core would count its own waiting as the
    server's. If permitted, this process raises its own priority; else it lowers the other's, below that of all others.
    """
    own_id = os.getpid()
    try:
        _add_niceness(own_id, -NICENESS_STEP)
    except PermissionError:
        _add_niceness(process_id, NICENESS_STEP)
        yield
        return
    try:
        yield
    finally:
        _add_niceness(own_id, NICENESS_STEP)


def _add_niceness(process_id: int, added: int) -> None:
    """Changes the niceness of all threads, of which some have a higher one; those that they start later inherit it."""
    for thread in map(int, os.listdir(f"/proc/{process_id}/task")):
        with suppress(ProcessLookupError):  # it has just ended
            os.setpriority(os.PRIO_PROCESS, thread, os.getpriority(os.PRIO_PROCESS, thread) + added)


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
