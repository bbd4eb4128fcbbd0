"""Charts of a report: the plan of each floor, photographs by week and outcome, and how the scene ages."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from html import escape
from textwrap import fill

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from matplotlib.transforms import ScaledTranslation

from mapless.geometry import Array
from mapless.rejections import explained
from mapless.scene_reports import PeriodCounts, ReferenceSuggestion
from mapless_tools.charts import COLOURS, INK, figure_of, inline_svg, new_axes, plot
from mapless_tools.plan import axis_label, heading_of

from .places import ADOPTED_COLOUR, OUTDATED, SUGGESTED, Place, reason_colour

PIN_IN, RING_IN = 0.055, (0.085, 0.26)
"""Radii on the page, inches: of a reference, and of the rings of one rejected photograph and of the most."""
_DENSE, _LEAST_PIN = 150, 0.45
"""References from which pins become smaller, and the smallest of them."""
_WIDTH_IN = 10.0
_HEIGHTS_IN = (3.0, 11.0)
_ARROWS_PT, _NUMBER_PT = (26, 36, 46, 56, 66), 9
"""Distances on the page from a suggestion's number to its position, points: the first at which the number, of this
radius, covers no ring."""
_MOST_DAYS = 10
"""Days that are named at an axis."""
_LEGEND = 36
"""Characters of a line of a legend, two columns of which are as wide as a chart."""
LOCALIZED = COLOURS[0]


@dataclass(frozen=True, eq=False)
class Seen:
    """A floor as seen from above.

    Attributes:
        title: of its plan.
        basis: (2, 3) world directions to the right and up on the page.
        low, high: (2,) corners of what the plan shows, the same for all floors.
        places: those of this floor, each with the index of its row in tables.
        suggestions: those of this floor, by their numbers.
        most_rejected: rejected photographs of the place with most of them, on any floor.
        unit: of length.
    """

    title: str
    basis: Array
    low: Array
    high: Array
    places: Mapping[int, Place]
    suggestions: Mapping[int, ReferenceSuggestion]
    most_rejected: int
    unit: str


def plan_svg(seen: Seen) -> str:
    """The plan of a floor as SVG; places are links to their rows, with what became of their photographs as titles."""
    axes = plan_axes(seen)
    figure = axes.figure
    assert isinstance(figure, Figure)
    titles = {f"#place-{row}": tooltip(it) for row, it in seen.places.items()}

    def titled(link: re.Match[str]) -> str:
        return f"{link[0]}<title>{escape(titles[link[1]])}</title>"

    return re.sub(r'<a xlink:href="(#place-\d+)"[^>]*>', titled, inline_svg(figure))


def tooltip(place: Place) -> str:
    """The outcomes of a place's photographs, one line."""
    if not place.photograph_count:
        return f"{place.reference_id}: no photographs"
    why = ", ".join(f"{reason} {count}" for reason, count in place.rejections.items())
    text = f"{place.reference_id}: {place.localized_count} of {place.photograph_count} photographs localized"
    return f"{text}; rejected: {why}" if why else text


def plan_axes(seen: Seen) -> Axes:
    """The axes of a floor's plan."""
    axes = new_axes(seen.title, axis_label(seen.basis[0], seen.unit), axis_label(seen.basis[1], seen.unit))
    width, height = seen.high - seen.low
    tall = float(np.clip(_WIDTH_IN * height / width, *_HEIGHTS_IN))
    figure = axes.figure
    assert isinstance(figure, Figure)
    figure.set_size_inches(_WIDTH_IN, tall)
    axes.set(xlim=(seen.low[0], seen.high[0]), ylim=(seen.low[1], seen.high[1]))
    axes.set_aspect("equal", adjustable="box")
    axes.ticklabel_format(useOffset=False, style="plain")
    axes.set_axisbelow(True)
    scale = max(_LEAST_PIN, min(1.0, math.sqrt(_DENSE / max(1, len(seen.places)))))
    if seen.places:
        _draw_leads(axes, seen)
        _draw_rings(axes, seen, scale)
        _draw_pins(axes, seen, scale)
        _draw_marks(axes, seen, scale)
    axes.apply_aspect()  # so that distances on the page are known
    for number, it in seen.suggestions.items():
        _draw_suggestion(axes, seen, number, it, scale)
    return axes


def _draw_pins(axes: Axes, seen: Seen, scale: float) -> None:
    """References with their viewing directions, those with photographs above the others."""
    order = sorted(seen.places, key=lambda row: seen.places[row].photograph_count > 0)
    pins = [_pin(seen.basis, seen.places[row], scale * PIN_IN) for row in order]
    centres = np.stack([seen.basis @ seen.places[row].world_from_camera.translation for row in order])
    drawn = _in_inches(axes, pins, centres, [seen.places[row].colour for row in order])
    drawn.set(urls=[f"#place-{row}" for row in order], label="_places", zorder=4)


def _pin(basis: Array, place: Place, radius: float) -> Array:
    """Outline (N, 2) of a disk with a nose in the viewing direction; without one if it looks up or down."""
    ahead = heading_of(basis, place.world_from_camera.rotation[:, 2])
    if ahead is None:
        return radius * _arc(0.0, 2 * math.pi, 12)
    turn = math.atan2(ahead[1], ahead[0])
    around = radius * _arc(turn + 0.6, turn + 2 * math.pi - 0.6, 10)
    return np.concatenate([around, 2.6 * radius * ahead[None]])


def _draw_rings(axes: Axes, seen: Seen, scale: float) -> None:
    """Rings of rejected photographs, divided by reason; their areas are in proportion to the numbers."""
    outlines, centres, colours, links = [], [], [], []
    for row, it in seen.places.items():
        radius = ring_radius(it.rejected_count, seen.most_rejected)
        turn = math.pi / 2
        for reason, count in it.rejections.items():
            after = turn - 2 * math.pi * count / it.rejected_count
            inner, outer = scale * RING_IN[0] * 0.8, scale * radius
            steps = max(2, round(24 * count / it.rejected_count))
            outlines.append(np.concatenate([outer * _arc(turn, after, steps), inner * _arc(after, turn, steps)]))
            centres.append(seen.basis @ it.rejected_at)
            colours.append(reason_colour(reason))
            links.append(f"#place-{row}")
            turn = after
    if outlines:
        drawn = _in_inches(axes, outlines, np.stack(centres), colours)
        drawn.set(urls=links, label="_rejections", zorder=3, alpha=0.85)


def ring_radius(count: int, most: int) -> float:
    """Radius of the ring of so many photographs, inches: its disk's area beyond the least is in proportion."""
    least, largest = RING_IN
    return math.sqrt(least**2 + (largest**2 - least**2) * count / max(most, 5))


def _draw_leads(axes: Axes, seen: Seen) -> None:
    """Lines from references to where the rejected photographs of their places were taken."""
    ends = [
        np.stack([it.world_from_camera.translation, it.rejected_at]) @ seen.basis.T
        for it in seen.places.values()
        if it.has_priors and it.rejections
    ]
    axes.add_collection(LineCollection(ends, colors=INK, linestyles="dotted", linewidths=0.9, alpha=0.7))


def _draw_marks(axes: Axes, seen: Seen, scale: float) -> None:
    """Marks beside places: a plus for adopted references, a cross for retired ones, a frame around outdated places."""
    for side, marker, colour, label, at in (
        (1, "P", ADOPTED_COLOUR, "_adopted", [it for it in seen.places.values() if it.adopted_count]),
        (-1, "X", INK, "_retired", [it for it in seen.places.values() if it.retired_count]),
        (0, "s", OUTDATED, "_outdated", [it for it in seen.places.values() if it.is_outdated]),
    ):
        if not at:
            continue
        flat = np.stack([it.world_from_camera.translation for it in at]) @ seen.basis.T
        (marks,) = axes.plot(*flat.T, linestyle="none", marker=marker, label=label, zorder=5)
        marks.set(color=colour, markersize=7 * scale, markeredgewidth=0)
        if side:
            figure = axes.figure
            assert isinstance(figure, Figure)
            beside = ScaledTranslation(0.11 * side * scale, 0.11 * scale, figure.dpi_scale_trans)
            marks.set_transform(axes.transData + beside)
        else:
            marks.set(markersize=26 * scale, markerfacecolor="none", markeredgecolor=colour, markeredgewidth=2)


def _behind(axes: Axes, seen: Seen, at: Array, ahead: Array, scale: float) -> Array:
    """Offset (2,) of a suggestion's number from its position (2,), points: behind it, where it covers no ring."""
    point = axes.transData.transform(at)
    figure = axes.figure
    assert isinstance(figure, Figure)
    of_points = figure.dpi / 72
    rings = [
        ((axes.transData.transform(seen.basis @ it.rejected_at) - point) / of_points, radius)
        for it in seen.places.values()
        if it.rejections
        for radius in (72 * scale * ring_radius(it.rejected_count, seen.most_rejected),)
    ]
    offsets = [-length * ahead for length in _ARROWS_PT]
    clear = (each for each in offsets if all(np.linalg.norm(each - at) >= r + _NUMBER_PT for at, r in rings))
    return next(clear, offsets[0])


def _draw_suggestion(axes: Axes, seen: Seen, number: int, it: ReferenceSuggestion, scale: float) -> None:
    """The number of a suggestion behind its position, with an arrow to there that points the way to look."""
    at, ahead = seen.basis @ np.asarray(it.position, float), heading_of(seen.basis, it.forward)
    disk = {"boxstyle": "circle,pad=0.25", "facecolor": SUGGESTED, "edgecolor": "white", "linewidth": 0.8}
    text = axes.annotate(
        str(number),
        (float(at[0]), float(at[1])),
        xytext=(0, 0) if ahead is None else tuple(_behind(axes, seen, at, ahead, scale).tolist()),
        textcoords="offset points",
        arrowprops=None if ahead is None else {"arrowstyle": "-|>", "color": INK, "linewidth": 2.2, "shrinkB": 0},
        annotation_clip=False,
    )
    text.set(ha="center", va="center", color="white", fontsize=9, fontweight="bold", bbox=disk, zorder=7)


def _in_inches(axes: Axes, outlines: Sequence[Array], centres: Array, colours: Sequence[str]) -> PolyCollection:
    """Adds polygons (N, 2), inches on the page, around centres (M, 2) of the plan."""
    drawn = PolyCollection(outlines, offsets=centres, offset_transform=axes.transData, facecolors=colours)
    figure = axes.figure
    assert isinstance(figure, Figure)
    drawn.set_transform(figure.dpi_scale_trans)
    drawn.set(linewidth=0)
    axes.add_collection(drawn, autolim=False)
    return drawn


def _arc(first: float, last: float, steps: int) -> Array:
    """Points (steps + 1, 2) of the unit circle between two angles, radians."""
    turns = np.linspace(first, last, steps + 1)
    return np.stack([np.cos(turns), np.sin(turns)], axis=1)


def outcomes_svg(periods: Sequence[PeriodCounts]) -> str:
    """Photographs of each period, stacked by outcome, as SVG."""
    return inline_svg(outcomes_figure(periods))


def outcomes_figure(periods: Sequence[PeriodCounts]) -> Figure:
    """The chart of `outcomes_svg`."""
    axes = new_axes("Photographs by outcome", "first day", "photographs")
    at, base = np.arange(len(periods)), np.array([it.localized_count for it in periods], float)
    axes.bar(at, base, 0.8, color=LOCALIZED, label="localized")
    totals: dict[str, int] = {}
    for period in periods:
        for reason, count in period.rejections.items():
            totals[reason] = totals.get(reason, 0) + count
    for reason in sorted(totals, key=lambda it: (-totals[it], it)):
        counts = np.array([it.rejections.get(reason, 0) for it in periods], float)
        axes.bar(at, counts, 0.8, base, color=reason_colour(reason), label=fill(explained(reason), _LEGEND))
        base = base + counts
    axes.set_ylim(0, max(1.0, 1.05 * float(base.max())))
    _name_days(axes, periods)
    return figure_of(axes)


def ageing_svg(periods: Sequence[PeriodCounts]) -> str:
    """Shares of localized photographs and of the survey in their matches, by period, as SVG."""
    axes = new_axes("How the scene ages", "first day", "%")
    at = range(len(periods))
    plot(axes, "photographs that were localized", at, [_percent(it.localized_share) for it in periods], "o")
    plot(
        axes,
        "surveyed: matches that surveyed references have",
        at,
        [_percent(it.surveyed_share) for it in periods],
        "s",
    )
    axes.set_ylim(0, 105)
    _name_days(axes, periods)
    return inline_svg(figure_of(axes))


def _percent(share: float | None) -> float:
    return math.nan if share is None else 100 * share


def _name_days(axes: Axes, periods: Sequence[PeriodCounts]) -> None:
    """Names the first day of each period at the x axis, of many periods of some."""
    step = -(-len(periods) // _MOST_DAYS)
    named = range((len(periods) - 1) % step, len(periods), step)  # the last one among them
    axes.set_xticks(list(named), [f"{periods[i].first_day}" for i in named], rotation=0 if len(named) < 6 else 45)
    axes.set_xlim(-0.6, len(periods) - 0.4)
    axes.yaxis.set_major_locator(MaxNLocator(integer=True))
