"""Replicas are replaced while callers call, because one was killed or all are redeployed: what the callers notice."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable
from dataclasses import dataclass

from mapless import Client
from mapless_tools.load.report import Check
from mapless_tools.progress import Progress

from .callers import Calls, Scenes, calling
from .cluster import Cluster, application, running_cluster
from .database import VARIABLE, database_url

MAX_GAP_S = 2.0
"""The bar of the longest wait after a kill."""

NO_OP = "mapless_tools.load_ray.no_op:build"
SETTINGS = {"insecure": True, "workers": 1}
SETTLE_S = 3.0
REPLACED_LIMIT_S = 120.0
REDEPLOY_LIMIT_S = 300.0


@dataclass(frozen=True)
class Replacement:
    """One replacement, with the calls in progress from its beginning until a while after its end.

    Attributes:
        duration_s: until the new replicas served.
        calls: number of the calls.
        errors: of those that failed in spite of their retries.
        usual_s: duration of the slowest call in the seconds before.
        slowest_s: duration of the slowest of the calls, retries included.
        gap_s: the longest time that one caller was without an answer.
    """

    duration_s: float
    calls: int
    errors: list[str]
    usual_s: float
    slowest_s: float
    gap_s: float


@dataclass(frozen=True)
class Replacements:
    """All replacements; of `added` references that were acknowledged, `lost` are not stored."""

    events: list[Replacement]
    added: int
    lost: int


def measure_replacements(
    replace: Callable[[Cluster, int], float], count: int, step: str, progress: Progress
) -> Replacements:
    """Replaces replicas of two, `count` times, by `kill_one` or `redeploy`."""
    scenes = Scenes()
    with database_url() as url, running_cluster({VARIABLE: url}) as cluster:
        cluster.deploy(application(SETTINGS, import_path=NO_OP))
        with Client(cluster.address) as client:
            scenes.store(client)
        events = []
        with calling(cluster.address, [scenes.localize, scenes.localize, scenes.get, scenes.add], 0.02) as calls:
            for done in range(count):
                progress(step, done, count)
                events.append(_replacement(replace, cluster, calls, done))
        with Client(cluster.address) as client:
            lost = scenes.lost(client, calls)
    return Replacements(events, len(calls.acknowledged), len(lost))


def _replacement(replace: Callable[[Cluster, int], float], cluster: Cluster, calls: Calls, number: int) -> Replacement:
    time.sleep(SETTLE_S)
    begin_s = time.monotonic()
    duration_s = replace(cluster, number)
    time.sleep(SETTLE_S)
    before = Calls([it for it in calls.between(begin_s - SETTLE_S, begin_s).ended if it.end_s < begin_s])
    meanwhile = calls.between(begin_s, time.monotonic())
    errors = [call.error for call in meanwhile.failed]
    return Replacement(
        duration_s, len(meanwhile.ended), errors, before.slowest_s, meanwhile.slowest_s, meanwhile.longest_gap_s
    )


def kill_one(cluster: Cluster, number: int) -> float:
    """Kills one replica, by turns; gives the time until Serve has another one, seconds."""
    before, begin_s = cluster.replicas(), time.monotonic()
    killed = before[number % len(before)]
    os.kill(killed.process_id, signal.SIGKILL)
    while killed in (now := cluster.replicas()) or len(now) < len(before):
        if time.monotonic() - begin_s > REPLACED_LIMIT_S:
            raise RuntimeError(f"Serve has not replaced the replica\n{cluster.logged()}")
        time.sleep(0.1)
    return time.monotonic() - begin_s


def redeploy(cluster: Cluster, number: int) -> float:
    """Changes a setting, for which Serve replaces all replicas; gives the duration, seconds."""
    before, begin_s = set(cluster.replicas()), time.monotonic()
    settings = SETTINGS | {"max_queued_s": 2.01 + number / 100}
    cluster.deploy(application(settings, import_path=NO_OP), REDEPLOY_LIMIT_S)
    duration_s = time.monotonic() - begin_s
    if left := before.intersection(cluster.replicas()):
        raise RuntimeError(f"not replaced: {left}")
    return duration_s


def replacement_lines(result: Replacements, what: str) -> list[str]:
    """A table with a row for each replacement."""
    lines = [
        f"Two replicas that compute nothing, {what}; 4 callers (two of Localize with 0.3 MB, one of a stored "
        "photograph, one that adds references), each on a connection of its own with the client's usual retries:",
        "",
        "| number | took, s | calls | failed | slowest before, s | slowest call, s | longest gap of a caller, s |",
        "|---|---|---|---|---|---|---|",
    ]
    for number, it in enumerate(result.events, 1):
        lines.append(
            f"| {number} | {it.duration_s:.1f} | {it.calls} | {len(it.errors)} | {it.usual_s:.2f} | {it.slowest_s:.2f} "
            f"| {it.gap_s:.2f} |"
        )
    return [*lines, "", *(f"- {error}" for it in result.events for error in it.errors[:3])]


def failover_checks(result: Replacements) -> list[Check]:
    """The bars after kills."""
    slowest_s = max(max(it.slowest_s, it.gap_s) for it in result.events)
    bar = f"below {MAX_GAP_S:g}"
    wait = Check("longest wait for a retried call, s", f"{slowest_s:.2f}", bar, slowest_s < MAX_GAP_S)
    return [wait, *redeploys_checks(result)]


def redeploys_checks(result: Replacements) -> list[Check]:
    """The bars after redeploys."""
    calls, failed = sum(it.calls for it in result.events), sum(len(it.errors) for it in result.events)
    return [
        Check(f"calls that failed, of {calls}", str(failed), "0", failed == 0),
        Check(f"references lost, of {result.added} acknowledged", str(result.lost), "0", result.lost == 0),
    ]
