"""`mapless-server evaluate`: arguments in, table and JSON out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from rich.console import Console

from mapless_server.serve.signals import terminable
from mapless_server.settings import ConfigError, load_settings
from mapless_tools.dataset import read_folder
from mapless_tools.output_files import check_writable, write_json
from mapless_tools.progress import progress_bars

from .plan import EvaluationOptions, UsageError
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
