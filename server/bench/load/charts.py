"""Charts of the measurements: latency and goodput against offered load, and the server's state during a soak.

At three times its capacity, a good server answers as many calls as at its capacity, and rejects the others at once.
"""

from collections.abc import Callable, Mapping, Sequence

from matplotlib.axes import Axes
from matplotlib.figure import Figure

from mapless_tools.charts import COLOURS, prepared, use_logarithms

from .pipeline import PipelineResult
from .report import machine
from .slopes import Slope
from .soak import FIGURES
from .step import Step
from .watch import ServerState, column

Value = Callable[[Step], "float | None"]
_BLUE, _AMBER, _GREEN, _RED = COLOURS[0], COLOURS[1], COLOURS[2], COLOURS[6]
LATENCIES: Mapping[str, tuple[str, Value]] = {
    "answers, p99": (_RED, lambda step: step.account.answers.p99_ms),
    "answers, p95": (_AMBER, lambda step: step.account.answers.p95_ms),
    "answers, p50": (_GREEN, lambda step: step.account.answers.p50_ms),
    "refusals, p99": (_BLUE, lambda step: step.account.refusals.p99_ms),
}
RATES: Mapping[str, tuple[str, Value]] = {
    "answered in time": (_GREEN, lambda step: step.account.goodput_per_s),
    "refused": (_BLUE, lambda step: step.account.refused_per_s),
    "overdue": (_RED, lambda step: step.account.overdue_per_s),
}


def draw_load(result: PipelineResult) -> Figure:
    """Draws latencies of answers and refusals (above) and their rates (below) against the offered rate."""
    figure = Figure(figsize=(12.5, 9), layout="constrained")
    upper, lower = figure.subplots(2, 1, sharex=True, height_ratios=(4, 3))
    options, steps = result.options, sorted(result.steps, key=lambda step: step.account.offered_per_s)
    figure.suptitle(
        f"Latency and goodput against offered load: {result.scene}\n{machine()}\n{options.clients} clients, Poisson "
        f"arrivals whatever the answers, {options.step_s:g} s a step without its first {options.settle_s:g} s, "
        f"deadline {options.deadline_s:g} s",
        fontsize=9,
        ha="left",
        x=0.01,
    )
    prepared(upper, "Milliseconds from when a call was due", "", "ms")
    use_logarithms(upper.yaxis)
    prepared(lower, "Calls a second", "offered calls a second", "calls a second")
    _curves(upper, LATENCIES, steps, "{:.0f} ms")
    _curves(lower, RATES, steps, "{:.1f}/s")
    grey = {"color": COLOURS[-1], "linewidth": 1}
    upper.axhline(1000 * options.deadline_s, linestyle="--", label="deadline", **grey)
    unloaded_ms = result.unloaded.account.answers.p50_ms
    if unloaded_ms is not None:
        upper.axhline(unloaded_ms, linestyle=":", label=f"one call at a time, p50: {unloaded_ms:.0f} ms", **grey)
    capacity = f"saturation, the most answers: {result.saturation_per_s:.1f}/s"
    lower.axhline(result.saturation_per_s, linestyle="--", label=capacity, **grey)
    lower.axline((0, 0), slope=1, linestyle=":", label="every call answered", **grey)
    most = max(step.account.offered_per_s for step in steps)
    rates = [rate for step in steps for _, of in RATES.values() if (rate := of(step)) is not None]
    lower.set(xlim=(0, 1.04 * most), ylim=(0, 1.12 * max(result.saturation_per_s, *rates)))
    lower.secondary_xaxis(
        -0.18, functions=(lambda x: 100 * x / result.saturation_per_s, lambda x: x * result.saturation_per_s / 100)
    ).set_xlabel("% of saturation")
    for axes in (upper, lower):
        axes.axvline(result.saturation_per_s, **grey)
        axes.legend(loc="upper left", bbox_to_anchor=(1, 1), frameon=False)
    return figure


def draw_soak(states: Sequence[ServerState], slopes: Mapping[str, Slope]) -> Figure:
    """Draws a panel for each figure of the server's state, with its slope if there is one."""
    figure = Figure(figsize=(12.5, 16), layout="constrained")
    minutes = [(state.at_s - states[0].at_s) / 60 for state in states]
    for axes, (field, (name, unit)) in zip(figure.subplots(5, 2).flat, FIGURES.items(), strict=False):
        found = slopes.get(field)
        verdict = "" if found is None else f": {found.per_hour:+.3g} an hour, {found.verdict}"
        prepared(axes, f"{name}{unit and f', {unit}'}{verdict}", "minutes", "").plot(minutes, column(states, field))
        if found is not None:  # through the median of the settled samples, in the middle of their time
            half = found.per_hour * found.hours / 2
            ends = (minutes[-1] - 60 * found.hours, minutes[-1])
            axes.plot(ends, (found.level - half, found.level + half))
    figure.axes[-1].remove()
    return figure


def _curves(axes: Axes, curves: Mapping[str, tuple[str, Value]], steps: Sequence[Step], last: str) -> None:
    for name, (colour, of) in curves.items():
        known = [(step.account.offered_per_s, y) for step in steps if (y := of(step)) is not None]
        if known:
            rates, values = zip(*known, strict=True)
            axes.plot(rates, values, marker="o", color=colour, label=f"{name}: {last.format(values[-1])}")
