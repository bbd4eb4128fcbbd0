"""A server in use for an hour: its memory and other resources must not grow after the first minutes.

Queries of all kinds come as a Poisson process: some are cancelled, some have too short a deadline, some a bad image;
beside them run the workers of `churn`. The rate is nine tenths of the server's capacity, or one that is given.
"""

import asyncio
import math
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapless_server.bounds import check_bounds
from mapless_tools.demo import Place
from mapless_tools.progress import Progress

from .calls import Fate, Mix
from .churn import WORK, Outcomes, Workers, churning
from .driving import METHOD, LoadedServer, find_saturation, mixed_requests, open_step, read_answer, server_with_scene
from .report import Check, loop_lag_check
from .sender import connected
from .slopes import CONFIDENCE, MIN_SAMPLES, Slope, slope
from .step import Step, closed_loop_step
from .watch import FIELDS, Reconciliation, ServerState, column, reconcile, server_states

FIGURES: Mapping[str, tuple[str, str]] = {
    "resident_mib": ("memory", "MiB"),
    "unique_mib": ("memory of its own", "MiB"),
    "python_blocks": ("Python's blocks", ""),
    "threads": ("threads", ""),
    "descriptors": ("open files and sockets", ""),
    "sockets": ("sockets", ""),
    "data_mib": ("data folder", "MiB"),
    "waiting_jobs": ("jobs that wait", ""),
    "loop_lag_ms": ("event loop late", "ms"),
}
"""The figures whose slopes are taken, by their field: description and unit."""
BOUND = ("resident_mib", "unique_mib", "python_blocks", "threads", "descriptors", "sockets")
"""Figures that must not grow. The others are reported: the data folder grows by what is kept of deleted scenes."""
MIN_SETTLED_S = 300.0
"""In less, what takes minutes, as allocators and caches do, looks like growth."""


@dataclass(frozen=True)
class SoakOptions:
    """Options of the soak.

    Attributes:
        rate_per_s: rate of calls of Localize; None for `share` of saturation, which is then measured.
        share: share of saturation that is offered as good queries, including cancelled ones.
        cancelled_share, hurried_share, bad_share: shares of all calls; bad images are sent in addition to the good
            ones.
        churn: speed of the other workers; 0 for none.
        ramp_s: time with each number of concurrent calls, to find saturation.
        settle_share: share of the time that slopes leave out, while caches fill.
        sample_every_s: time between samples of the server.
    """

    minutes: float = 10.0
    rate_per_s: float | None = None
    share: float = 0.9
    cancelled_share: float = 0.1
    hurried_share: float = 0.05
    bad_share: float = 0.1
    clients: int = 8
    deadline_s: float = 5.0
    churn: float = 1.0
    ramp_s: float = 15.0
    settle_share: float = 1 / 3
    sample_every_s: float = 10.0
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds(self, "minutes share deadline_s ramp_s sample_every_s", above=0)
        check_bounds(self, "clients", at_least=1)
        check_bounds(self, "churn", at_least=0)
        check_bounds(self, "settle_share bad_share", at_least=0, below=1)
        if self.rate_per_s is not None:
            check_bounds(self, "rate_per_s", above=0)


@dataclass(frozen=True, eq=False)
class SoakResult:
    """Result: steps before the soak, its own step, and the server meanwhile.

    Slopes are those of the states after the settling, by field; empty if there are too few. The account compares the
    client's and the server's counts; None if the server serves no metrics.
    """

    scene: str
    options: SoakOptions
    before: Sequence[Step]
    rate_per_s: float
    soak: Step
    states: Sequence[ServerState]
    slopes: Mapping[str, Slope]
    outcomes: Outcomes
    account: Reconciliation | None


def measure_soak(place: Place, options: SoakOptions, progress: Progress, log: Path | None = None) -> SoakResult:
    """Starts a server, measures its saturation unless a rate is given, and keeps it busy; RuntimeError if it ends."""
    with server_with_scene(place, progress, {"MAPLESS_ALLOW_WATCHING": "true"}, log) as server:
        return asyncio.run(_measure(place, server, options, progress))


def slopes_of(found: Sequence[ServerState], settle_s: float) -> dict[str, Slope]:
    """Slopes of the states after the settling; empty if there are too few."""
    settled = [state for state in found if state.at_s >= found[0].at_s + settle_s]
    if len(settled) < MIN_SAMPLES or settled[-1].at_s - settled[0].at_s < MIN_SETTLED_S:
        return {}
    return {field: slope(column(settled, "at_s"), column(settled, field)) for field in FIGURES}


def least_minutes(options: SoakOptions) -> int:
    """Shortest duration of a soak for which slopes can be computed."""
    # The first look after the settling and the last one before the end each come up to one interval off.
    settled_s = max(MIN_SETTLED_S, (MIN_SAMPLES - 1) * options.sample_every_s) + 2 * options.sample_every_s
    return math.ceil(settled_s / (1 - options.settle_share) / 60 - 1e-9)


def soak_checks(result: SoakResult) -> list[Check]:
    """The bars."""
    step = result.soak
    overdue, failed = step.account.count(Fate.OVERDUE), step.account.count(Fate.FAILED)
    failures = "; ".join(f"{what} ({text})" for what, text in result.outcomes.failures.items())
    return [
        *(_slope_check(field, result.slopes.get(field), field in BOUND, result.options) for field in FIGURES),
        _account_check(result),
        Check("accepted calls that ended after their deadline", str(overdue), "0", overdue == 0),
        Check("calls that failed", str(failed), "0", failed == 0),
        Check("calls beside the queries that failed", failures or "0", "0", not failures),
        loop_lag_check([step]),
    ]


def soak_lines(result: SoakResult) -> list[str]:
    """Lines on what happened besides the queries."""
    counted: dict[str, list[str]] = {}
    for (worker, code), count in sorted(result.outcomes.counts.items()):
        counted.setdefault(worker, []).append(f"{count} {code}")
    lines = [f"- {worker} ({WORK[worker]}): {', '.join(counts)}" for worker, counts in counted.items()]
    return ["Beside the queries, by how calls ended:", "", *(lines or ["- nothing"]), ""]


def soak_json(result: SoakResult) -> dict[str, Any]:
    """The figures for programs."""
    shown = {name: it for name, it in vars(result).items() if name != "outcomes"}
    return shown | {
        "slopes": {field: {**vars(it), "verdict": it.verdict} for field, it in result.slopes.items()},
        "states": {field: column(result.states, field) for field in ("at_s", *FIELDS)},
        "beside": {f"{worker} {code}": count for (worker, code), count in sorted(result.outcomes.counts.items())},
    }


async def _measure(place: Place, server: LoadedServer, options: SoakOptions, progress: Progress) -> SoakResult:
    seconds = 60 * options.minutes
    workers = Workers(server.address, place, Outcomes(), options.churn)
    async with connected(server.address, METHOD, options.clients, options.deadline_s, read_answer) as target:
        progress("unloaded", 0, 1)
        before = [
            await closed_loop_step("unloaded", server.under_load, target, server.requests.good, 1, options.ramp_s)
        ]
        # Cancelled and hurried calls end before about half of the answers.
        early_s = 2 * (before[0].account.answers.p50_ms or 1000.0) / 1000
        mix = Mix(options.cancelled_share, options.bad_share, early_s, options.hurried_share, early_s)
        rate_per_s = options.rate_per_s
        if rate_per_s is None:
            ramp, saturation_per_s = await find_saturation(server, target, options.ramp_s, progress)
            before += ramp
            rate_per_s = options.share * saturation_per_s / (1 - options.bad_share)
        progress(f"soak, {options.minutes:g} minutes", 0, 1)
        async with server_states(server.under_load, options.sample_every_s) as found:
            step = await open_step(
                "soak",
                server,
                target,
                rate_per_s,
                seconds,
                settle_s=options.settle_share * seconds,
                seed=options.seed,
                mix=mix,
                requests=mixed_requests(server.requests, place.queries),
                beside=lambda: churning(workers, options.seed) if options.churn else nullcontext(),
            )
    account = None
    if step.scraped is not None:
        account = reconcile([*step.codes, *workers.outcomes.localize_codes], step.scraped)
    slopes = slopes_of(found, options.settle_share * seconds)
    return SoakResult(place.title, options, before, rate_per_s, step, found, slopes, workers.outcomes, account)


def _slope_check(field: str, found: Slope | None, is_bound: bool, options: SoakOptions) -> Check:
    figure, bar = f"slope of {field}", f"0 within {100 * CONFIDENCE:.0f} %" if is_bound else "reported"
    if found is None:
        return Check(figure, f"{options.minutes:g} minutes are too short, {least_minutes(options)} are not", bar, None)
    unit = f" {FIGURES[field][1]}".rstrip()
    value = (
        f"{found.per_hour:+.3g} ({found.low:+.3g} to {found.high:+.3g}){unit}/h around {found.level:.6g}: "
        f"{found.verdict}"
    )
    return Check(figure, value, bar, not found.grows if is_bound else None)


def _account_check(result: SoakResult) -> Check:
    account = result.account
    figure, bar = "Localize calls of the soak in the server's metrics", "every one accounted for"
    if account is None:
        return Check(figure, "-", bar, None)
    value = (
        f"{account.sent} sent ({result.soak.account.sent} queries, {account.sent - result.soak.account.sent} of those "
        f"beside them; the steps before are not among them), {account.handled} counted; {account.unseen} given up "
        "before the server began with them"
    )
    if account.missing or account.surplus or account.running:
        value += f"; missing {dict(account.missing)}, surplus {account.surplus}, still running {account.running}"
    return Check(figure, value, bar, account.complete)
