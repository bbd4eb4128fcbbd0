"""A picture of a soak: what the server held from minute to minute, and the slope that was found."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from mapless_tools.evaluate.svg import HEIGHT, STYLE, WIDTH, Axis, Chart, Curve, draw

from .slopes import Slope
from .state import ServerState, column

PANELS: tuple[tuple[str, str], ...] = (
    ("resident_mib", "memory, MiB"),
    ("unique_mib", "memory of its own, MiB"),
    ("python_blocks", "Python's blocks, thousands"),
    ("threads", "threads"),
    ("descriptors", "open files and sockets"),
    ("sockets", "sockets"),
    ("data_mib", "data folder, MiB"),
    ("waiting_jobs", "jobs that wait"),
    ("loop_lag_ms", "event loop late, ms"),
)
_COLUMNS = 2
_PANEL_HEIGHT = HEIGHT + 16


def draw_soak(states: Sequence[ServerState], slopes: Mapping[str, Slope]) -> str:
    """An SVG file with a panel for each figure."""
    rows = -(-len(PANELS) // _COLUMNS)
    width, height = WIDTH * _COLUMNS, _PANEL_HEIGHT * rows
    parts = [
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" width="{width}" height="{height}">',
        f"<style>{STYLE}</style>",
        '<rect width="100%" height="100%" fill="#fff"/>',
    ]
    for number, (field, label) in enumerate(PANELS):
        left, top = WIDTH * (number % _COLUMNS), _PANEL_HEIGHT * (number // _COLUMNS)
        parts.append(f'<svg x="{left}" y="{top}" width="{WIDTH}" height="{_PANEL_HEIGHT}">')
        parts.append(draw(_panel(states, field, label, slopes.get(field))))
        parts.append("</svg>")
    return "\n".join((*parts, "</svg>", ""))


def _panel(states: Sequence[ServerState], field: str, label: str, found: Slope | None) -> Chart:
    minutes = [(state.at_s - states[0].at_s) / 60 for state in states]
    each = 0.001 if field == "python_blocks" else 1.0
    values = [each * value for value in column(states, field)]
    curves = [Curve("seen", tuple(zip(minutes, values, strict=True)))]
    if found is not None:
        curves.append(Curve(f"{each * found.per_hour:+.3g} an hour: {found.verdict}", _line(minutes, each, found)))
    margin = max(1.0, 0.1 * (max(values) - min(values)))
    y = Axis(label, max(0.0, min(values) - margin), max(values) + margin)
    return Chart(label, Axis("minutes", 0, max(minutes[-1], 1.0)), y, tuple(curves))


def _line(minutes: Sequence[float], each: float, found: Slope) -> tuple[tuple[float, float], ...]:
    """Through the median of the settled samples, in the middle of their time."""
    end, begin = minutes[-1], minutes[-1] - 60 * found.hours
    half = each * found.per_hour * found.hours / 2
    return ((begin, each * found.level - half), (end, each * found.level + half))
