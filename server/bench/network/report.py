"""The figures: a table for people, JSON for programs, Markdown."""

import textwrap
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from mapless_tools.output_files import markdown_table, text_table


@dataclass(frozen=True)
class Figure:
    """One number, `again` the same measured a second time; less is better unless `target_is_least`."""

    part: str
    name: str
    value: float | None
    unit: str
    again: float | None = None
    floor_ms: float | None = None
    target: float | None = None
    target_is_least: bool = False
    note: str = ""

    @property
    def is_met(self) -> bool | None:
        """Whether the target is reached; None without a target or a number."""
        if self.target is None or self.value is None:
            return None
        return self.value >= self.target if self.target_is_least else self.value <= self.target


HEADINGS = ("figure", "measured", "again", "floor, ms", "x floor", "target", "met")
COLUMNS = 120
"""Width of the table on a terminal, in characters."""


def markdown(title: str, figures: Sequence[Figure]) -> list[str]:
    """The lines of a section."""
    rows = ((figure.part, *_cells(figure), figure.note) for figure in figures)
    return [title, "", *markdown_table(" | ".join(("part", *HEADINGS, "note")), rows)]


def table(figures: Sequence[Figure]) -> list[str]:
    """The same in columns of equal width, with a heading for each part; only notes on why something is not measured."""
    lines = text_table([HEADINGS, *map(_cells, figures)])
    result = [f"  {lines[0]}"]
    part = None
    for figure, line in zip(figures, lines[1:], strict=True):
        if figure.part != part:
            part = figure.part
            result.append(part)
        result.append(f"  {line}")
    for figure in figures:
        if figure.value is None:
            reason = f"Not measured: {figure.part}, {figure.name}: {figure.note}"
            result += textwrap.wrap(reason, COLUMNS, subsequent_indent="  ")
    return result


def as_json(title: str, figures: Sequence[Figure]) -> dict[str, Any]:
    """The same for programs."""
    return {"title": title, "figures": [{**asdict(it), "met": it.is_met} for it in figures]}


def _cells(figure: Figure) -> tuple[str, ...]:
    ratio = figure.value / figure.floor_ms if figure.value and figure.floor_ms and figure.unit == "ms" else None
    met = {True: "yes", False: "no", None: ""}[figure.is_met]
    measured = "not measured" if figure.value is None else f"{_short(figure.value)} {figure.unit}".rstrip()
    sign = "at least " if figure.target_is_least else "at most "
    target = "" if figure.target is None else sign + _short(figure.target)
    numbers = (figure.again, figure.floor_ms, ratio)
    return (figure.name, measured, *map(_short, numbers), target, met)


def _short(value: float | None) -> str:
    """A number with three significant digits."""
    if value is None:
        return ""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
