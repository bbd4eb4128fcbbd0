"""What was measured: a table for people, JSON for programs, Markdown for BENCHMARKS.md."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any


@dataclass(frozen=True)
class Figure:
    """One measured or counted number; less is better but where `target_is_least` says otherwise.

    Attributes:
        part: what it belongs to.
        name: what it is.
        value: the number; None if it was not measured.
        unit: of the number and those below.
        again: the same measured a second time.
        floor: what no program is better than.
        predicted: before it was measured.
        target: what is wanted.
        target_is_least: whether more is better.
        note: anything else, the reason if it was not measured.
    """

    part: str
    name: str
    value: float | None
    unit: str
    again: float | None = None
    floor: float | None = None
    predicted: float | None = None
    target: float | None = None
    target_is_least: bool = False
    note: str = ""

    @property
    def is_met(self) -> bool | None:
        """Whether the target is reached; None without one, or without a number."""
        if self.target is None or self.value is None:
            return None
        return self.value >= self.target if self.target_is_least else self.value <= self.target


HEADINGS = ("part", "figure", "measured", "again", "floor", "x floor", "predicted", "target", "met", "note")


def markdown(title: str, figures: Sequence[Figure]) -> list[str]:
    """The lines of a section."""
    rows = [_cells(figure) for figure in figures]
    return [
        title,
        "",
        f"| {' | '.join(HEADINGS)} |",
        "|" + "---|" * len(HEADINGS),
        *(f"| {' | '.join(row)} |" for row in rows),
    ]


def table(figures: Sequence[Figure]) -> list[str]:
    """The same in columns of equal width."""
    rows = [HEADINGS, *(_cells(figure) for figure in figures)]
    widths = [max(len(row[i]) for row in rows) for i in range(len(HEADINGS))]
    return ["  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip() for row in rows]


def as_json(title: str, figures: Sequence[Figure], details: dict[str, Any]) -> dict[str, Any]:
    """The same for programs."""
    return {"title": title, "figures": [{**asdict(it), "met": it.is_met} for it in figures], **details}


def _cells(figure: Figure) -> tuple[str, ...]:
    ratio = figure.value / figure.floor if figure.value and figure.floor else None
    met = {True: "yes", False: "no", None: ""}[figure.is_met]
    measured = "not measured" if figure.value is None else f"{_short(figure.value)} {figure.unit}"
    sign = "at least " if figure.target_is_least else "at most "
    target = "" if figure.target is None else sign + _short(figure.target)
    numbers = (figure.again, figure.floor, ratio, figure.predicted)
    return (figure.part, figure.name, measured, *map(_short, numbers), target, met, figure.note)


def _short(value: float | None) -> str:
    """Three digits that count."""
    if value is None:
        return ""
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"
