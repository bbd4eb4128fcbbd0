"""The page of a report: an HTML file with its plans and charts in it, which loads nothing and runs no scripts."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from mapless import Reference, Scene
from mapless.cli.report import named_place, percent, reasons
from mapless.geometry import Array
from mapless.rejections import explained
from mapless.scene_reports import PeriodCounts, SceneReport
from mapless_tools.output_files import render
from mapless_tools.plan import basis_from_above, vertical_of

from .drawing import Seen, ageing_svg, outcomes_svg, plan_svg
from .places import (
    ADOPTED_COLOUR,
    FLOOR_GAP_M,
    NONE,
    OUTDATED,
    SHARES,
    SUGGESTED,
    Place,
    floor_of,
    floors_of,
    places_of,
    reason_colour,
)

MOST_ROWS = 300
"""Rows of a table; the plan has all places."""
_MARGIN = 0.08
"""Margin around the plan, share of its extent."""
_REACH = 0.5
"""Things further from all places than this share of their extent are not on the plan: it would become small."""


@dataclass(frozen=True)
class Sign:
    """The meaning of a colour or a shape of the plan."""

    shape: str
    colour: str
    meaning: str


@dataclass(frozen=True)
class Row:
    """A row of the table of places: its number, which the plan's links name, its cells, and whether it is outdated."""

    number: int
    cells: tuple[str, ...]
    is_outdated: bool


def report_page(report: SceneReport, scene: Scene, references: Iterable[Reference], omitted_count: int = 0) -> str:
    """The page of a report.

    Args:
        report: of `get_scene_report`.
        scene: the scene.
        references: those to draw besides the places of the report.
        omitted_count: further references that are not among them.
    """
    places = places_of(report, references)
    counted = sum(it.photograph_count for it in report.periods)
    return render(
        "report.html",
        title=f"Scene {report.scene_id}: what became of its photographs",
        report=report,
        summary=_summary(report, counted),
        outdated=[named_place(it) for it in report.places if it.is_outdated],
        has_rejected=any(it.rejected_count for it in report.periods),
        floors=_floors(report, scene, places),
        signs=_signs(places, bool(report.suggestions)),
        notes=_notes(report, scene, places, omitted_count),
        charts=[outcomes_svg(report.periods), ageing_svg(report.periods)] if counted else [],
        week_head=("first day", "photographs", "localized", "68 % within", "inliers", "surveyed", "rejected"),
        weeks=[_week(it, _unit(report)) for it in report.periods if it.photograph_count],
        place_head=("place of", "photographs", "localized", "rejected", "survey left", "adopted", "retired", "why"),
        rows=_rows(places),
        most_rows=MOST_ROWS,
        events=[
            (f"{it.time:%Y-%m-%d}", it.kind.lower(), it.reference_id, it.message.removeprefix("retired on "))
            for it in report.events
        ][::-1],
    )


def _unit(report: SceneReport) -> str:
    return "units" if report.arbitrary_unit else "m"


def _summary(report: SceneReport, counted: int) -> str:
    days = f"{report.first_day} to {report.last_day} (UTC)"
    if not counted:
        return f"{days}: no photographs counted yet"
    localized = sum(it.localized_count for it in report.periods)
    text = f"{days}: {counted} photographs, {percent(localized / counted)} of them localized"
    known = [it for it in report.periods if it.photograph_count]
    if len(known) > 1:
        first, last = percent(known[0].localized_share), percent(known[-1].localized_share)
        text += f"; {first} in the week from {known[0].first_day}, {last} in that from {known[-1].first_day}"
    return text


def _floors(report: SceneReport, scene: Scene, places: Sequence[Place]) -> list[str]:
    """The plan of each floor as SVG, the lowest first."""
    if not places:
        return []
    poses = [it.world_from_camera for it in places]
    down = vertical_of(scene, poses)[0]
    basis, up = basis_from_above(down), -down / np.linalg.norm(down)
    heights = np.stack([it.translation for it in poses]) @ up
    floors = floors_of(heights, not report.arbitrary_unit)
    of_floor = [floor_of(float(it), floors) for it in heights]
    of_suggestion = [floor_of(float(up @ np.asarray(it.position)), floors) for it in report.suggestions]
    low, high = _shown(report, places, basis)
    return [
        plan_svg(
            Seen(
                _floor_title(i, floors, _unit(report)),
                basis,
                low,
                high,
                {row: place for row, place in enumerate(places) if of_floor[row] == i},
                {n: it for n, it in enumerate(report.suggestions, 1) if of_suggestion[n - 1] == i},
                max(it.rejected_count for it in places),
                _unit(report),
            )
        )
        for i in range(len(floors))
    ]


def _floor_title(index: int, floors: Sequence[tuple[float, float]], unit: str) -> str:
    if len(floors) == 1:
        return "From above"
    low, high = floors[index]
    return f"Floor {index + 1} of {len(floors)}, from above: references at a height of {low:.1f} to {high:.1f} {unit}"


def _shown(report: SceneReport, places: Sequence[Place], basis: Array) -> tuple[Array, Array]:
    """Corners (2,) each of what plans show: all places, and rejections and suggestions within half their extent."""
    centres = np.stack([it.world_from_camera.translation for it in places]) @ basis.T
    low, high = centres.min(axis=0), centres.max(axis=0)
    reach = _REACH * (float((high - low).max()) or 1.0)
    others = [it.rejected_at for it in places if it.rejections]
    others += [np.asarray(it.position, float) for it in report.suggestions]
    flat = np.concatenate([centres, *(np.clip(basis @ it, low - reach, high + reach)[None] for it in others)])
    low, high = flat.min(axis=0), flat.max(axis=0)
    extent = float((high - low).max()) or 1.0
    short = np.maximum(0.0, 0.25 * extent - (high - low)) / 2  # no strip without height
    return low - short - _MARGIN * extent, high + short + _MARGIN * extent


def _signs(places: Sequence[Place], has_suggestions: bool) -> list[Sign]:
    """The legend: colours and shapes that occur."""
    colours = {it.colour for it in places}
    signs = [Sign("place", colour, f"a place: {words}") for _, colour, words in SHARES if colour in colours]
    if NONE in colours:
        signs.append(Sign("place", NONE, "a place of which no photograph came"))
    totals = {reason: sum(it.rejections.get(reason, 0) for it in places) for it in places for reason in it.rejections}
    signs += [
        Sign("ring", reason_colour(reason), f"{totals[reason]} rejected, {explained(reason)}")
        for reason in sorted(totals, key=lambda it: (-totals[it], it))
    ]
    if any(it.has_priors and it.rejections for it in places):
        signs.append(Sign("dotted", "currentColor", "from a place to where its rejected photographs were taken"))
    for shape, colour, words, occurs in (
        ("plus", ADOPTED_COLOUR, "adopted references are in use there", any(it.adopted_count for it in places)),
        ("cross", "currentColor", "retired references", any(it.retired_count for it in places)),
        ("square", OUTDATED, "outdated: needs a new survey", any(it.is_outdated for it in places)),
        (
            "number",
            SUGGESTED,
            "a suggestion: its arrow ends where to take a reference, and points ahead",
            has_suggestions,
        ),
    ):
        if occurs:
            signs.append(Sign(shape, colour, words))
    return signs


def _notes(report: SceneReport, scene: Scene, places: Sequence[Place], omitted_count: int) -> list[str]:
    """How to read the plan."""
    notes = [
        "The nose of a place points where its reference looks; without one it looks up or down. A place is what is "
        "nearer to its reference than to any other that looks within 60 degrees of the same direction, or to any other "
        "where none does."
    ]
    if places:
        view = vertical_of(scene, [it.world_from_camera for it in places])[1]
        notes.append(f"Seen {view}. References with {FLOOR_GAP_M} m or more of height between them are on two floors.")
    most = max((it.rejected_count for it in places), default=0)
    if most:
        notes.append(
            f"The area of a ring grows with the number of rejected photographs; the largest has {most}. It is where "
            "their priors place them on average, if half of them or more had one, else around the reference that "
            "resembles them most. What is further from all places than half of their extent is not on the plan."
        )
    unplaced = sum(it.rejected_count for place in report.places if not place.reference_id for it in place.periods)
    if unplaced:
        notes.append(f"{unplaced} rejected photographs are not on the plan: their place is not known.")
    if report.omitted_place_count:
        notes.append(f"{report.omitted_place_count} further places with photographs are left out.")
    if omitted_count:
        notes.append(f"{omitted_count} further references are not drawn.")
    if report.arbitrary_unit:
        notes.append("Lengths are in the scene's own, arbitrary unit; floors are not separated.")
    return notes


def _week(it: PeriodCounts, unit: str) -> tuple[str, ...]:
    radius = ""
    if it.position_68_m is not None:
        radius = f"{100 * it.position_68_m:.1f} cm" if unit == "m" else f"{it.position_68_m:.3g} {unit}"
    return (
        f"{it.first_day}",
        f"{it.photograph_count}",
        percent(it.localized_share),
        radius,
        "" if it.inlier_count is None else f"{it.inlier_count:.0f}",
        percent(it.surveyed_share),
        _why(it.rejections),
    )


def _why(rejections: Mapping[str, int]) -> str:
    return reasons(rejections, len(rejections))


def _rows(places: Sequence[Place]) -> list[Row]:
    """Places with photographs or with something to know, in the plan's order."""
    rows = []
    for number, it in enumerate(places):
        if it.photograph_count or it.is_outdated or it.retired_count or it.adopted_count:
            share = percent(it.localized_count / it.photograph_count) if it.photograph_count else ""
            cells = (
                it.reference_id,
                f"{it.photograph_count}",
                share,
                f"{it.rejected_count}",
                percent(it.surveyed_left),
                f"{it.adopted_count or ''}",
                f"{it.retired_count or ''}",
                _why(it.rejections),
            )
            rows.append(Row(number, cells, it.is_outdated))
    return rows
