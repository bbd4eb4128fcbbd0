"""The real server with a real scene below and above its capacity: latency, goodput and refusals against load."""

import asyncio
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mapless_server.bounds import check_bounds
from mapless_server.settings import available_cores
from mapless_tools.demo import Place
from mapless_tools.progress import Progress

from .calls import Fate, regular_times
from .driving import METHOD, LoadedServer, find_saturation, open_step, read_answer, server_with_scene
from .report import Check, loop_lag_check, trend_check
from .sender import connected
from .step import Step, closed_loop_step

MIN_SHARE_OF_IDEAL = 0.9
MAX_P99_OVER_UNLOADED_P50 = 3.0
MIN_SHARE_OF_PEAK = 0.9
MAX_REFUSAL_MS = 50.0
HAMMERING = 32
"""Callers that call again at once when they are refused; the queue has room for some of them."""
MIN_SHARE_BESIDE_HAMMERING = 0.8
COMFORTABLE, EXCESSIVE = 0.7, 3.0
"""Shares of saturation that have bars of their own."""
COMFORTABLE_STEPS = 3
"""The step whose p99 has a bar is so many times as long as the others."""


@dataclass(frozen=True)
class PipelineOptions:
    """Options of the measurement.

    Attributes:
        clients: number of independent clients, each with its own connection.
        deadline_s: deadline of every call; a robot that calls once a second cannot use a later answer.
        unloaded_s: time of sequential calls.
        ramp_s: time with each number of concurrent calls, which is increased until more bring less than 3 % more
            answers.
        step_s: time at each share of saturation; a p99 needs some hundred calls.
        settle_s: beginning of each step that its rates leave out, while the queue fills.
    """

    clients: int = 8
    deadline_s: float = 5.0
    unloaded_s: float = 30.0
    ramp_s: float = 15.0
    step_s: float = 60.0
    settle_s: float = 10.0
    shares: tuple[float, ...] = (0.3, 0.5, COMFORTABLE, 0.9, 1.0, 1.5, 2.0, EXCESSIVE)
    seed: int = 0

    def __post_init__(self) -> None:
        check_bounds(self, "clients", at_least=1)
        check_bounds(self, "shares deadline_s unloaded_s ramp_s", above=0)
        check_bounds(self, "settle_s", at_least=0, below=self.step_s)
        if not self.shares:
            raise ValueError("PipelineOptions.shares must have at least one share")


@dataclass(frozen=True, eq=False)
class PipelineResult:
    """Result: sequential calls, 2, 4 and more concurrent ones, and the options' shares of saturation.

    Saturation is the largest rate of answers of the ramp. `regular` is the comfortable share of it from clients that
    call at equal intervals, as robots do. At the end all callers hammer.
    """

    scene: str
    options: PipelineOptions
    unloaded: Step
    ramp: Sequence[Step]
    saturation_per_s: float
    steps: Sequence[Step]
    regular: Step
    hammered: Step

    @property
    def all_steps(self) -> list[Step]:
        """All steps in order."""
        return [self.unloaded, *self.ramp, *self.steps, self.regular, self.hammered]

    def at(self, share: float) -> Step | None:
        """The step at a share of saturation; None if it was not measured."""
        return dict(zip(self.options.shares, self.steps, strict=True)).get(share)


def measure_pipeline(
    place: Place, options: PipelineOptions, progress: Progress, log: Path | None = None
) -> PipelineResult:
    """Starts a server and offers shares of its largest rate of answers; RuntimeError if it answers no call."""
    with server_with_scene(place, progress, log=log) as server:
        return asyncio.run(_measure(place, server, options, progress))


def pipeline_checks(result: PipelineResult) -> list[Check]:
    """The bars."""
    cores = available_cores()
    best = max(result.ramp, key=lambda step: step.account.completed_per_s)
    checks = [
        _ideal_check("unloaded", result.saturation_per_s, result.unloaded.cpu_s_per_answer, cores),
        _ideal_check("at saturation", result.saturation_per_s, best.cpu_s_per_answer, cores),
        _comfort_check("Poisson arrivals", result.unloaded, result.at(COMFORTABLE)),
        _comfort_check("regular arrivals", result.unloaded, result.regular),
        *_overload_checks(result),
        _hammering_check(result),
    ]
    overdue = sum(step.account.count(Fate.OVERDUE) for step in result.all_steps)
    failed = sum(step.account.count(Fate.FAILED) for step in result.all_steps)
    return [
        *checks,
        Check("accepted calls that ended after their deadline, all steps", str(overdue), "0", overdue == 0),
        Check("calls that failed, all steps", str(failed), "0", failed == 0),
        loop_lag_check(result.all_steps),
    ]


def pipeline_json(result: PipelineResult) -> dict[str, Any]:
    """The figures for programs."""
    steps = zip(result.options.shares, result.steps, strict=True)
    return vars(result) | {"steps": [{"share_of_saturation": share, **it.as_json()} for share, it in steps]}


async def _measure(place: Place, server: LoadedServer, options: PipelineOptions, progress: Progress) -> PipelineResult:
    async with connected(server.address, METHOD, options.clients, options.deadline_s, read_answer) as target:
        progress("unloaded", 0, 1)
        unloaded = await closed_loop_step(
            "unloaded", server.under_load, target, server.requests.good, 1, options.unloaded_s
        )
        ramp, saturation_per_s = await find_saturation(server, target, options.ramp_s, progress)
        steps = []
        for number, share in enumerate(options.shares):
            progress(f"load {100 * share:.0f} %", 0, 1)
            steps.append(
                await open_step(
                    f"{100 * share:.0f} %",
                    server,
                    target,
                    share * saturation_per_s,
                    options.step_s * (COMFORTABLE_STEPS if share == COMFORTABLE else 1),
                    settle_s=options.settle_s,
                    seed=options.seed + number,
                )
            )
        regular_s, regular_per_s = COMFORTABLE_STEPS * options.step_s, COMFORTABLE * saturation_per_s
        asked: dict[str, Any] = {"settle_s": options.settle_s, "seed": options.seed, "times": regular_times}
        name = f"{100 * COMFORTABLE:.0f} %, regular"
        progress(name, 0, 1)
        regular = await open_step(name, server, target, regular_per_s, regular_s, **asked)
        progress("hammering", 0, 1)
        hammered = await closed_loop_step(
            "hammering", server.under_load, target, server.requests.good, HAMMERING, options.step_s, False
        )
    return PipelineResult(place.title, options, unloaded, ramp, saturation_per_s, steps, regular, hammered)


def _ideal_check(where: str, saturation_per_s: float, cpu_s: float, cores: int) -> Check:
    ideal = cores / cpu_s
    return Check(
        f"answers/s at saturation, of cores / CPU seconds an answer ({where})",
        f"{saturation_per_s:.2f} of {cores} / {cpu_s:.3f} = {ideal:.2f}: {100 * saturation_per_s / ideal:.0f} %",
        f"at least {100 * MIN_SHARE_OF_IDEAL:.0f} %",
        saturation_per_s >= MIN_SHARE_OF_IDEAL * ideal,
    )


def _comfort_check(arrivals: str, unloaded: Step, step: Step | None) -> Check:
    figure = f"p99 at {100 * COMFORTABLE:.0f} % load, {arrivals}"
    bar = f"at most {MAX_P99_OVER_UNLOADED_P50:g} times the unloaded p50"
    p50_ms = unloaded.account.answers.p50_ms
    if step is None or p50_ms is None or step.account.answers.p99_ms is None:
        return Check(figure, "-", bar, None)
    p99_ms, count = step.account.answers.p99_ms, step.account.answers.count
    value = f"{p99_ms:.0f} ms of {count} answers, {p99_ms / p50_ms:.1f} times {p50_ms:.0f} ms"
    return Check(figure, value, bar, p99_ms <= MAX_P99_OVER_UNLOADED_P50 * p50_ms)


def _hammering_check(result: PipelineResult) -> Check:
    account = result.hammered.account
    share = account.goodput_per_s / result.saturation_per_s
    return Check(
        f"goodput beside {HAMMERING} callers that call again at once",
        f"{account.goodput_per_s:.2f}/s, {100 * share:.0f} % of saturation; {account.refused_per_s:.0f} refusals/s",
        f"at least {100 * MIN_SHARE_BESIDE_HAMMERING:.0f} %",
        share >= MIN_SHARE_BESIDE_HAMMERING,
    )


def _overload_checks(result: PipelineResult) -> list[Check]:
    step = result.at(EXCESSIVE)
    where = f"at {EXCESSIVE:g} times saturation"
    if step is None:
        return [Check(f"goodput, refusals and memory {where}", "-", "", None)]
    peak_per_s = max([result.saturation_per_s, *(it.account.goodput_per_s for it in result.steps)])
    goodput_per_s, refusals = step.account.goodput_per_s, step.account.refusals
    slowest_ms = refusals.max_ms
    return [
        Check(
            f"goodput {where}",
            f"{goodput_per_s:.2f}/s, {100 * goodput_per_s / peak_per_s:.0f} % of the peak of {peak_per_s:.2f}/s",
            f"at least {100 * MIN_SHARE_OF_PEAK:.0f} %",
            goodput_per_s >= MIN_SHARE_OF_PEAK * peak_per_s,
        ),
        Check(
            f"slowest of {refusals.count} refusals {where}",
            "-" if slowest_ms is None else f"{slowest_ms:.1f} ms (p99 {refusals.p99_ms:.1f} ms)",
            f"below {MAX_REFUSAL_MS:g} ms",
            None if slowest_ms is None else slowest_ms < MAX_REFUSAL_MS,
        ),
        trend_check(f"memory {where}", step.trend_of("resident_mib"), "MiB"),
    ]
