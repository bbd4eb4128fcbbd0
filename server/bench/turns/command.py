"""Reads what is to be compared, measures it, and prints tables."""

import tempfile
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from mapless_server.serve.signals import terminable
from mapless_tools.dataset import Frame
from mapless_tools.evaluate.plan import EvaluationOptions, split_frames
from mapless_tools.ingest.formats.cameras import read_folder
from mapless_tools.usage import UsageError, failures_end_command, usage_errors

from .comparison import table
from .query import agreement, figures_of, measure, resized
from .servers import Side, sides
from .whole import measure_import, measure_saturation, measure_start

START_FEATURES = ("sift", "auto")


class What(StrEnum):
    """The measures."""

    QUERY = "query"
    IMPORT = "import"
    START = "start"
    SATURATION = "saturation"


@dataclass(frozen=True)
class Plan:
    """The photographs, and how often and how each is measured."""

    references: Sequence[Frame]
    queries: Sequence[Frame]
    rounds: int
    tracking: bool
    background: bool
    seconds: float


def main(
    before: Annotated[str, typer.Argument(help="A commit, in the repository of the current folder.")],
    after: Annotated[str, typer.Argument(help="Another one; default: the working tree.")] = "",
    what: Annotated[list[What] | None, typer.Option(help="What is measured; may be repeated. Default: query.")] = None,
    data: Annotated[Path, typer.Option(help="Folder with photographs and poses.")] = Path("../shared/data"),
    scene: Annotated[str, typer.Option(help="Folder in it.")] = "7scenes-redkitchen-seq01-first600",
    references: Annotated[int, typer.Option(min=2, help="Photographs that are stored.")] = 30,
    photographs: Annotated[int, typer.Option(min=2, help="Photographs that are localized.")] = 20,
    width_px: Annotated[int, typer.Option(min=0, help="Width of all photographs; 0: as they are.")] = 0,
    rounds: Annotated[int, typer.Option(min=1, help="Times that each is measured A B B A.")] = 1,
    seconds: Annotated[float, typer.Option(min=1.0, help="Length of a turn at saturation.")] = 15.0,
    background: Annotated[bool, typer.Option(help="Import with the work in the background.")] = False,
    tracking: Annotated[
        bool, typer.Option(help="Queries with a pose prior, off by 5 cm and 2 degrees about each axis.")
    ] = False,
) -> None:
    """Compare what two commits cost; settings are those of the environment (MAPLESS_...)."""
    with failures_end_command():
        with usage_errors():
            if not before:
                raise UsageError("no commit to compare with was given: make bench-turns BEFORE=commit")
            options = EvaluationOptions(references, photographs)
            stored, queries = split_frames(read_folder(data / scene).frames, options)
        with terminable(), ExitStack() as stack:
            if width_px:
                folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="mapless-turns-")))
                stored, queries = resized(stored, width_px, folder), resized(queries, width_px, folder)
            plan = Plan(stored, queries, rounds, tracking, background, seconds)
            pair = stack.enter_context(sides(before, after))
            print(f"{before} and {after or 'working tree'} by turns (A B B A), {rounds} rounds, medians.", flush=True)
            for it in what or [What.QUERY]:
                for line in _lines(it, pair, plan):
                    print(line, flush=True)


def _lines(what: What, pair: tuple[Side, Side], plan: Plan) -> Iterator[str]:
    references, queries, rounds = plan.references, plan.queries, plan.rounds
    yield from ("", f"{what}: {len(references)} references, {len(queries)} photographs.", "")
    match what:
        case What.QUERY:
            with ExitStack() as stack:
                servers = [stack.enter_context(side.server("query")) for side in pair]
                measured = measure(servers, references, queries, rounds, plan.tracking)
            yield from (*table(figures_of(measured)), "", agreement(measured))
        case What.IMPORT:
            yield from table(measure_import(pair, references, queries[0], rounds, plan.background))
        case What.START:
            for features in START_FEATURES:
                yield from (*table(measure_start(pair, references, queries[0], rounds, features)), "")
        case What.SATURATION:
            yield from table(measure_saturation(pair, references, queries, rounds, plan.seconds))
