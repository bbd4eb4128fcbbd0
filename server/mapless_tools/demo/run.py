"""The demo: starts a server, adds references, localizes photographs it has never seen, judges and draws the answers."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

from mapless import Camera, Client, LocalizationResult, NewReference, Rejected, RigidTransform
from mapless.geometry import Array, rotation_angle_deg
from mapless_tools.child import child_server
from mapless_tools.dataset import Frame, read_folder

from . import picture, room
from .sparse import Shot, points_to_draw

SCENE = "demo"
SEED = 0
MAX_FRAMES = 60
"""Of a longer real sequence so many frames are used, evenly spread: enough to judge, and a minute to run."""
QUERY_EVERY = 3
DRAWN_PX = 960
"""Longer side of the photographs that are drawn."""
DRAWN_REFERENCES = 3
"""What is drawn is what these, the most agreeing ones, see: more would be hidden things that shine through."""
MAX_MEDIAN_ERROR_M = 0.03
MAX_MEDIAN_ERROR_DEG = 1.0
"""What the rendered room must reach for the demo to succeed."""


@dataclass(frozen=True, eq=False)
class Photograph:
    """A photograph with its true pose, as it goes over the wire."""

    name: str
    data: bytes
    camera: Camera
    world_from_camera: RigidTransform


@dataclass(frozen=True)
class Place:
    """What the demo runs on.

    Attributes:
        title: for the person who watches.
        references, queries: apart from one another.
        metric: whether lengths are metres.
        seed: of the rendered room; None for real photographs.
    """

    title: str
    references: Sequence[Photograph]
    queries: Sequence[Photograph]
    metric: bool
    seed: int | None = None


@dataclass(frozen=True, eq=False)
class Outcome:
    """One query's answer and its errors; infinite if it was rejected. Metres, or the scene's unit; degrees."""

    query: Photograph
    answer: LocalizationResult | Rejected
    translation_error: float
    rotation_error_deg: float


def run_demo(data: Path | None, output: Path, console: Console | None = None) -> bool:
    """Run the whole demo.

    Args:
        data: a folder with `images/` and `cameras.json`; None for the rendered room.
        output: folder for the pictures; made if needed.
        console: where to write; None for the standard output.

    Returns:
        whether it went well: the rendered room's queries are all localized with small median errors; of a real folder's
        more than half are localized.

    Raises:
        ValueError: the folder is malformed.
        ServerFailed: the server did not start.
        MaplessError: a call failed.
    """
    console = console or Console()
    with console.status("preparing photographs"):
        place = rendered_place(SEED) if data is None else real_place(data)
    console.print(f"[bold]{place.title}[/]: {len(place.references)} references, {len(place.queries)} queries")
    if not place.metric:
        console.print("This folder is not metric: errors are in hundredths of its own unit of length, not in cm.")

    with (
        tempfile.TemporaryDirectory(prefix="mapless-demo-") as data_dir,
        child_server(Path(data_dir)) as server,
        Client(server.address) as client,
    ):
        console.print(f"server: own process at {server.address}")
        client.create_scene(SCENE)
        with console.status("adding references"):
            client.add_references(
                SCENE, [NewReference(p.name, p.data, p.camera, p.world_from_camera) for p in place.references]
            )
        outcomes = []
        for query in place.queries:
            with console.status(f"localizing {query.name}"):
                outcomes.append(judge(query, client.localize(query.data, query.camera, SCENE)))
    console.print("server: stopped")

    console.print(table_of(outcomes, place.metric))
    good = summarize(console, place, outcomes)
    with console.status("drawing"):
        paths = write_pictures(place, outcomes, output)
    console.print(f"pictures: {paths[0]} and {len(paths) - 1} beside it")
    return good


def rendered_place(seed: int) -> Place:
    """The room that the project renders itself."""
    references, queries = (
        [Photograph(photo.name, room.jpeg(photo.image), photo.camera, photo.world_from_camera) for photo in photos]
        for photos in room.render_room(seed)
    )
    return Place("a room rendered from nothing but code", references, queries, metric=True, seed=seed)


def real_place(path: Path) -> Place:
    """A folder of real photographs: every third frame is a query, the others are references."""
    dataset = read_folder(path)
    chosen = np.unique(
        np.linspace(0, len(dataset.frames) - 1, min(len(dataset.frames), MAX_FRAMES)).round().astype(int)
    )
    frames = [dataset.frames[i] for i in chosen]
    is_query = [i % QUERY_EVERY == QUERY_EVERY // 2 for i in range(len(frames))]
    title = f"{dataset.name}, every {QUERY_EVERY}rd frame a query"
    if len(frames) < len(dataset.frames):
        title += f", {len(frames)} of {len(dataset.frames)} frames used"
    references = [_read(frame) for frame, query in zip(frames, is_query, strict=True) if not query]
    queries = [_read(frame) for frame, query in zip(frames, is_query, strict=True) if query]
    return Place(title, references, queries, dataset.metric)


def judge(query: Photograph, answer: LocalizationResult | Rejected) -> Outcome:
    """An answer against the truth."""
    if isinstance(answer, Rejected):
        return Outcome(query, answer, math.inf, math.inf)
    error = query.world_from_camera.inverse().compose(answer.world_from_camera)
    return Outcome(query, answer, float(np.linalg.norm(error.translation)), rotation_angle_deg(error.rotation))


def table_of(outcomes: Sequence[Outcome], metric: bool) -> Table:
    """One row a query; the radius is the server's own, not exceeded in 68 % of cases."""
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
    """Print the medians and the verdict; whether the demo went well."""
    localized = [outcome for outcome in outcomes if isinstance(outcome.answer, LocalizationResult)]
    translation = float(np.median([outcome.translation_error for outcome in outcomes]))
    rotation_deg = float(np.median([outcome.rotation_error_deg for outcome in outcomes]))
    unit = "cm" if place.metric else "hundredths of a unit"
    console.print(
        f"{len(localized)} of {len(outcomes)} localized; median error over all "
        f"[bold]{100 * translation:.2f} {unit}, {rotation_deg:.3f} deg[/]"
    )
    if place.seed is None:
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
    """One picture a query, and first a sheet of all."""
    output.mkdir(parents=True, exist_ok=True)
    shots = {photo.name: _shot(photo) for photo in place.references}
    pictures = [_picture(place, outcome, shots) for outcome in outcomes]
    paths = [output / "all.png", *(output / f"{outcome.query.name}.png" for outcome in outcomes)]
    for path, image in zip(paths, [picture.contact_sheet(pictures), *pictures], strict=True):
        path.write_bytes(picture.png(image))
    return paths


def _picture(place: Place, outcome: Outcome, shots: dict[str, Shot]) -> NDArray[np.uint8]:
    answer, query = outcome.answer, _shot(outcome.query)
    uses = sorted(answer.diagnostics.references, key=lambda use: (-use.inlier_count, -use.match_count))
    used = [shots[use.name.rsplit("/", 1)[-1]] for use in uses] or list(shots.values())
    found = answer.world_from_camera if isinstance(answer, LocalizationResult) else None
    outline: Array = np.zeros((0, 2, 3))
    visible: Array = outline
    if place.seed is not None:
        outline = room.room_outline(place.seed)
        if found is not None:
            visible = room.visible_outline(place.seed, query.camera, found)
    scenery = picture.Scenery(points_to_draw(used[:DRAWN_REFERENCES]), outline, visible)
    return picture.draw(query, found, used[0], list(shots.values()), scenery, _caption(outcome, place.metric))


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


def _read(frame: Frame) -> Photograph:
    return Photograph(frame.name, frame.image_path.read_bytes(), frame.camera, frame.world_from_camera)


def _shot(photo: Photograph) -> Shot:
    """Decoded for drawing, not larger than needed; like the server, blind to EXIF orientation."""
    flags = cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION
    bgr = cv2.imdecode(np.frombuffer(photo.data, np.uint8), flags)
    if bgr is None:
        raise ValueError(f"{photo.name} is not an image that can be read")
    scale = min(1.0, DRAWN_PX / max(bgr.shape[:2]))
    size = (round(bgr.shape[1] * scale), round(bgr.shape[0] * scale))
    image = np.ascontiguousarray(cv2.resize(bgr, size, interpolation=cv2.INTER_AREA)[..., ::-1])
    return Shot(photo.name, image.astype(np.uint8), photo.camera.resized(*size), photo.world_from_camera)
