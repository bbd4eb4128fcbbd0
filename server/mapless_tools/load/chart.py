"""A picture of latency and goodput against offered load.

Above, how long answers and refusals took; below, how many answers came in time and how many calls were refused. A good
server answers as much at three times its load as at its best, and says no at once.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

import cv2
import numpy as np

from mapless_tools.demo.picture import AMBER, BACKGROUND, FAINT, GREEN, INK, RED, Canvas, Colour, png

from .pipeline import PipelineResult
from .report import machine
from .step import Step

SIZE_PX = (1500, 1080)
BLUE: Colour = (110, 170, 255)
GRID: Colour = (52, 56, 62)
_LEFT_PX, _RIGHT_PX = 110, 1130
_DECADE_TICKS = (1, 2, 5)
Figure = Callable[[Step], float | None]


@dataclass(frozen=True)
class Panel:
    """A rectangle of the picture with its two scales.

    Attributes:
        top_px, bottom_px: of the picture.
        x_max: the left edge is 0.
        y_range: at the bottom and at the top.
        logarithmic: whether the y scale is.
    """

    top_px: int
    bottom_px: int
    x_max: float
    y_range: tuple[float, float]
    logarithmic: bool

    def place(self, x: float, y: float) -> tuple[int, int]:
        """The pixel of a point; what lies outside is put on the edge."""
        low, high = self.y_range
        y = min(max(y, low), high)
        share = np.log(y / low) / np.log(high / low) if self.logarithmic else (y - low) / (high - low)
        return (
            round(_LEFT_PX + (_RIGHT_PX - _LEFT_PX) * min(max(x / self.x_max, 0.0), 1.0)),
            round(self.bottom_px - (self.bottom_px - self.top_px) * float(share)),
        )


@dataclass(frozen=True, eq=False)
class Curve:
    """A figure of each step, and how it is drawn."""

    label: str
    colour: Colour
    of: Figure


LATENCY = (
    Curve("answers, p99", RED, lambda step: step.account.answers.p99_ms),
    Curve("answers, p95", AMBER, lambda step: step.account.answers.p95_ms),
    Curve("answers, p50", GREEN, lambda step: step.account.answers.p50_ms),
    Curve("refusals, p99", BLUE, lambda step: step.account.refusals.p99_ms),
)
RATES = (
    Curve("answered in time", GREEN, lambda step: step.account.goodput_per_s),
    Curve("refused", BLUE, lambda step: step.account.refused_per_s),
    Curve("overdue, in vain", RED, lambda step: step.account.overdue_per_s),
)


def draw_load(result: PipelineResult) -> bytes:
    """The picture as a PNG file; the steps' own offered rates are its x axis."""
    canvas: Canvas = np.full((SIZE_PX[1], SIZE_PX[0], 3), BACKGROUND, np.uint8)
    steps = sorted(result.steps, key=lambda step: step.account.offered_per_s)
    x_max = 1.04 * max(step.account.offered_per_s for step in steps)
    latencies_ms = [ms for step in steps for curve in LATENCY if (ms := curve.of(step)) is not None]
    unloaded_ms = result.unloaded.account.answers.p50_ms
    known_ms = [ms for ms in (*latencies_ms, unloaded_ms, 1000 * result.options.deadline_s) if ms]
    upper = Panel(160, 590, x_max, _decades(min(known_ms), 1.6 * max(known_ms)), logarithmic=True)
    top_rate = 1.12 * max(value for step in steps for curve in RATES if (value := curve.of(step)) is not None)
    lower = Panel(680, 990, x_max, (0.0, max(top_rate, 1.12 * result.saturation_per_s)), logarithmic=False)

    _write(canvas, "Latency and goodput against offered load", (_LEFT_PX - 70, 50), 1.1, INK)
    _write(canvas, f"{result.scene}; {machine()}", (_LEFT_PX - 70, 84), 0.55, FAINT)
    _write(canvas, _method(result), (_LEFT_PX - 70, 108), 0.55, FAINT)
    for panel, title in ((upper, "milliseconds from when a call was to be sent"), (lower, "calls a second")):
        _grid(canvas, panel, result)
        _write(canvas, title, (_LEFT_PX, panel.top_px - 12), 0.6, INK)
    _level(canvas, upper, 1000 * result.options.deadline_s, "deadline")
    if unloaded_ms is not None:
        _level(canvas, upper, unloaded_ms, "one call at a time, p50", at_right=True)
    _level(canvas, lower, result.saturation_per_s, "saturation: the most it can answer")
    _dashed(canvas, lower.place(0, 0), lower.place(lower.y_range[1], lower.y_range[1]), FAINT)
    for panel, curves in ((upper, LATENCY), (lower, RATES)):
        for curve in curves:
            _curve(canvas, panel, curve, steps)
        _name(canvas, panel, curves, steps)
    _x_axis(canvas, lower, result)
    return png(canvas)


def _method(result: PipelineResult) -> str:
    options = result.options
    return (
        f"{options.clients} clients, Poisson arrivals whatever the answers, {options.step_s:g} s a step without its "
        f"first {options.settle_s:g} s, deadline {options.deadline_s:g} s; dashed below: every call answered"
    )


def _decades(low: float, high: float) -> tuple[float, float]:
    """Round numbers around a range: 1, 2 or 5 times a power of ten."""
    ticks = [digit * 10.0**power for power in range(-3, 8) for digit in _DECADE_TICKS]
    return max(tick for tick in ticks if tick <= low), min(tick for tick in ticks if tick >= high)


def _ticks(panel: Panel) -> list[float]:
    low, high = panel.y_range
    if panel.logarithmic:
        powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
        ticks = [digit * 10.0**power for power in powers for digit in _DECADE_TICKS]
        return [tick for tick in ticks if low * 0.999 <= tick <= high * 1.001]
    return _round_steps(high)


def _round_steps(high: float) -> list[float]:
    """Round numbers from 0 up to at most `high`, four to ten of them."""
    power = 10.0 ** np.floor(np.log10(high))
    step = next(s * power for s in (0.1, 0.2, 0.5, 1.0, 2.0) if high / (s * power) <= 9)
    return [float(number * step) for number in range(int(high / step) + 1)]


def _grid(canvas: Canvas, panel: Panel, result: PipelineResult) -> None:
    for tick in _ticks(panel):
        start, end = panel.place(0, tick), panel.place(panel.x_max, tick)
        cv2.line(canvas, start, end, GRID, 1, cv2.LINE_AA)
        text = f"{tick:g}"
        _write(canvas, text, (start[0] - 14 - 11 * len(text), start[1] + 6), 0.55, FAINT)
    x = panel.place(result.saturation_per_s, panel.y_range[0])[0]
    cv2.line(canvas, (x, panel.top_px), (x, panel.bottom_px), GRID, 2, cv2.LINE_AA)


def _x_axis(canvas: Canvas, panel: Panel, result: PipelineResult) -> None:
    for tick in _round_steps(panel.x_max):
        x, y = panel.place(tick, panel.y_range[0])
        cv2.line(canvas, (x, y), (x, y + 6), FAINT, 1, cv2.LINE_AA)
        _centred(canvas, f"{tick:g}", (x, y + 26), FAINT)
    for share in (0.5, 1.0, 1.5, 2.0, 2.5, 3.0):
        if share * result.saturation_per_s <= panel.x_max:
            x, y = panel.place(share * result.saturation_per_s, panel.y_range[0])
            _centred(canvas, f"{100 * share:.0f} %", (x, y + 58), FAINT)
    _write(canvas, "offered calls a second", (_RIGHT_PX + 24, panel.bottom_px + 26), 0.55, FAINT)
    _write(canvas, "of saturation", (_RIGHT_PX + 24, panel.bottom_px + 58), 0.55, FAINT)


def _level(canvas: Canvas, panel: Panel, value: float, label: str, at_right: bool = False) -> None:
    start, end = panel.place(0, value), panel.place(panel.x_max, value)
    _dashed(canvas, start, end, FAINT)
    place = (end[0] - 200, end[1] + 20) if at_right else (start[0] + 10, start[1] - 8)
    _write(canvas, label, place, 0.5, FAINT)


def _dashed(canvas: Canvas, start: tuple[int, int], end: tuple[int, int], colour: Colour) -> None:
    length = float(np.hypot(end[0] - start[0], end[1] - start[1]))
    direction = np.subtract(end, start) / max(length, 1.0)
    for offset in np.arange(0.0, length, 12.0):
        a, b = start + direction * offset, start + direction * min(offset + 6.0, length)
        cv2.line(canvas, (round(a[0]), round(a[1])), (round(b[0]), round(b[1])), colour, 1, cv2.LINE_AA)


def _curve(canvas: Canvas, panel: Panel, curve: Curve, steps: Sequence[Step]) -> None:
    values = [(step.account.offered_per_s, curve.of(step)) for step in steps]
    places = [panel.place(x, y) for x, y in values if y is not None]
    for start, end in pairwise(places):
        cv2.line(canvas, start, end, curve.colour, 2, cv2.LINE_AA)
    for place in places:
        cv2.circle(canvas, place, 5, curve.colour, -1, cv2.LINE_AA)


def _name(canvas: Canvas, panel: Panel, curves: Sequence[Curve], steps: Sequence[Step]) -> None:
    """Labels and last values right of the curves' ends, moved apart where these are close to one another."""
    ends = []
    for curve in curves:
        known = [(step.account.offered_per_s, y) for step in steps if (y := curve.of(step)) is not None]
        if known:
            ends.append((panel.place(*known[-1])[1], known[-1][1], curve))
    below = -1000
    for y_px, value, curve in sorted(ends, key=lambda end: end[0]):
        below = max(y_px, below + 26)
        text = f"{curve.label}: {value:.0f} ms" if panel.logarithmic else f"{curve.label}: {value:.1f}/s"
        _write(canvas, text, (_RIGHT_PX + 24, below + 6), 0.6, curve.colour)


def _centred(canvas: Canvas, text: str, place: tuple[int, int], colour: Colour) -> None:
    (width, _), _ = cv2.getTextSize(text, cv2.FONT_HERSHEY_SIMPLEX, 0.55, 1)
    _write(canvas, text, (place[0] - width // 2, place[1]), 0.55, colour)


def _write(canvas: Canvas, text: str, origin: tuple[int, int], scale: float, colour: Colour) -> None:
    cv2.putText(canvas, text, origin, cv2.FONT_HERSHEY_SIMPLEX, scale, colour, 1, cv2.LINE_AA)
