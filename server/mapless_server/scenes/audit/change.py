"""What of an image does not show what the neighbours show there: things that moved, or a photograph of elsewhere.

Every known point that should be seen is looked for near its projection. In an unchanged image a good share of them is
found everywhere; where hardly any is found in a large connected region, the region shows something else. Something that
stands in front looks the same, so only a large region is called a change.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr

from mapless.geometry import Array
from mapless_server.method.match import MatchOptions, search
from mapless_server.method.options import check_bounds
from mapless_server.method.results import PointMatches
from mapless_server.method.views import PosedView

from .look import Look
from .neighbourhood import Neighbourhood
from .visibility import VisibilityOptions, Visible, visible_points


@dataclass(frozen=True)
class ChangeOptions:
    """Options of looking for changes.

    Attributes:
        columns, rows: of the grid.
        max_turn_deg, max_scale: points are expected only where they are seen much as a neighbour sees them.
        radius_px: a point is found when a similar keypoint is this near to its projection.
        min_similarity: smallest cosine of their descriptors.
        missing_share: a cell misses its points when fewer than this share of the usual share of them is found.
        max_chance: and when chance would do that in fewer than so many cells.
        min_points: fewer expected points in the whole image are no ground for a judgement.
        alarm_share: a connected region that misses its points and is so large a share of the judged image is an alarm.
            Of 149 unaltered photographs the worst had 0.20, and 0.33 when its best neighbour was faulty; of 12
            with 60 % of the image replaced 5 are found, the others are told with their share or as unverifiable.
    """

    columns: int = 8
    rows: int = 6
    max_turn_deg: float = 20.0
    max_scale: float = 1.5
    radius_px: float = 6.0
    min_similarity: float = 0.8
    missing_share: float = 0.15
    max_chance: float = 1e-3
    min_points: int = 100
    alarm_share: float = 0.35

    def __post_init__(self) -> None:
        check_bounds(self, "missing_share max_chance alarm_share", above=0, below=1)
        check_bounds(self, "columns rows radius_px", above=0)


SAME_VIEWPOINT = ChangeOptions(max_turn_deg=8.0, max_scale=1.25)
"""For a photograph that nothing explains. With a wall between it and its neighbours it would show nothing of theirs and
be right, so it must stand where they stand: whatever is in its way is in theirs."""

_LEAST_OBSERVERS = 3
"""So many references must see what a photograph should show; one alone may be the one that changed."""


@dataclass(frozen=True)
class Change:
    """What was found.

    Attributes:
        expected_count: points that the image should show.
        found_count: those it does show.
        judged_share: share of the image's cells with enough expected points to judge.
        changed_share: share of the judged cells that lie in the largest connected region that misses its points.
        is_alarm: whether that is a change.
    """

    expected_count: int
    found_count: int
    judged_share: float
    changed_share: float
    is_alarm: bool


def changed_region(look: Look, options: ChangeOptions | None = None) -> Change | None:
    """Compares a photograph with its neighbours' points; None with too few of them.

    At the pose that explains its matches, so that what the given one is off within its tolerance does not count; at the
    given one when nothing explains them.
    """
    options = options or ChangeOptions()
    if len(look.neighbourhood.structure.x_in_world) < options.min_points:
        return None
    subject = look.subject
    if look.is_usable:
        subject = replace(subject, world_from_camera=look.world_from_camera)
    bounds = VisibilityOptions(options.max_turn_deg, options.max_scale)
    visible = visible_points(subject.view.camera, subject.world_from_camera, look.neighbourhood, bounds)
    if len(visible) < options.min_points or len(np.unique(visible.reference)) < _LEAST_OBSERVERS:
        return None
    found = _found(subject, look.neighbourhood, visible, options)
    camera = subject.view.camera
    cell = np.floor((visible.pixel + 0.5) / (camera.width_px, camera.height_px) * (options.columns, options.rows))
    index = (cell[:, 1] * options.columns + cell[:, 0]).astype(np.intp)
    cells = options.columns * options.rows
    expected_by_cell = np.bincount(index, minlength=cells)
    found_by_cell = np.bincount(index, weights=found.astype(float), minlength=cells).astype(np.float64)
    missing, judged = _missing(expected_by_cell, found_by_cell, options)
    grid = missing.reshape(options.rows, options.columns).astype(np.uint8)
    count, regions = cv2.connectedComponents(grid, connectivity=4)
    largest = max((int((regions == k).sum()) for k in range(1, count)), default=0)
    share = largest / max(int(judged.sum()), 1)
    enough = judged.sum() >= cells / 4
    return Change(
        len(visible), int(found.sum()), float(judged.mean()), share, bool(enough and share >= options.alarm_share)
    )


def _missing(
    expected: NDArray[np.intp], found: Array, options: ChangeOptions
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which cells miss their points, and which have enough of them to say so."""
    usual = _usual_share(expected, found)
    limit = options.missing_share * usual
    # A cell can be judged when finding nothing at all would be no chance.
    judged = bdtr(0, expected, usual) < options.max_chance
    unlikely = bdtr(found, expected, usual) < options.max_chance
    return judged & unlikely & (found <= limit * expected), judged


def _usual_share(expected: NDArray[np.intp], found: Array) -> float:
    """Share of expected points that is found in the better half of the cells; at least what unchanged scenes have."""
    known = expected >= 5
    if not known.any():
        return _LEAST_SHARE
    shares = found[known] / expected[known]
    return max(float(np.quantile(shares, 0.75)), _LEAST_SHARE)


_LEAST_SHARE = 0.15
"""An unchanged photograph shows at least so many of the points that it should show."""


def _found(
    subject: PosedView, neighbourhood: Neighbourhood, visible: Visible, options: ChangeOptions
) -> NDArray[np.bool_]:
    """Which visible points (V,) have a similar keypoint near by."""
    nothing = np.empty(0, np.intp)
    known = PointMatches(nothing, nothing, np.empty(0, bool), options.radius_px)
    match_options = MatchOptions(radius_px=options.radius_px, min_similarity=options.min_similarity)
    found = search(
        subject.view,
        neighbourhood.references,
        neighbourhood.structure,
        subject.world_from_camera,
        known,
        match_options,
    )
    return np.isin(visible.point, found.point)
