"""The progress of a command, on standard error: a bar on a terminal, lines in a log."""

import sys
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import TypeVar

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn, TimeRemainingColumn
from rich.progress import Progress as Bars

T = TypeVar("T")

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


def _lines() -> Progress:
    printed: dict[str, int] = {}

    def progress(step: str, done: int, total: int) -> None:
        part = done * LINES // total if total else LINES
        if part > printed.get(step, -1):
            print(step if total == 1 else f"{step}: {done} of {total}", file=sys.stderr, flush=True)
            printed[step] = part

    return progress
