"""Figures with their bars, and steps as a table, in Markdown like the project's other reports."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any

from mapless_server import __version__
from mapless_server.observability.provenance import cpu_model
from mapless_server.settings import available_cores
from mapless_tools.output_files import markdown_table, write_json

from .calls import Fate
from .slopes import Slope
from .step import TREND_CONFIDENCE, Step


@dataclass(frozen=True)
class Check:
    """A figure with its value and the bar that it has to meet; `met` is None if it was not measured."""

    figure: str
    value: str
    bar: str
    met: bool | None


def machine() -> str:
    """The software and the machine of the figures."""
    return f"mapless {__version__}; {cpu_model()}, {available_cores()} cores, load generator on the same"


def check_lines(checks: Sequence[Check]) -> list[str]:
    """A table of figure, value, bar and verdict."""
    verdict = {True: "yes", False: "**no**", None: "not measured"}
    rows = [(check.figure, check.value, check.bar, verdict[check.met]) for check in checks]
    return [*markdown_table("figure | measured | bar | met", rows), ""]


def step_lines(steps: Sequence[Step]) -> list[str]:
    """A table with a row for each step, and below it how every call ended."""
    head = (
        "step | offered/s | sent | goodput/s | refused/s | answers p50 / p95 / p99 ms | refusals p50 / p99 / max ms | "
        "overdue | server CPU s/answer | RSS MiB, before > after | threads | fds | generator's core"
    )
    rows = []
    for step in steps:
        account, first, last = step.account, step.samples[0], step.samples[-1]
        answers, refusals = account.answers, account.refusals
        cells = (
            step.name,
            f"{account.offered_per_s:.2f}",
            str(account.sent),
            f"{account.goodput_per_s:.2f}",
            f"{account.refused_per_s:.2f}",
            " / ".join(map(_ms, (answers.p50_ms, answers.p95_ms, answers.p99_ms))),
            " / ".join(map(_ms, (refusals.p50_ms, refusals.p99_ms, refusals.max_ms))),
            str(account.count(Fate.OVERDUE)),
            f"{step.cpu_s_per_answer:.4f}" if step.answers else "-",
            f"{first.resident_mib:.0f} > {last.resident_mib:.0f}",
            f"{first.threads} > {last.threads}",
            f"{first.descriptors} > {last.descriptors}",
            f"{100 * step.own_share:.0f} %",
        )
        rows.append(cells)
    lines = [*markdown_table(head, rows), ""]
    for step in steps:
        outcomes = ", ".join(f"{count} {outcome}" for outcome, count in step.account.outcomes.items())
        lag = step.account.send_lag
        lines.append(f"- {step.name}: {outcomes or 'no calls'}; sent late by {_ms(lag.p99_ms)} ms (p99).")
    return [*lines, ""]


LOOP_LAG_BAR_S = 0.02
"""The event loop is never to be blocked for longer."""


def loop_lag_check(steps: Sequence[Step]) -> Check:
    """Checks how late the server's event loop was at p99.9, in the worst step."""

    def worst_s(share: float) -> float | None:
        lags = (step.scraped.lag_s(share) for step in steps if step.scraped is not None)
        return max((lag for lag in lags if lag is not None), default=None)

    usual_s, longest_s = worst_s(0.999), worst_s(1.0)
    value, met = "-", None
    if usual_s is not None and longest_s is not None:
        value, met = f"< {1000 * usual_s:g} ms (longest < {1000 * longest_s:g} ms)", usual_s <= LOOP_LAG_BAR_S
    return Check("event loop late, p99.9", value, f"{1000 * LOOP_LAG_BAR_S:g} ms", met)


def machine_lines(checks: Sequence[Check], load: float, cores: int) -> list[str]:
    """A hint for missed bars if more threads were ready (`load`, the load average) than there are cores."""
    if load <= cores or all(check.met is not False for check in checks):
        return []
    return [
        f"Some {load:.1f} threads wanted to run on {cores} cores, those of the load generator and of other programs "
        "among them. Bars of time (deadlines, the event loop) then depend on the machine: measure with more cores, "
        "without other programs, or at a lower rate.",
        "",
    ]


def trend_check(figure: str, found: Slope | None, unit: str) -> Check:
    """Checks that a figure does not grow."""
    if found is None:
        return Check(figure, "-", "no growth", None)
    per_minute, low, high = (value / 60 for value in (found.per_hour, found.low, found.high))
    value = f"{per_minute:+.3f} ({low:+.3f} to {high:+.3f}) {unit}/min around {found.level:.1f}"
    return Check(figure, value, f"no growth ({100 * TREND_CONFIDENCE:.0f} %)", not found.grows)


def report_part(
    file: Path, part: str, lines: Sequence[str], checks: Sequence[Check], figures: Any, *others: Path
) -> None:
    """Prints a measurement, adds it to a JSON file that may hold other parts, and names this and its other files."""
    print("\n".join([f"## {part}", "", machine(), "", *lines, *check_lines(checks)]), flush=True)
    file.parent.mkdir(parents=True, exist_ok=True)
    content = json.loads(file.read_text(encoding="utf-8")) if file.is_file() else {}
    measured = {"machine": machine(), "checks": [vars(check) for check in checks], **figures_of(figures)}
    write_json(file, content | {part: measured})
    print(f"Written: {', '.join(map(str, [file, *others]))}\n", flush=True)


def figures_of(value: Any) -> Any:
    """JSON values of a result: of steps their figures, of other dataclasses all fields."""
    if isinstance(value, Step):
        return value.as_json()
    if is_dataclass(value):
        value = vars(value)
    if isinstance(value, Mapping):
        return {name: figures_of(it) for name, it in value.items()}
    return [figures_of(it) for it in value] if isinstance(value, list | tuple) else value


def _ms(value: float | None) -> str:
    return "-" if value is None else f"{value:.0f}" if value >= 10 else f"{value:.1f}"
