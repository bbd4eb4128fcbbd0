"""What two replicas on two cores answer, against one on one core: the real method on a real scene."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Iterable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Any

from mapless import Client
from mapless_tools.demo import Place
from mapless_tools.load.records import Fate
from mapless_tools.load.report import Check
from mapless_tools.load.requests import METHOD, read_answer, requests_for, store_references
from mapless_tools.load.sender import Target, connected, send_closed_loop
from mapless_tools.load.step import Step, run_step
from mapless_tools.load.watch import ServerUnderLoad, read_process
from mapless_tools.progress import Progress

from .cluster import Cluster, application, running_cluster
from .database import VARIABLE, database_url

MIN_GAIN = 1.7


@dataclass(frozen=True)
class ThroughputOptions:
    """Options of the comparison.

    Attributes:
        rounds: one replica and two take turns so often, so that what else the machine does hits both alike.
        step_s: calls side by side, a round and way; the first fifth does not count.
        concurrency: calls side by side, a replica: one computes, the next is decoded, one is on its way.
    """

    rounds: int = 4
    step_s: float = 20.0
    concurrency: int = 3


@dataclass(frozen=True, eq=False)
class Round:
    """Both ways, one after the other.

    Attributes:
        one: one replica on one core, called at its own port: the other core carries no ingress, and nothing else.
        two: two replicas on a core each, through the ingress, which together with the generator shares their cores.
        balancer_share: of one core, what HAProxy used of it meanwhile.
    """

    one: Step
    two: Step
    balancer_share: float

    @property
    def gain(self) -> float:
        """How many times as many answers a second."""
        return self.two.account.completed_per_s / self.one.account.completed_per_s


def measure_throughput(place: Place, options: ThroughputOptions, progress: Progress) -> list[Round]:
    """Starts two replicas, each with one thread that computes on a core of its own.

    Raises:
        RuntimeError: a call did not end with an answer, or there are no two cores.
    """
    cores = sorted(os.sched_getaffinity(0))[:2]
    if len(cores) < 2:
        raise RuntimeError("two replicas on two cores need two cores")
    with database_url() as url, running_cluster({VARIABLE: url} | _ONE_THREAD) as cluster:
        cluster.deploy(application({"insecure": True, "workers": 1, "max_queued_s": _ROOM_S}))
        progress("storing references", 0, len(place.references))
        with Client(cluster.address) as client:
            store_references(client, place.references)
        for replica, core in zip(cluster.replicas(), cores, strict=True):
            with Client(replica.address) as client:
                requests = requests_for(client, place.queries).good  # its first answers
            _pin(replica.process_id, {core})
        return asyncio.run(_compare(cluster, requests, options, progress))


_ROOM_S = 60.0
"""The default refuses more than two seconds of computing, which on a slow machine is less than three calls."""

_ONE_THREAD = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS"), "1")


def throughput_checks(rounds: list[Round]) -> list[Check]:
    """The bar."""
    gains = [it.gain for it in rounds]
    gain = median(gains)
    return [
        Check(
            "answers a second of two replicas on two cores, of those of one on one core",
            f"{gain:.2f} times (rounds {min(gains):.2f} to {max(gains):.2f})",
            f"at least {MIN_GAIN:g} times",
            gain >= MIN_GAIN,
        )
    ]


def throughput_lines(rounds: list[Round], place: Place, options: ThroughputOptions) -> list[str]:
    """A table with a row a round."""
    lines = [
        f"{place.title}; {options.concurrency} calls side by side a replica; load average {os.getloadavg()[0]:.1f}:",
        "",
        "| round | one replica, answers/s | its CPU, s/answer | two replicas, answers/s | gain | generator's core "
        "| HAProxy's core |",
        "|---|---|---|---|---|---|---|",
    ]
    for number, it in enumerate(rounds, 1):
        lines.append(
            f"| {number} | {it.one.account.completed_per_s:.2f} | {it.one.cpu_s_per_answer:.3f} "
            f"| {it.two.account.completed_per_s:.2f} | {it.gain:.2f} | {100 * it.two.own_share:.1f} % "
            f"| {100 * it.balancer_share:.1f} % |"
        )
    return [*lines, ""]


def throughput_json(rounds: list[Round], options: ThroughputOptions) -> dict[str, Any]:
    """For programs."""
    steps = [{"one": it.one.as_json(), "two": it.two.as_json(), "haproxy_share": it.balancer_share} for it in rounds]
    return {"options": vars(options), "rounds": steps}


async def _compare(
    cluster: Cluster, requests: Sequence[bytes], options: ThroughputOptions, progress: Progress
) -> list[Round]:
    first = cluster.replicas()[0]
    rounds = []
    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        direct = await enter(connected(first.address, METHOD, 4, 30.0, read_answer))
        through = await enter(connected(cluster.address, METHOD, 4, 30.0, read_answer))
        for done in range(options.rounds):
            progress("throughput, rounds", done, options.rounds)
            one = await _step("one", first.process_id, direct, requests, options.concurrency, options.step_s)
            balancer = cluster.balancer_processes()
            before_s = _cpu_s(balancer)
            two = await _step("two", first.process_id, through, requests, 2 * options.concurrency, options.step_s)
            rounds.append(Round(one, two, (_cpu_s(balancer) - before_s) / two.wall_s))
    return rounds


async def _step(
    name: str, process_id: int, target: Target, requests: Sequence[bytes], at_a_time: int, duration_s: float
) -> Step:
    step = await run_step(
        name,
        ServerUnderLoad(process_id),
        lambda: send_closed_loop(target, requests, at_a_time, duration_s),
        duration_s,
        settle_s=duration_s / 5,
    )
    if step.answers != step.account.sent:
        raise RuntimeError(
            f"{name}: calls ended as {dict(step.account.outcomes)}, {step.account.count(Fate.OVERDUE)} late"
        )
    return step


def _pin(process_id: int, cores: Iterable[int]) -> None:
    """All threads there are; later ones inherit it."""
    for thread in Path(f"/proc/{process_id}/task").iterdir():
        os.sched_setaffinity(int(thread.name), cores)


def _cpu_s(process_ids: list[int]) -> float:
    return sum(read_process(it, 0.0).cpu_s for it in process_ids if Path(f"/proc/{it}").exists())
