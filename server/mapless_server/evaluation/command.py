"""`mapless-server evaluate`: arguments in, table and JSON out."""

from __future__ import annotations

import json
import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TaskID, TextColumn, TimeElapsedColumn
from rich.progress import Progress as Bars

from ..dataset import read_folder
from ..settings import ConfigError, load_settings
from ..signals import terminable
from .plan import EvaluationOptions, Progress, UsageError
from .report import print_report, to_json
from .run import evaluate


@contextmanager
def usage_errors() -> Iterator[None]:
    """Faults of what a person gave, as UsageError; to be held around what checks it, not around what computes."""
    try:
        yield
    except (ValueError, ConfigError) as error:
        raise UsageError(str(error)) from error


def evaluate_folder(folder: Path, json_file: Path | None, **options: Any) -> None:
    """Measures the server on a folder, prints the table and writes the JSON file.

    Args:
        folder: with images/ and cameras.json.
        json_file: where to write; None for nowhere.
        options: those of EvaluationOptions.

    Raises:
        UsageError: a wrong folder, option, file or setting.
        ServerFailed: the server did not start.
        MaplessError: a call failed.
    """
    with usage_errors():
        checked = EvaluationOptions(**options)
        dataset = read_folder(folder)
        settings = load_settings({}).settings
        if json_file is not None:
            check_writable(json_file)
    with terminable(), progress_bars() as progress:
        evaluation = evaluate(dataset, checked, settings, progress)
    print_report(evaluation, Console())
    if json_file is not None:
        write_json(json_file, to_json(evaluation))


def check_writable(file: Path) -> None:
    """Raises ValueError if a file cannot be written: before the work, not after it. Makes nothing yet."""
    target = file if file.exists() else file.parent
    if file.is_dir() or not file.parent.is_dir() or not os.access(target, os.W_OK):
        raise ValueError(f"{file} cannot be written")


def write_json(file: Path, content: Any) -> None:
    """Writes strict JSON; it has no infinities."""
    file.write_text(json.dumps(content, indent=1, ensure_ascii=False, allow_nan=False) + "\n", encoding="utf-8")


@contextmanager
def progress_bars() -> Iterator[Progress]:
    """A bar for each step, on standard error; where that is not a terminal, a line when a step begins."""
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    console = Console(stderr=True)
    with Bars(*columns, console=console, transient=True, disable=not console.is_terminal) as bars:
        tasks: dict[str, TaskID] = {}

        def progress(step: str, done: int, total: int) -> None:
            if step not in tasks:
                tasks[step] = bars.add_task(step, total=total)
            bars.update(tasks[step], completed=done, total=total)

        def announce(step: str, done: int, total: int) -> None:
            if done == 0:
                print(f"{step}: {total}", file=sys.stderr, flush=True)

        yield progress if console.is_terminal else announce
