"""The progress of a command, on standard error: a bar on a terminal, lines in a log."""

import sys
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    ProgressColumn,
    Task,
    TaskID,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)
from rich.progress import Progress as Bars
from rich.text import Text

T = TypeVar("T")

LEAST_RATED_S = 0.5
"""A line of a log says how much is done a second only after so long."""

LINES = 10
"""Lines of a step in a log, after that of its beginning."""
Progress = Callable[[str, int, int], None]
"""Called with a step's name, how much of it is done, and how much there is."""


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """A bar for each step; where standard error is not a terminal, a line now and then. For one thread at a time."""
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _lines()
        return
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        _RateColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Bars(*columns, console=console, transient=True) as bars:
        tasks: dict[str, TaskID] = {}

        def progress(step: str, done: int, total: int) -> None:
            if step not in tasks:
                tasks[step] = bars.add_task(step, total=total)
            bars.update(tasks[step], completed=done, total=total)

        yield progress


def tracked(step: str, items: Iterable[T], total: int, progress: Progress) -> Iterator[T]:
    """Yields the items, and reports each as done when the next is asked for."""
    progress(step, 0, total)
    for done, item in enumerate(items, 1):
        yield item
        progress(step, done, total)


def labelled(progress: Progress, label: str) -> Progress:
    """A progress whose steps begin with this label."""
    return lambda step, done, total: progress(f"{label}: {step}", done, total)


class _RateColumn(ProgressColumn):
    """How much of a step is done a second."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        return Text("" if speed is None else _rate(speed))


def _rate(per_s: float) -> str:
    return f"{per_s:.1f} a second"


def _lines() -> Progress:
    printed: dict[str, int] = {}
    begun_s: dict[str, float] = {}

    def progress(step: str, done: int, total: int) -> None:
        took_s = time.monotonic() - begun_s.setdefault(step, time.monotonic())
        part = done * LINES // total if total else LINES
        if part > printed.get(step, -1):
            rate = f", {_rate(done / took_s)}" if took_s >= LEAST_RATED_S else ""
            print(step if total == 1 else f"{step}: {done} of {total}{rate}", file=sys.stderr, flush=True)
            printed[step] = part

    return progress
