"""Throughput of two replicas on two cores and of one on one core: the real method on a real scene."""

import asyncio
import os
from collections.abc import Iterable, Sequence
from contextlib import AsyncExitStack
from dataclasses import dataclass
from pathlib import Path
from statistics import median

from bench.load.calls import Fate
from bench.load.driving import METHOD, read_answer, requests_for, store_references
from bench.load.report import Check
from bench.load.sender import Target, connected
from bench.load.step import Step, closed_loop_step
from bench.load.watch import ServerUnderLoad, read_process
from mapless import Client
from mapless_tools.demo import Place
from mapless_tools.output_files import markdown_table
from mapless_tools.progress import Progress, tracked

from .cluster import Cluster, application, running_cluster
from .database import VARIABLE, database_url

MIN_GAIN = 1.7


@dataclass(frozen=True)
class ThroughputOptions:
    """Options of the comparison.

    One replica and two take turns in rounds, so that other load of the machine affects both alike; the first fifth of a
    step does not count. Of three parallel calls a replica computes one, the next is decoded, one is in transit.
    """

    rounds: int = 4
    step_s: float = 20.0
    concurrency: int = 3


@dataclass(frozen=True, eq=False)
class Round:
    """Both ways, one after the other.

    One replica on one core is called at its own port; the other core is idle. Two replicas on a core each are called
    through the ingress, which shares the cores with them and the generator; HAProxy used `balancer_share` of one core.
    """

    one: Step
    two: Step
    balancer_share: float

    @property
    def gain(self) -> float:
        """Ratio of the answers a second."""
        return self.two.account.completed_per_s / self.one.account.completed_per_s


def measure_throughput(place: Place, options: ThroughputOptions, progress: Progress) -> list[Round]:
    """Starts two replicas, each with one thread on its own core; RuntimeError without two cores, or for a lost call."""
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
    value = f"{median(gains):.2f} times (rounds {min(gains):.2f} to {max(gains):.2f})"
    figure = "answers a second of two replicas on two cores, of those of one on one core"
    return [Check(figure, value, f"at least {MIN_GAIN:g} times", median(gains) >= MIN_GAIN)]


def throughput_lines(rounds: list[Round], place: Place, options: ThroughputOptions) -> list[str]:
    """A table with a row a round."""
    lines = [
        f"{place.title}; {options.concurrency} parallel calls a replica; load average {os.getloadavg()[0]:.1f}:",
        "",
    ]
    rows = []
    for number, it in enumerate(rounds, 1):
        one, two = it.one.account.completed_per_s, it.two.account.completed_per_s
        times = (f"{one:.2f}", f"{it.one.cpu_s_per_answer:.3f}", f"{two:.2f}", f"{it.gain:.2f}")
        rows.append((number, *times, f"{100 * it.two.own_share:.1f} %", f"{100 * it.balancer_share:.1f} %"))
    replicas = "one replica, answers/s | its CPU, s/answer | two replicas, answers/s | gain"
    return [*lines, *markdown_table(f"round | {replicas} | generator's core | HAProxy's core", rows), ""]


async def _compare(
    cluster: Cluster, requests: Sequence[bytes], options: ThroughputOptions, progress: Progress
) -> list[Round]:
    first = cluster.replicas()[0]
    rounds = []

    async def step(name: str, target: Target, concurrency: int) -> Step:
        server, title = ServerUnderLoad(first.process_id), f"{name}, {concurrency} at a time"
        it = await closed_loop_step(title, server, target, requests, concurrency, options.step_s)
        if it.answers != it.account.sent:
            late = it.account.count(Fate.OVERDUE)
            raise RuntimeError(f"{name}: calls ended as {dict(it.account.outcomes)}, {late} late")
        return it

    async with AsyncExitStack() as stack:
        enter = stack.enter_async_context
        direct = await enter(connected(first.address, METHOD, 4, 30.0, read_answer))
        through = await enter(connected(cluster.address, METHOD, 4, 30.0, read_answer))
        for _ in tracked("throughput, rounds", range(options.rounds), options.rounds, progress):
            one = await step("one", direct, options.concurrency)
            balancer = cluster.balancer_processes()
            before_s = _cpu_s(balancer)
            two = await step("two", through, 2 * options.concurrency)
            rounds.append(Round(one, two, (_cpu_s(balancer) - before_s) / two.wall_s))
    return rounds


def _pin(process_id: int, cores: Iterable[int]) -> None:
    """Pins all present threads; later ones inherit it."""
    for thread in Path(f"/proc/{process_id}/task").iterdir():
        os.sched_setaffinity(int(thread.name), cores)


def _cpu_s(process_ids: list[int]) -> float:
    return sum(read_process(it, 0.0).cpu_s for it in process_ids if Path(f"/proc/{it}").exists())
