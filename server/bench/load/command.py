"""`python -m bench.load ...`: arguments in; tables, a picture and JSON out."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from mapless_tools.progress import Progress

    from .report import Check

load_app = typer.Typer(
    help="Measure what the server does under load. Figures go to load-output/load.json, pictures beside it: load.png "
    "of the pipeline, soak.svg of the soak; and the server's log.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_show_locals=False,  # which would print image bytes
)

Data = Annotated[Path | None, typer.Option(help="Folder with images/ and cameras.json; default: mapless's own room.")]
Output = Annotated[Path, typer.Option(help="Folder for the picture and the figures.")]
Quick = Annotated[bool, typer.Option(help="Seconds instead of minutes: to see that it runs. Not for figures.")]
Deadline = Annotated[float, typer.Option(help="Deadline of every call, seconds.")]
Clients = Annotated[int, typer.Option(help="Clients that call independently of one another.")]
Seed = Annotated[int, typer.Option(help="Of the arrivals.")]
Minutes = Annotated[float, typer.Option(help="How long the soak takes.")]

OUTPUT, OUTPUT_FILE = Path("load-output"), "load.json"


@load_app.command("overhead")
def overhead_command(quick: Quick = False, output: Output = OUTPUT) -> None:
    """Measures the cost of serving without computing, beside a bare grpc.aio server."""
    _finish(_overhead(quick, output))


@load_app.command("pipeline")
def pipeline_command(
    data: Data = None,
    quick: Quick = False,
    deadline_s: Deadline = 5.0,
    step_s: Annotated[float, typer.Option(help="Seconds at each load.")] = 60.0,
    clients: Clients = 8,
    seed: Seed = 0,
    output: Output = OUTPUT,
) -> None:
    """Latency, goodput and refusals of the real server from 30 to 300 % of what it can do; draws them."""
    _finish(_pipeline(data, quick, output, deadline_s=deadline_s, step_s=step_s, clients=clients, seed=seed))


@load_app.command("soak")
def soak_command(
    data: Data = None,
    minutes: Minutes = 10.0,
    quick: Quick = False,
    rate_per_s: Annotated[
        float | None, typer.Option(help="Queries a second; default: nine tenths of what the server can do.")
    ] = None,
    churn: Annotated[float, typer.Option(help="Pace of what goes on beside the queries; 0: nothing.")] = 1.0,
    deadline_s: Deadline = 5.0,
    clients: Clients = 8,
    seed: Seed = 0,
    output: Output = OUTPUT,
) -> None:
    """Everything that callers do, well and badly, for long: what grows, what is unaccounted for; draws it."""
    given = {"minutes": minutes, "rate_per_s": rate_per_s, "churn": churn, "deadline_s": deadline_s}
    _finish(_soak(data, quick, output, clients=clients, seed=seed, **given))


@load_app.command("neighbours")
def neighbours_command(
    data: Data = None,
    elsewhere: Annotated[
        Path | None, typer.Option(help="Folder as for --data of another place, which the neighbour asks about.")
    ] = None,
    quick: Quick = False,
    deadline_s: Deadline = 30.0,
    step_s: Annotated[float, typer.Option(help="Seconds alone, and seconds beside the neighbour.")] = 60.0,
    clients: Clients = 4,
    callers: Annotated[int, typer.Option(help="The neighbour's calls side by side, or the lost robots.")] = 8,
    own_tokens: Annotated[
        bool,
        typer.Option("--own-tokens", help="Each robot has a token of its own, and so has each lost one beside them."),
    ] = False,
    seed: Seed = 0,
    output: Output = OUTPUT,
) -> None:
    """A fleet under its token, alone and beside another token whose calls are endless and each of a new client."""
    given = {"deadline_s": deadline_s, "step_s": step_s, "clients": clients, "seed": seed}
    given |= {"callers": callers, "own_tokens": own_tokens}
    _finish(_neighbours(data, elsewhere, quick, output, **given))


@load_app.command("refusals")
def refusals_command(quick: Quick = False, output: Output = OUTPUT) -> None:
    """Measures the processor time of refusing a call, beside a bare grpc.aio server."""
    _finish(_refusals(quick, output))


@load_app.command("adoption")
def adoption_command(data: Data = None, quick: Quick = False, output: Output = OUTPUT) -> None:
    """Measures what adoption costs a query, also while another photograph is being considered."""
    _finish(_adoption(data, quick, output))


@load_app.command("all")
def all_command(data: Data = None, minutes: Minutes = 10.0, quick: Quick = False, output: Output = OUTPUT) -> None:
    """All of these but `neighbours` and `adoption`, one after the other."""
    checks = [*_overhead(quick, output), *_refusals(quick, output), *_pipeline(data, quick, output)]
    _finish(checks + _soak(data, quick, output, minutes=minutes))


def _overhead(quick: bool, output: Path) -> list[Check]:
    from .overhead import OverheadOptions, measure_overhead, overhead_checks, overhead_figures, overhead_lines
    from .report import report_part

    options = OverheadOptions(rounds=2, unloaded_s=0.3, saturated_s=0.5) if quick else OverheadOptions()
    with _measuring() as progress:
        subjects = measure_overhead(options, progress)
    checks, lines = overhead_checks(subjects), overhead_lines(subjects, options)
    report_part(output / OUTPUT_FILE, "overhead", lines, checks, overhead_figures(subjects, options))
    return checks


def _refusals(quick: bool, output: Path) -> list[Check]:
    from .refusals import RefusalOptions, measure_refusals, refusal_checks, refusal_lines
    from .report import report_part

    options = RefusalOptions(rounds=1) if quick else RefusalOptions()
    with _measuring() as progress:
        found = measure_refusals(options, progress)
    checks = refusal_checks(found)
    report_part(output / OUTPUT_FILE, "refusals", refusal_lines(found, options), checks, {"refusals": found})
    return checks


def _adoption(data: Path | None, quick: bool, output: Path) -> list[Check]:
    from mapless_tools.demo import place_of
    from mapless_tools.usage import usage_errors

    from .adoption import AdoptionCostOptions, adoption_checks, adoption_lines, measure_adoption
    from .report import report_part

    options = AdoptionCostOptions(rounds=1) if quick else AdoptionCostOptions()
    with _measuring() as progress:
        with usage_errors():
            place = place_of(data)
        times = measure_adoption(place, options, progress)
    checks = adoption_checks(times)
    report_part(output / OUTPUT_FILE, "adoption", adoption_lines(times), checks, {"times": times})
    return checks


def _pipeline(data: Path | None, quick: bool, output: Path, **given: Any) -> list[Check]:
    from mapless_tools.demo import place_of
    from mapless_tools.usage import usage_errors

    from .charts import draw_load
    from .pipeline import PipelineOptions, measure_pipeline, pipeline_checks, pipeline_json
    from .report import step_lines

    brief = {"unloaded_s": 4.0, "ramp_s": 4.0, "step_s": 6.0, "settle_s": 1.0} if quick else {}
    with _measuring() as progress:
        with usage_errors():
            options, place = PipelineOptions(**(given | brief)), place_of(data)
        log = _new_log(output, "pipeline")
        result = measure_pipeline(place, options, progress, log)
    lines, checks = step_lines(result.all_steps), pipeline_checks(result)
    _report_drawn(result.scene, lines, checks, pipeline_json(result), draw_load(result), output / "load.png", log)
    return checks


def _soak(data: Path | None, quick: bool, output: Path, **given: Any) -> list[Check]:
    from mapless_tools.demo import place_of
    from mapless_tools.usage import usage_errors

    from .charts import draw_soak
    from .report import step_lines
    from .soak import SoakOptions, least_minutes, measure_soak, soak_checks, soak_json, soak_lines

    brief = {"minutes": 0.25, "ramp_s": 4.0, "sample_every_s": 0.5, "churn": 4.0} if quick else {}
    with _measuring() as progress:
        with usage_errors():
            options, place = SoakOptions(**(given | brief)), place_of(data)
        least = least_minutes(options)
        if options.minutes < least:
            note = f"note: {options.minutes:g} minutes do not distinguish growth from settling; {least} are enough"
            print(note, file=sys.stderr, flush=True)
        log = _new_log(output, "soak")
        result = measure_soak(place, options, progress, log)
    lines, checks = [*step_lines([*result.before, result.soak]), *soak_lines(result)], soak_checks(result)
    figure = draw_soak(result.states, result.slopes)
    _report_drawn(result.scene, lines, checks, soak_json(result), figure, output / "soak.svg", log)
    return checks


def _neighbours(data: Path | None, elsewhere: Path | None, quick: bool, output: Path, **given: Any) -> list[Check]:
    from mapless_tools.demo import place_of
    from mapless_tools.usage import usage_errors

    from .neighbours import NeighbourOptions, measure_neighbours, neighbour_checks
    from .report import report_part, step_lines

    brief = {"ramp_s": 3.0, "step_s": 6.0, "settle_s": 1.0} if quick else {}
    with _measuring() as progress:
        with usage_errors():
            options, place = NeighbourOptions(**(given | brief)), place_of(data)
            other = None if elsewhere is None else place_of(elsewhere)
        log = _new_log(output, "neighbours")
        result = measure_neighbours(place, other, options, progress, log)
    lines, checks = [f"{place.title}:", "", *step_lines(result.all_steps)], neighbour_checks(result)
    report_part(output / OUTPUT_FILE, "neighbours", lines, checks, result, log)
    return checks


def _new_log(output: Path, part: str) -> Path:
    """An empty file for the log of the part's server, which would otherwise mix with progress and tables."""
    output.mkdir(parents=True, exist_ok=True)
    log = output / f"{part}-server.log"
    log.write_bytes(b"")
    return log


def _report_drawn(
    scene: str, lines: list[str], checks: list[Check], figures: Any, figure: Figure, picture: Path, log: Path
) -> None:
    from mapless_server.settings import available_cores
    from mapless_tools.charts import write_figure

    from .report import machine_lines, report_part

    write_figure(figure, picture)
    lines = [f"{scene}:", "", *lines, *machine_lines(checks, os.getloadavg()[0], available_cores())]
    report_part(
        picture.with_name(OUTPUT_FILE), log.name.removesuffix("-server.log"), lines, checks, figures, picture, log
    )


@contextmanager
def _measuring() -> Iterator[Progress]:
    """Shows progress bars; a failure ends the command with one line."""
    from mapless_server.serve.signals import terminable
    from mapless_tools.progress import progress_bars
    from mapless_tools.usage import failures_end_command

    with failures_end_command(), terminable(), progress_bars() as progress:
        yield progress


def _finish(checks: list[Check]) -> None:
    raise typer.Exit(1 if any(check.met is False for check in checks) else 0)
