"""Nine tenths of what the server can do, for a long time, with callers who hang up and images that are none."""

from __future__ import annotations

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from ..demo.run import Place
from ..progress import Progress
from .arrivals import Mix
from .driving import LoadedServer, calling, closed_step, find_saturation, open_step, server_with_scene
from .records import Fate
from .report import Check, loop_lag_check, trend_check
from .scrape import Reconciliation, reconcile
from .step import Step


@dataclass(frozen=True)
class SoakOptions:
    """Options of the soak.

    Attributes:
        minutes: how long.
        share: of saturation that is offered in good queries, those that are cancelled among them.
        cancelled_share, bad_share: of all calls; bad images come on top of the good ones.
        clients: that call independently.
        deadline_s: of every call.
        ramp_s: with each number of calls side by side, to find saturation.
        settle_share: of the time, what trends leave out: memory is still being filled.
        sample_every_s: between looks at the process.
        seed: of the arrivals.
    """

    minutes: float = 10.0
    share: float = 0.9
    cancelled_share: float = 0.1
    bad_share: float = 0.1
    clients: int = 8
    deadline_s: float = 5.0
    ramp_s: float = 15.0
    settle_share: float = 0.2
    sample_every_s: float = 2.0
    seed: int = 0

    def __post_init__(self) -> None:
        if not min(self.minutes, self.share, self.deadline_s, self.ramp_s, self.sample_every_s) > 0 or self.clients < 1:
            raise ValueError("times, share and clients must be above 0")
        if not (0 <= self.settle_share < 1 and 0 <= self.bad_share < 1):
            raise ValueError("settle_share and bad_share must be at least 0 and below 1")


@dataclass(frozen=True, eq=False)
class SoakResult:
    """What was measured; `account` is None if the server serves no metrics."""

    scene: str
    options: SoakOptions
    unloaded: Step
    ramp: Sequence[Step]
    saturation_per_s: float
    soak: Step
    account: Reconciliation | None


def measure_soak(place: Place, options: SoakOptions, progress: Progress) -> SoakResult:
    """Starts a server, finds what it can do at most, and keeps it busy.

    Raises:
        ServerFailed: it did not start.
        MaplessError: a call before the measurement failed.
        RuntimeError: it answered nothing.
    """
    with server_with_scene(place, progress) as server:
        return asyncio.run(_measure(place, server, options, progress))


def soak_checks(result: SoakResult) -> list[Check]:
    """The bars."""
    step = result.soak
    overdue, failed = step.account.count(Fate.OVERDUE), step.account.count(Fate.FAILED)
    return [
        trend_check("memory", step.trend_of("resident_mib"), "MiB"),
        trend_check("threads", step.trend_of("threads"), ""),
        trend_check("file descriptors", step.trend_of("descriptors"), ""),
        _account_check(result.account),
        Check("accepted calls that ended after their deadline", str(overdue), "0", overdue == 0),
        Check("calls that failed", str(failed), "0", failed == 0),
        loop_lag_check([step]),
    ]


def soak_json(result: SoakResult) -> dict[str, Any]:
    """For programs."""
    return {
        "scene": result.scene,
        "options": vars(result.options),
        "saturation_per_s": result.saturation_per_s,
        "unloaded": result.unloaded.as_json(),
        "ramp": [step.as_json() for step in result.ramp],
        "soak": result.soak.as_json(),
        "samples": [vars(sample) for sample in result.soak.samples],
        "account": None if result.account is None else vars(result.account),
    }


async def _measure(place: Place, server: LoadedServer, options: SoakOptions, progress: Progress) -> SoakResult:
    seconds = 60 * options.minutes
    async with calling(server, options.clients, options.deadline_s) as target:
        progress("unloaded", 0, 1)
        unloaded = await closed_step("unloaded", server, target, 1, options.ramp_s)
        ramp, saturation_per_s = await find_saturation(server, target, options.ramp_s, progress)
        p50_ms = unloaded.account.answers.p50_ms or 1000.0
        progress(f"soak, {options.minutes:g} minutes", 0, 1)
        soak = await open_step(
            "soak",
            server,
            target,
            options.share * saturation_per_s / (1 - options.bad_share),
            seconds,
            settle_s=options.settle_share * seconds,
            seed=options.seed,
            mix=Mix(options.cancelled_share, options.bad_share, cancel_within_s=2 * p50_ms / 1000),
            sample_every_s=options.sample_every_s,
        )
    account = None if soak.told is None else reconcile(soak.codes, soak.told)
    return SoakResult(place.title, options, unloaded, ramp, saturation_per_s, soak, account)


def _account_check(account: Reconciliation | None) -> Check:
    figure, bar = "calls in the server's metrics", "every one accounted for"
    if account is None:
        return Check(figure, "-", bar, None)
    value = (
        f"{account.sent} sent, {account.handled} counted; {account.unseen} given up before the server began with them"
    )
    if account.missing or account.surplus or account.running:
        value += f"; missing {dict(account.missing)}, surplus {account.surplus}, still running {account.running}"
    return Check(figure, value, bar, account.complete)
