"""A replica is killed while callers call: how long the slowest of them waited."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass

from mapless import Client
from mapless_tools.load.report import Check
from mapless_tools.progress import Progress

from .callers import Calls, Scenes, calling
from .cluster import Cluster, Replica, application, running_cluster
from .database import VARIABLE, database_url

MAX_GAP_S = 2.0
NO_OP = "mapless_tools.load_ray.no_op:build"
SETTLE_S = 3.0
REPLACED_LIMIT_S = 120.0


@dataclass(frozen=True)
class Failover:
    """One time that a replica was killed.

    Attributes:
        calls: made from a while before until a while after it was replaced.
        failed: of them, with all retries.
        usual_s: the slowest call of the time before.
        slowest_s: the slowest one from then on, retries and pauses included.
        gap_s: the longest that one of the callers heard nothing.
        replaced_s: until Serve had another replica.
    """

    calls: int
    failed: int
    usual_s: float
    slowest_s: float
    gap_s: float
    replaced_s: float


@dataclass(frozen=True)
class Failovers:
    """What was measured; `lost` are references that were acknowledged and are not stored."""

    kills: list[Failover]
    added: int
    lost: int


def measure_failover(count: int, progress: Progress) -> Failovers:
    """Kills a replica of two so many times, by turns."""
    scenes = Scenes()
    with database_url() as url, running_cluster({VARIABLE: url}) as cluster:
        cluster.deploy(application({"insecure": True, "workers": 1}, import_path=NO_OP))
        with Client(cluster.address) as client:
            scenes.store(client)
        kills = []
        made: list[Calls] = []
        kinds = [scenes.localize, scenes.localize, scenes.get, scenes.adding(lambda: made[0], "added")]
        with calling(cluster.address, kinds, pause_s=0.02) as calls:
            made.append(calls)
            for done in range(count):
                progress("failover", done, count)
                kills.append(_killed(cluster, calls, done))
        with Client(cluster.address) as client:
            lost = scenes.lost(client, calls)
    return Failovers(kills, len(calls.acknowledged), len(lost))


def _killed(cluster: Cluster, calls: Calls, number: int) -> Failover:
    time.sleep(SETTLE_S)
    before = cluster.replicas()
    victim = before[number % len(before)]
    at_s = time.monotonic()
    os.kill(victim.process_id, signal.SIGKILL)
    replaced_s = _wait_for_another(cluster, victim, len(before))
    time.sleep(SETTLE_S)
    usual = calls.between(at_s - SETTLE_S, at_s)
    meanwhile = calls.between(at_s, time.monotonic())
    return Failover(
        len(meanwhile.ended),
        len(meanwhile.failed),
        max((it.duration_s for it in usual.ended if it.end_s < at_s), default=0.0),
        meanwhile.slowest_s,
        meanwhile.longest_gap_s,
        replaced_s,
    )


def _wait_for_another(cluster: Cluster, victim: Replica, count: int) -> float:
    begin_s = time.monotonic()
    while victim in (now := cluster.replicas()) or len(now) < count:
        if time.monotonic() - begin_s > REPLACED_LIMIT_S:
            raise RuntimeError(f"Serve has not replaced the replica\n{cluster.logged()}")
        time.sleep(0.1)
    return time.monotonic() - begin_s


def failover_lines(result: Failovers) -> list[str]:
    """A table with a row a kill."""
    lines = [
        "Two replicas that compute nothing; 4 callers (two of Localize with 0.3 MB, one of a stored photograph, one "
        "that adds references), each on a connection of its own with the client's usual retries:",
        "",
        "| kill | calls | failed | slowest before, s | slowest call, s | longest gap of a caller, s | replaced, s |",
        "|---|---|---|---|---|---|---|",
    ]
    for number, kill in enumerate(result.kills, 1):
        lines.append(
            f"| {number} | {kill.calls} | {kill.failed} | {kill.usual_s:.2f} | {kill.slowest_s:.2f} "
            f"| {kill.gap_s:.2f} | {kill.replaced_s:.1f} |"
        )
    return [*lines, ""]


def failover_checks(result: Failovers) -> list[Check]:
    """The bars."""
    slowest_s = max(max(kill.slowest_s, kill.gap_s) for kill in result.kills)
    failed = sum(kill.failed for kill in result.kills)
    return [
        Check("longest wait for a retried call, s", f"{slowest_s:.2f}", f"below {MAX_GAP_S:g}", slowest_s < MAX_GAP_S),
        Check("calls that failed", str(failed), "0", failed == 0),
        Check(f"lost of {result.added} references acknowledged", str(result.lost), "0", result.lost == 0),
    ]
