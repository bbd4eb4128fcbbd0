"""The cost of serving without computing: the largest rate of calls, and the latency beyond a bare gRPC server's."""

import asyncio
import os
import tempfile
from collections.abc import Mapping, Sequence
from contextlib import AsyncExitStack, ExitStack
from dataclasses import dataclass
from statistics import median
from typing import Any

from bench.search_path import with_search_path
from mapless import Client, RigidTransform
from mapless_server.bounds import check_bounds
from mapless_tools.child import ChildServer, child_module
from mapless_tools.demo import Photograph
from mapless_tools.output_files import markdown_table
from mapless_tools.progress import Progress, tracked

from . import no_op
from .driving import METHOD, photo_request, read_answer, store_references
from .echo import ECHO_METHOD, SHORT_METHOD
from .report import Check
from .sender import connected
from .step import Step, closed_loop_step
from .watch import ServerUnderLoad

MIN_CALLS_PER_S = 600.0
MAX_OVERHEAD_MS = 1.2
BARE, ECHO, MAPLESS = "bare, short answer", "bare echo", "mapless, no-op"


@dataclass(frozen=True)
class OverheadOptions:
    """Options of the comparison.

    A photograph of 0.3 MB is a phone's at 1024 px. The servers take turns in rounds, so that other work of the machine
    affects all alike. The concurrent calls are enough to keep a server busy, and no more than it admits.
    """

    message_bytes: int = 300_000
    rounds: int = 5
    unloaded_s: float = 2.0
    saturated_s: float = 3.0
    concurrency: int = 16
    clients: int = 4

    def __post_init__(self) -> None:
        check_bounds(self, "message_bytes rounds concurrency clients", at_least=1)
        check_bounds(self, "unloaded_s saturated_s", above=0)


@dataclass(frozen=True, eq=False)
class Subject:
    """A compared server with its steps, one per round."""

    name: str
    unloaded: list[Step]
    saturated: list[Step]

    @property
    def p50_ms(self) -> float:
        """Median latency of sequential calls, milliseconds, in the median round."""
        return median(self.p50s_ms)

    @property
    def p50s_ms(self) -> list[float]:
        """Median latency of sequential calls in each round, milliseconds."""
        return [step.account.answers.p50_ms or 0.0 for step in self.unloaded]

    @property
    def p99_ms(self) -> float:
        """99th percentile of the latency of sequential calls, milliseconds, in the median round."""
        return median(step.account.answers.p99_ms or 0.0 for step in self.unloaded)

    @property
    def own_share(self) -> float:
        """Share of one core that the generator used at saturation, in the median round."""
        return median(step.own_share for step in self.saturated)

    @property
    def calls_per_s(self) -> float:
        """Rate at saturation in the median round."""
        return median(step.account.completed_per_s for step in self.saturated)


@dataclass(frozen=True)
class Called:
    """A server, the method that is called, and the expected outcome of every call; empty for any."""

    address: str
    process_id: int
    method: str = METHOD
    outcome: str = "rejected LOW_TEXTURE"


def measure_overhead(options: OverheadOptions, progress: Progress) -> list[Subject]:
    """Starts the bare server and the one that computes nothing, and calls them by turns."""
    with ExitStack() as stack:
        data_dir = stack.enter_context(tempfile.TemporaryDirectory(prefix="mapless-load-"))
        bare = stack.enter_context(child_module("bench.load.echo", environment=with_search_path()))
        ours = stack.enter_context(child_module("bench.load.no_op", data_dir, environment=with_search_path()))
        places = {
            BARE: Called(bare.address, bare.process_id, SHORT_METHOD, ""),
            ECHO: Called(bare.address, bare.process_id, ECHO_METHOD, ""),
            MAPLESS: Called(ours.address, ours.process_id),
        }
        return asyncio.run(compare_by_turns(places, _prepared(ours, options), options, progress))


def overhead_checks(subjects: Sequence[Subject]) -> list[Check]:
    """The bars; the server is compared with the bare one of equally short answers, the harder comparison."""
    by_name = {subject.name: subject for subject in subjects}
    ours, bare = by_name[MAPLESS], by_name[BARE]
    rounds = [a - b for a, b in zip(ours.p50s_ms, bare.p50s_ms, strict=True)]
    overhead = median(rounds)
    return [
        Check(
            "calls/s at saturation, no-op pipeline",
            f"{ours.calls_per_s:.0f}",
            f"at least {MIN_CALLS_PER_S:.0f}",
            ours.calls_per_s >= MIN_CALLS_PER_S,
        ),
        Check(
            "p50 overhead over a bare grpc.aio server, one call at a time",
            f"{overhead:.2f} ms (rounds {min(rounds):.2f} to {max(rounds):.2f})",
            f"at most {MAX_OVERHEAD_MS:g} ms",
            overhead <= MAX_OVERHEAD_MS,
        ),
    ]


def overhead_lines(subjects: Sequence[Subject], options: OverheadOptions) -> list[str]:
    """A table with a row for each server."""
    lines = [
        f"Messages of {options.message_bytes / 1e6:g} MB, {options.rounds} rounds by turns, "
        f"{options.concurrency} calls side by side from {options.clients} connections; "
        f"load average {os.getloadavg()[0]:.1f}:",
        "",
    ]
    rows = []
    for it in subjects:
        cpu_ms = median(1000 * step.cpu_s_per_answer for step in it.saturated)
        times = (f"{it.p50_ms:.2f}", f"{it.p99_ms:.2f}", f"{it.calls_per_s:.0f}", f"{cpu_ms:.2f}")
        rows.append((it.name, *times, f"{100 * it.own_share:.0f} %"))
    head = "server | p50 unloaded, ms | p99 unloaded, ms | calls/s | server CPU ms/call | generator's core"
    return [*lines, *markdown_table(head, rows), ""]


def overhead_figures(subjects: Sequence[Subject], options: OverheadOptions) -> dict[str, Any]:
    """The figures for programs."""
    servers = [{"p50_ms": it.p50_ms, "calls_per_s": it.calls_per_s, **vars(it)} for it in subjects]
    return {"options": options, "servers": servers}


def _prepared(server: ChildServer, options: OverheadOptions) -> bytes:
    photo = no_op.padded_photo(options.message_bytes)
    references = [Photograph(f"r{i}", photo, no_op.CAMERA, RigidTransform.identity()) for i in range(2)]
    with Client(server.address) as client:
        store_references(client, references)
    return photo_request(photo, no_op.CAMERA, [reference.name for reference in references])


async def compare_by_turns(
    places: Mapping[str, Called], request: bytes, options: OverheadOptions, progress: Progress
) -> list[Subject]:
    """Calls servers in rounds, one call at a time and many; RuntimeError if a call ends otherwise than expected."""
    subjects = {name: Subject(name, [], []) for name in places}
    async with AsyncExitStack() as stack:
        targets = {
            name: await stack.enter_async_context(
                connected(it.address, it.method, options.clients, 30.0, read_answer if it.outcome else lambda _: "")
            )
            for name, it in places.items()
        }

        async def step(name: str, concurrency: int, seconds: float) -> Step:
            server, title = ServerUnderLoad(places[name].process_id), f"{name}, {concurrency} at a time"
            it = await closed_loop_step(title, server, targets[name], [request], concurrency, seconds)
            if set(it.account.outcomes) != {f"OK {places[name].outcome}".strip()}:
                raise RuntimeError(f"{title}: calls ended as {dict(it.account.outcomes)}")
            if it.answers != it.account.sent:
                raise RuntimeError(f"{title}: calls came too late: {dict(it.account.fates)}")
            return it

        for name in places:
            await step(name, 4, 0.5)  # so that no round pays for the start
        for _ in tracked("overhead, rounds", range(options.rounds), options.rounds, progress):
            for name, subject in subjects.items():
                subject.unloaded.append(await step(name, 1, options.unloaded_s))
            for name, subject in subjects.items():
                subject.saturated.append(await step(name, options.concurrency, options.saturated_s))
    return list(subjects.values())
