"""Replicas are replaced one after the other, again and again, while callers call."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from mapless import Client
from mapless_tools.load.report import Check
from mapless_tools.progress import Progress

from .callers import Calls, Scenes, calling
from .cluster import Cluster, Replica, application, running_cluster
from .database import VARIABLE, database_url
from .failover import NO_OP

SETTLE_S = 2.0
REDEPLOY_LIMIT_S = 300.0


@dataclass(frozen=True)
class Redeploy:
    """One of them.

    Attributes:
        duration_s: until all replicas were others.
        calls: made meanwhile.
        errors: of those that failed.
        slowest_s: the longest that a caller waited for one call.
        gap_s: the longest that one heard nothing.
    """

    duration_s: float
    calls: int
    errors: list[str]
    slowest_s: float
    gap_s: float


@dataclass(frozen=True)
class Redeploys:
    """What was measured; `lost` are references that were acknowledged and are not stored."""

    redeploys: list[Redeploy]
    added: int
    lost: int


def measure_redeploys(count: int, progress: Progress) -> Redeploys:
    """Redeploys two replicas so many times, each time with another setting; says how each went on standard output."""
    scenes = Scenes()
    with database_url() as url, running_cluster({VARIABLE: url}) as cluster:
        settings: dict[str, Any] = {"insecure": True, "workers": 1, "max_queued_s": 2.0}
        cluster.deploy(application(settings, import_path=NO_OP))
        with Client(cluster.address) as client:
            scenes.store(client)
        redeploys = []
        made: list[Calls] = []
        kinds = [scenes.localize, scenes.localize, scenes.get, scenes.adding(lambda: made[0], "added")]
        with calling(cluster.address, kinds, pause_s=0.02) as calls:
            made.append(calls)
            for done in range(count):
                progress("redeploys", done, count)
                settings["max_queued_s"] += 0.01
                redeploys.append(_redeployed(cluster, calls, settings))
                print(redeploy_line(done + 1, redeploys[-1]), flush=True)
        with Client(cluster.address) as client:
            lost = scenes.lost(client, calls)
    return Redeploys(redeploys, len(calls.acknowledged), len(lost))


def _redeployed(cluster: Cluster, calls: Calls, settings: dict[str, Any]) -> Redeploy:
    time.sleep(SETTLE_S)
    before, begin_s = set(cluster.replicas()), time.monotonic()
    cluster.deploy(application(settings, import_path=NO_OP), REDEPLOY_LIMIT_S)
    duration_s = time.monotonic() - begin_s
    if left := before & set[Replica](cluster.replicas()):
        raise RuntimeError(f"not replaced: {left}")
    time.sleep(SETTLE_S)
    meanwhile = calls.between(begin_s, time.monotonic())
    errors = [call.error for call in meanwhile.failed]
    return Redeploy(duration_s, len(meanwhile.ended), errors, meanwhile.slowest_s, meanwhile.longest_gap_s)


def redeploy_line(number: int, it: Redeploy) -> str:
    """A row of the table."""
    return (
        f"| {number} | {it.duration_s:.1f} | {it.calls} | {len(it.errors)} | {it.slowest_s:.2f} | {it.gap_s:.2f} |"
        f"{' ' + '; '.join(it.errors[:3]) if it.errors else ''}"
    )


def redeploys_lines(result: Redeploys) -> list[str]:
    """A table with a row a redeploy."""
    return [
        "Two replicas that compute nothing, replaced one after the other by a changed setting, 4 callers as above:",
        "",
        "| redeploy | took, s | calls | failed | slowest call, s | longest gap of a caller, s |",
        "|---|---|---|---|---|---|",
        *(redeploy_line(number, it) for number, it in enumerate(result.redeploys, 1)),
        "",
    ]


def redeploys_checks(result: Redeploys) -> list[Check]:
    """The bars."""
    failed, calls = (sum(f(it) for it in result.redeploys) for f in (lambda it: len(it.errors), lambda it: it.calls))
    return [
        Check(f"failed of {calls} calls in {len(result.redeploys)} redeploys", str(failed), "0", failed == 0),
        Check(f"lost of {result.added} references acknowledged", str(result.lost), "0", result.lost == 0),
    ]
