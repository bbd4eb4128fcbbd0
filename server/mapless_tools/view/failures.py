"""The layer of what fails: places by the share of photographs that were localized, rejections, and suggestions."""

import threading
from collections.abc import Callable, Sequence
from html import escape
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mapless import MaplessError
from mapless.geometry import Array
from mapless.rejections import explained
from mapless.scene_reports import SceneReport
from mapless_tools.report.places import SHARES, Place, places_of, reason_colour

from .drawing import Drawing, rgb
from .guarded import GuardedViser
from .scenery import Scenery

WEEKS = {"1 week": 1, "4 weeks": 4, "12 weeks": 12, "52 weeks": 52}
_FIRST = "4 weeks"
NOTHING_COUNTED = "No photographs counted yet."
MOST_POINTS = 40
"""Points of the rejected photographs of a place; more are not distinguishable."""
_PLACE, _POINT, _ARROW = 0.5, 0.22, 2.0
"""Sizes of places, of points and of arrows, relative to the references'."""
_GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


class Failures:
    """The layer, with its folder in the panel; it is empty until the box is checked."""

    def __init__(
        self, server: GuardedViser, drawing: Drawing, scenery: Scenery, read: Callable[[int], SceneReport]
    ) -> None:
        """The report of so many weeks is `read` when the box is checked, other weeks are chosen, or on demand."""
        self._drawing, self._scenery, self._read = drawing, scenery, read
        self._lock = threading.Lock()
        self._drawn: list[Any] = []
        self._was_read = False
        gui = server.gui
        with gui.add_folder("What fails", order=1.5):
            self.show = gui.add_checkbox("Show what fails", False)
            self.weeks = gui.add_dropdown("Of the last", tuple(WEEKS), initial_value=_FIRST)
            refresh = gui.add_button("Refresh")
            self.legend = gui.add_html("")
        self.show.on_update(lambda _: self.update(again=False))
        self.weeks.on_update(lambda _: self.update())
        refresh.on_click(lambda _: self.update())

    def update(self, again: bool = True) -> None:
        """Draws the report if the box is checked, read `again` or if it was not yet; else hides it."""
        with self._lock:
            visible = bool(self.show.value)
            self._was_read = self._was_read and not again
            if visible and not self._was_read:
                try:
                    self._draw(self._read(WEEKS[self.weeks.value]))
                    self._was_read = True
                except MaplessError as error:
                    self.legend.content = f"<p>{escape(str(error))}</p>"
            for it in (*self._drawn, self.legend):
                it.visible = visible

    def _draw(self, report: SceneReport) -> None:
        for it in self._drawn:
            it.remove()
        self._drawn = []
        self.legend.content = legend(report)
        size_m, places = self._scenery.size_m, places_of(report, [])
        if places:
            centres = np.stack([it.world_from_camera.translation for it in places]) - self._scenery.origin
            colours = np.array([rgb(it.colour) for it in places], np.uint8)
            self._drawn.append(
                self._drawing.points("/what-fails/places", centres, colours, _PLACE * size_m, visible=True)
            )
        points, colours = rejection_points(places, size_m)
        if len(points):
            placed = points - self._scenery.origin
            self._drawn.append(
                self._drawing.points("/what-fails/rejections", placed, colours, _POINT * size_m, visible=True)
            )
        for number, it in enumerate(report.suggestions, 1):
            name, at = f"/what-fails/suggestion-{number}", np.asarray(it.position, float)
            self._drawn += self._drawing.arrow(name, f"{number}", at, np.asarray(it.forward, float), _ARROW)


def rejection_points(places: Sequence[Place], size_m: float) -> tuple[Array, NDArray[np.uint8]]:
    """Points (N, 3), world, and their colours (N, 3): one for each rejected photograph, at most 40 of a place.

    They are around where the photographs of a place were rejected, those of one reason beside one another.
    """
    points, colours = [np.empty((0, 3))], [np.empty((0, 3), np.uint8)]
    for it in places:
        count = min(it.rejected_count, MOST_POINTS)
        if not count:
            continue
        reasons = [rgb(reason_colour(reason)) for reason, many in it.rejections.items() for _ in range(many)]
        chosen = np.linspace(0, len(reasons) - 1, count).round().astype(int)
        steps = np.arange(count) + 0.5
        z = 1 - 2 * steps / count
        flat, turn = np.sqrt(1 - z**2), _GOLDEN_ANGLE * steps
        around = np.stack([flat * np.cos(turn), flat * np.sin(turn), z], axis=1)
        points.append(it.rejected_at + size_m * (0.4 + 0.06 * np.sqrt(count)) * around)
        colours.append(np.array(reasons, np.uint8)[chosen])
    return np.concatenate(points), np.concatenate(colours)


def legend(report: SceneReport) -> str:
    """The content of the layer as HTML; the sentences of suggestions by their numbers."""
    counted = sum(it.photograph_count for it in report.periods)
    if not counted:
        return f"<p>{NOTHING_COUNTED}</p>"
    localized = sum(it.localized_count for it in report.periods)
    lines = [f"{localized} of {counted} photographs localized, {report.first_day} to {report.last_day} (UTC)."]
    lines += [_coloured("&#9679;", colour, f"places: {words}") for _, colour, words in SHARES]
    totals: dict[str, int] = {}
    for period in report.periods:
        for reason, count in period.rejections.items():
            totals[reason] = totals.get(reason, 0) + count
    for reason in sorted(totals, key=lambda it: (-totals[it], it)):
        lines.append(_coloured("&#8226;", reason_colour(reason), f"{totals[reason]} rejected, {explained(reason)}"))
    lines += [f"{number}. {escape(it.message)}" for number, it in enumerate(report.suggestions, 1)]
    return f'<div style="font-size: 0.85em; padding: 0 0.6em">{"<br>".join(lines)}</div>'


def _coloured(sign: str, colour: str, text: str) -> str:
    return f'<span style="color: {colour}">{sign}</span> {escape(text)}'
