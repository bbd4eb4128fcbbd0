"""Line charts as SVG: no library, no script, readable in light and dark, in colour and without.

Colours come from `STYLE` (classes c0, c1, ...), which goes into the page; text has the page's colour. Curves differ in
their dashes too.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape

WIDTH, HEIGHT = 640, 360
_LEFT, _RIGHT, _TOP, _BOTTOM = 64, 12, 34, 50
_GRID = 'stroke="currentColor" stroke-opacity=".15"'
_DASHES = ("", "8 3", "12 3 3 3", "5 2")
_DOTS = ("1.5 3", "1.5 5", "1.5 2 1.5 6", "1.5 1.5")

_LIGHT = ("#0b62c4", "#c2410c", "#0f7b4a", "#a1157a", "#6d5500", "#5b3cc4", "#b3202a", "#44515e")
_DARK = ("#6cb2ff", "#ff9d5c", "#5fd99b", "#f58ad6", "#e0c04a", "#b39dff", "#ff8a8a", "#a9b6c3")


def _colours(colours: Sequence[str]) -> str:
    return "\n".join(
        f".c{i} {{ stroke: {colour}; }} circle.c{i} {{ fill: {colour}; }}" for i, colour in enumerate(colours)
    )


STYLE = f"""
svg.chart {{ width: 100%; max-width: 640px; height: auto; }}
{_colours(_LIGHT)}
@media (prefers-color-scheme: dark) {{
{_colours(_DARK)}
}}
"""
"""What the page's style sheet needs for charts."""


@dataclass(frozen=True)
class Axis:
    """A scale of a chart.

    Attributes:
        label: with the unit.
        low, high: its ends.
        logarithmic: whether equal steps are equal factors; `low` is then above 0. Otherwise it is of whole numbers.
        names: of the positions 0, 1, ...; none for numbers.
    """

    label: str
    low: float
    high: float
    logarithmic: bool = False
    names: tuple[str, ...] = ()

    def share(self, value: float) -> float:
        """Where a value lies, 0 to 1; what is beyond the ends is put there."""
        value = min(max(value, self.low), self.high)
        if self.logarithmic:
            return math.log(value / self.low) / math.log(self.high / self.low)
        return (value - self.low) / (self.high - self.low)

    def ticks(self) -> list[tuple[float, str]]:
        """Round values and their names; no more than a reader wants."""
        if self.names:
            return [(float(i), name) for i, name in enumerate(self.names)]
        if self.logarithmic:
            first, last = math.floor(math.log10(self.low)), math.ceil(math.log10(self.high))
            digits = (1, 2, 5) if last - first <= 3 else (1,)
            values = [digit * 10.0**power for power in range(first, last + 1) for digit in digits]
        else:
            power = 10.0 ** math.floor(math.log10(self.high - self.low))
            step = next(s * power for s in (0.1, 0.2, 0.5, 1.0, 2.0) if (self.high - self.low) / (s * power) <= 8)
            step = max(step, 1.0)
            values = [round(i * step, 9) for i in range(math.ceil(self.low / step), math.floor(self.high / step) + 1)]
        return [(v, f"{v:g}") for v in values if self.low * 0.9999 <= v <= self.high * 1.0001]


@dataclass(frozen=True)
class Curve:
    """A line of a chart.

    Attributes:
        points: (x, y) in order; an infinite y is a failure, drawn as a cross at the upper edge, and breaks the line.
        from_paper: whether it is not of our measuring: drawn thinner and dotted.
        marked: whether each point is marked.
        joined: whether a line goes through the points; without one, each is marked.
    """

    name: str
    points: tuple[tuple[float, float], ...]
    from_paper: bool = False
    marked: bool = False
    joined: bool = True


@dataclass(frozen=True)
class Chart:
    """A chart: what it shows in a sentence, two axes, and its curves."""

    title: str
    x: Axis
    y: Axis
    curves: tuple[Curve, ...]


def log_range(values: Sequence[float], smallest: float) -> tuple[float, float]:
    """Powers of ten around the finite values, `smallest` below which nothing is told apart; at least one decade."""
    finite = [max(value, smallest) for value in values if math.isfinite(value)] or [1.0]
    low, high = 10.0 ** math.floor(math.log10(min(finite))), 10.0 ** math.ceil(math.log10(max(finite)))
    return low, max(high, 10 * low)


def draw(chart: Chart) -> str:
    """The chart as an <svg> element."""
    rows = -(-len(chart.curves) // 3)
    height = HEIGHT + 16 * rows
    parts = [
        f'<svg class="chart" viewBox="0 0 {WIDTH} {height}" role="img" aria-label="{escape(chart.title, quote=True)}" '
        'font-family="system-ui, sans-serif" font-size="12" fill="currentColor">',
        f'<text x="{_LEFT}" y="18" font-weight="600">{escape(chart.title)}</text>',
        *_grid(chart),
    ]
    for number, curve in enumerate(chart.curves):
        parts += _curve(chart, curve, number)
        parts.append(_legend(curve, number))
    return "\n".join((*parts, "</svg>"))


def _place(chart: Chart, x: float, y: float) -> tuple[float, float]:
    return (
        round(_LEFT + (WIDTH - _LEFT - _RIGHT) * chart.x.share(x), 1),
        round(HEIGHT - _BOTTOM - (HEIGHT - _TOP - _BOTTOM) * chart.y.share(y), 1),
    )


def _grid(chart: Chart) -> list[str]:
    left, bottom = _place(chart, chart.x.low, chart.y.low)
    right, top = _place(chart, chart.x.high, chart.y.high)
    parts = []
    for value, name in chart.x.ticks():
        x = _place(chart, value, chart.y.low)[0]
        parts.append(f'<line {_GRID} x1="{x}" y1="{top}" x2="{x}" y2="{bottom}"/>')
        parts.append(f'<text x="{x}" y="{bottom + 16}" text-anchor="middle">{escape(name)}</text>')
    for value, name in chart.y.ticks():
        y = _place(chart, chart.x.low, value)[1]
        parts.append(f'<line {_GRID} x1="{left}" y1="{y}" x2="{right}" y2="{y}"/>')
        parts.append(f'<text x="{left - 6}" y="{y + 4}" text-anchor="end">{escape(name)}</text>')
    middle = (top + bottom) / 2
    return [
        *parts,
        f'<rect fill="none" stroke="currentColor" stroke-opacity=".5" x="{left}" y="{top}" '
        f'width="{right - left:.1f}" height="{bottom - top:.1f}"/>',
        f'<text x="{(left + right) / 2}" y="{bottom + 34}" text-anchor="middle">{escape(chart.x.label)}</text>',
        f'<text transform="translate(14 {middle}) rotate(-90)" text-anchor="middle">{escape(chart.y.label)}</text>',
    ]


def _colour(number: int) -> str:
    """The class, and the colour for a reader without the style sheet."""
    return f'class="c{number % len(_LIGHT)}" stroke="{_LIGHT[number % len(_LIGHT)]}"'


def _stroke(curve: Curve, number: int) -> str:
    dashes = (_DOTS if curve.from_paper else _DASHES)[number % 4]
    return f'{_colour(number)} fill="none" stroke-width="1.8" stroke-linejoin="round" stroke-dasharray="{dashes}"'


def _curve(chart: Chart, curve: Curve, number: int) -> list[str]:
    colour = _colour(number)
    parts: list[str] = []
    piece: list[tuple[float, float]] = []
    for x, y in (*curve.points, (0.0, math.inf)):
        if math.isfinite(y):
            piece.append(_place(chart, x, y))
            continue
        if len(piece) > 1 and curve.joined:
            parts.append(f'<polyline {_stroke(curve, number)} points="{" ".join(f"{a},{b}" for a, b in piece)}"/>')
        if curve.marked or not curve.joined or len(piece) == 1:
            parts += [
                f'<circle {colour} fill="{_LIGHT[number % len(_LIGHT)]}" cx="{a}" cy="{b}" r="2.6"/>' for a, b in piece
            ]
        piece = []
    for x, y in curve.points:
        if not math.isfinite(y):
            a, b = _place(chart, x, chart.y.high)
            parts.append(f'<path {colour} fill="none" stroke-width="1.6" d="M{a - 3},{b - 3}l6,6m0,-6l-6,6"/>')
    return parts


def _legend(curve: Curve, number: int) -> str:
    x, y = _LEFT + 190 * (number % 3), HEIGHT + 8 + 16 * (number // 3)
    sign = (
        f'<line {_stroke(curve, number)} x1="{x}" y1="{y - 4}" x2="{x + 24}" y2="{y - 4}"/>'
        if curve.joined
        else f'<circle {_colour(number)} fill="{_LIGHT[number % len(_LIGHT)]}" cx="{x + 12}" cy="{y - 4}" r="2.6"/>'
    )
    return f'{sign}<text x="{x + 30}" y="{y}">{escape(curve.name)}</text>'
