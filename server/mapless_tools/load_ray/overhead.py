"""The cost of the ingress: one replica called through HAProxy and at its own port, and a plain server, by turns."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass
from statistics import median
from typing import Any

from mapless import Client
from mapless_tools.child import child_module
from mapless_tools.load import no_op
from mapless_tools.load.report import Check
from mapless_tools.load.requests import METHOD, SCENE, photo_request, read_answer
from mapless_tools.load.sender import Target, connected, send_closed_loop
from mapless_tools.load.step import Step, run_step
from mapless_tools.load.watch import ServerUnderLoad
from mapless_tools.progress import Progress

from .callers import Scenes
from .cluster import application, running_cluster
from .database import VARIABLE, database_url
from .replacing import NO_OP

MAX_OVERHEAD_MS = 3.0
THROUGH, DIRECT, PLAIN = "through HAProxy", "replica's own port", "plain server"
WORKERS = 2
_EXPECTED = {"OK rejected LOW_TEXTURE"}


@dataclass(frozen=True)
class OverheadOptions:
    """Options of the comparison.

    Attributes:
        message_bytes: size of the photograph; 0.3 MB is a phone's at 1024 px.
        rounds: number of turns, so that other load of the machine affects all ways alike.
        unloaded_s: time of calls one after the other, a round.
        saturated_s: time of parallel calls, a round.
        concurrency: number of parallel calls.
    """

    message_bytes: int = 300_000
    rounds: int = 10
    unloaded_s: float = 2.0
    saturated_s: float = 2.0
    concurrency: int = 16


@dataclass(frozen=True, eq=False)
class Way:
    """A way to call, with its steps, one a round."""

    name: str
    unloaded: list[Step]
    saturated: list[Step]

    @property
    def p50s_ms(self) -> list[float]:
        """Each round's median latency of one call at a time."""
        return [step.account.answers.p50_ms or 0.0 for step in self.unloaded]


def measure_overhead(options: OverheadOptions, progress: Progress) -> list[Way]:
    """Starts a replica with its ingress, and the plain server on the same database, and calls them by turns."""
    photo = no_op.padded_photo(options.message_bytes)
    names = ["r0", "r1"]
    request = photo_request(photo, no_op.CAMERA, names)
    with database_url() as url, running_cluster({VARIABLE: url}) as cluster:
        cluster.deploy(application({"insecure": True, "workers": WORKERS}, 1, import_path=NO_OP))
        with child_module("mapless_tools.load_ray.plain", str(WORKERS), environment={VARIABLE: url}) as plain:
            with Client(cluster.address) as client:
                client.create_scene(SCENE)
                client.add_references(SCENE, [Scenes(photo=photo).reference(name) for name in names])
            (replica,) = cluster.replicas()
            places = {
                THROUGH: (cluster.address, replica.process_id),
                DIRECT: (replica.address, replica.process_id),
                PLAIN: (plain.address, plain.process_id),
            }
            return asyncio.run(_compare(places, request, options, progress))


def overhead_checks(ways: list[Way]) -> list[Check]:
    """The bar."""
    by_name = {way.name: way.p50s_ms for way in ways}
    rounds = [a - b for a, b in zip(by_name[THROUGH], by_name[DIRECT], strict=True)]
    value = f"{median(rounds):.2f} ms (rounds {min(rounds):.2f} to {max(rounds):.2f})"
    bar, met = f"at most {MAX_OVERHEAD_MS:g} ms", median(rounds) <= MAX_OVERHEAD_MS
    return [Check("p50 overhead of the ingress, one call at a time", value, bar, met)]


def overhead_lines(ways: list[Way], options: OverheadOptions) -> list[str]:
    """A table with a row a way."""
    lines = [
        f"Messages of {options.message_bytes / 1e6:g} MB to a server that computes nothing, {options.rounds} rounds by "
        f"turns; load average {os.getloadavg()[0]:.1f}:",
        "",
        "| called | p50 of one at a time, ms | p99 of it, ms | calls/s with 16 in parallel | generator's core |",
        "|---|---|---|---|---|",
    ]
    for way in ways:
        p99 = median(step.account.answers.p99_ms or 0.0 for step in way.unloaded)
        per_s = median(step.account.completed_per_s for step in way.saturated)
        own = median(step.own_share for step in way.saturated)
        lines.append(f"| {way.name} | {median(way.p50s_ms):.2f} | {p99:.2f} | {per_s:.0f} | {100 * own:.0f} % |")
    return [*lines, ""]


def overhead_json(ways: list[Way], options: OverheadOptions) -> dict[str, Any]:
    """The figures for programs."""
    return {
        "options": vars(options),
        "ways": [
            {"name": way.name}
            | {kind: [step.as_json() for step in getattr(way, kind)] for kind in ("unloaded", "saturated")}
            for way in ways
        ],
    }


async def _compare(
    places: dict[str, tuple[str, int]], request: bytes, options: OverheadOptions, progress: Progress
) -> list[Way]:
    ways = {name: Way(name, [], []) for name in places}
    async with AsyncExitStack() as stack:
        targets = {
            name: await stack.enter_async_context(connected(address, METHOD, 4, 30.0, read_answer))
            for name, (address, _) in places.items()
        }

        async def step(name: str, concurrency: int, duration_s: float) -> Step:
            it = await closed_loop(name, places[name][1], targets[name], [request], concurrency, duration_s)
            if set(it.account.outcomes) != _EXPECTED:
                raise RuntimeError(f"{name}: calls ended as {dict(it.account.outcomes)}")
            return it

        for name in places:
            await step(name, 4, 0.5)  # a warm-up
        for done in range(options.rounds):
            progress("overhead, rounds", done, options.rounds)
            for name, way in ways.items():
                way.unloaded.append(await step(name, 1, options.unloaded_s))
            for name, way in ways.items():
                way.saturated.append(await step(name, options.concurrency, options.saturated_s))
    return list(ways.values())


async def closed_loop(
    name: str,
    process_id: int,
    target: Target,
    requests: Sequence[bytes],
    concurrency: int,
    duration_s: float,
    settle_s: float = 0.0,
) -> Step:
    """A step of `concurrency` callers, each of which calls again when it is answered."""
    return await run_step(
        f"{name}, {concurrency} at a time",
        ServerUnderLoad(process_id),
        lambda: send_closed_loop(target, requests, concurrency, duration_s),
        duration_s,
        settle_s=settle_s,
    )
