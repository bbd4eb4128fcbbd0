"""The demo: starts a server, adds references, localizes photographs it has not seen, judges and draws the answers."""

import math
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from mapless import Client, ConnectOptions, LocalizationResult, Rejected
from mapless_tools.child import ATTEMPTS, child_server
from mapless_tools.evaluate.metrics import pose_error
from mapless_tools.matches import Picture

from . import picture
from .photographs import Photograph, Place, place_of

SCENE = "demo"
DRAWN_PX = 960
"""Longer side of the photographs that are drawn."""
MAX_MEDIAN_ERROR_M = 0.03
MAX_MEDIAN_ERROR_DEG = 1.0
"""Largest median error in the rendered room for the demo to succeed."""


@dataclass(frozen=True, eq=False)
class Outcome:
    """One query's answer and its errors; infinite if it was rejected. Metres, or the scene's unit; degrees."""

    query: Photograph
    answer: LocalizationResult | Rejected
    translation_error: float
    rotation_error_deg: float


def run_demo(data: Path | None, output: Path, console: Console | None = None) -> bool:
    """Runs the whole demo, on the rendered room or on a folder with `images/` and `cameras.json`.

    Returns whether it succeeded: all queries of the rendered room are localized with small median errors, or more than
    half of those of a real folder are localized. ValueError if the folder is malformed.
    """
    console = console or Console()
    place = place_of(data)
    console.print(f"[bold]{place.title}[/]: {len(place.references)} references, {len(place.queries)} queries")
    if not place.metric:
        console.print("This folder is not metric: errors are in hundredths of its own unit of length, not in cm.")

    with (
        tempfile.TemporaryDirectory(prefix="mapless-demo-") as data_dir,
        child_server(Path(data_dir)) as server,
        Client(server.address, ConnectOptions(max_attempts=ATTEMPTS)) as client,
    ):
        console.print(f"server: own process at {server.address}")
        client.create_scene(SCENE)
        with console.status("adding references"):
            client.add_references(SCENE, [it.reference() for it in place.references])
        outcomes = []
        for query in place.queries:
            with console.status(f"localizing {query.name}"):
                answer = client.localize(query.data, query.camera, SCENE, include_debug=True)
                outcomes.append(judge(query, answer))
    console.print("server: stopped")

    console.print(table_of(outcomes, place.metric))
    good = summarize(console, place, outcomes)
    with console.status("drawing"):
        paths = write_pictures(place, outcomes, output)
    console.print(f"pictures: {paths[0]} and {len(paths) - 1} beside it")
    return good


def judge(query: Photograph, answer: LocalizationResult | Rejected) -> Outcome:
    """Compares an answer with the truth."""
    if isinstance(answer, Rejected):
        return Outcome(query, answer, math.inf, math.inf)
    return Outcome(query, answer, *pose_error(query.world_from_camera, answer.world_from_camera))


def table_of(outcomes: Sequence[Outcome], metric: bool) -> Table:
    """A table with one row for each query; the radius is the server's own, not exceeded in 68 % of cases."""
    unit = "cm" if metric else "/100"
    headings = ("query", "outcome", f"{unit} off", "deg off", f"radius {unit}", "inliers", "refs", "s")
    table = Table(*headings, box=SIMPLE_HEAD, padding=(0, 1, 0, 0))  # within the 80 columns of a plain terminal
    table.columns[0].overflow = "ellipsis"
    for column in table.columns[1:]:  # where room is short, names give way
        column.no_wrap = True
    for column in table.columns[2:]:
        column.justify = "right"
    for outcome in outcomes:
        answer = outcome.answer
        uses = answer.diagnostics.references
        end = [str(sum(use.inlier_count > 0 for use in uses)), f"{answer.diagnostics.total_s:.2f}"]
        if isinstance(answer, Rejected):
            table.add_row(outcome.query.name, f"[red]{answer.reason}[/]", "", "", "", "", *end)
            continue
        radius = f"{100 * answer.accuracy.position_68_m:.2f}" if answer.accuracy else ""
        errors = [f"{100 * outcome.translation_error:.2f}", f"{outcome.rotation_error_deg:.3f}", radius]
        table.add_row(
            outcome.query.name, "[green]localized[/]", *errors, f"{answer.inlier_count}/{answer.match_count}", *end
        )
    return table


def summarize(console: Console, place: Place, outcomes: Sequence[Outcome]) -> bool:
    """Prints the medians and the verdict; returns whether the demo succeeded."""
    localized = [outcome for outcome in outcomes if isinstance(outcome.answer, LocalizationResult)]
    translation = float(np.median([outcome.translation_error for outcome in outcomes]))
    rotation_deg = float(np.median([outcome.rotation_error_deg for outcome in outcomes]))
    unit = "cm" if place.metric else "hundredths of a unit"
    console.print(
        f"{len(localized)} of {len(outcomes)} localized; median error over all "
        f"[bold]{100 * translation:.2f} {unit}, {rotation_deg:.3f} deg[/]"
    )
    if place.outline is None:
        good = 2 * len(localized) > len(outcomes)
        if not good:
            console.print("[red]expected: more than half localized[/]")
        return good
    good = len(localized) == len(outcomes)
    good &= translation <= MAX_MEDIAN_ERROR_M and rotation_deg <= MAX_MEDIAN_ERROR_DEG
    if not good:
        limits = f"{100 * MAX_MEDIAN_ERROR_M:g} cm and {MAX_MEDIAN_ERROR_DEG:g} deg"
        console.print(f"[red]expected: all localized, median errors at most {limits}[/]")
    return good


def write_pictures(place: Place, outcomes: Sequence[Outcome], output: Path) -> list[Path]:
    """Writes one picture for each query, and first a sheet of all."""
    output.mkdir(parents=True, exist_ok=True)
    posed = {photo.name: picture.Posed.of(photo, DRAWN_PX) for photo in place.references}
    pictures = [_picture(place, outcome, posed) for outcome in outcomes]
    paths = [output / "all.png", *(output / f"{outcome.query.name}.png" for outcome in outcomes)]
    for path, image in zip(paths, [picture.contact_sheet(pictures), *pictures], strict=True):
        path.write_bytes(picture.png(image))
    return paths


def _picture(place: Place, outcome: Outcome, posed: Mapping[str, picture.Posed]) -> Picture:
    answer, references = outcome.answer, outcome.answer.diagnostics.references
    best = max(range(len(references)), key=lambda i: references[i].inlier_count, default=None)
    nearest = next(iter(posed.values())) if best is None else posed[references[best].name.rpartition("/")[2]]
    query = picture.Posed.of(outcome.query, DRAWN_PX)
    found = None
    if isinstance(answer, LocalizationResult):
        found = answer.world_from_camera
        if debug := answer.debug:
            pixels = query.shot.pixels_of(debug.query_px[debug.is_inlier], outcome.query.camera)
            query = replace(query, points=debug.x_in_world[debug.is_inlier], keypoints=pixels)
            shown = debug.is_inlier & (debug.reference == best)
            camera = next(it.camera for it in place.references if it.name == nearest.name)
            pixels = nearest.shot.pixels_of(debug.reference_px[shown], camera)
            nearest = replace(nearest, points=debug.x_in_world[shown], keypoints=pixels)
    return picture.draw(query, found, nearest, [*posed.values()], place.outline, _caption(outcome, place.metric))


def _caption(outcome: Outcome, metric: bool) -> list[str]:
    answer = outcome.answer
    time = f"{answer.diagnostics.total_s:.2f} s in the server"
    if isinstance(answer, Rejected):
        return [f"rejected: {answer.reason}", answer.message, time]
    unit = "cm" if metric else "hundredths of a unit"
    heading = f"off by {100 * outcome.translation_error:.2f} {unit} and {outcome.rotation_error_deg:.3f} deg"
    lines = [heading, f"{answer.inlier_count} of {answer.match_count} matches agree with the pose; {time}"]
    if answer.accuracy is not None:
        accuracy = answer.accuracy
        lines.append(
            f"the server's own estimate: {100 * accuracy.position_68_m:.2f} {unit} (68 %), "
            f"{100 * accuracy.position_95_m:.2f} {unit} (95 %)"
        )
    return lines
