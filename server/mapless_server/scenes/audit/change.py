"""Changes of a scene: regions of an image that do not show what the neighbours show there.

Every point that should be visible is searched near its projection. In an unchanged image a good share of them is found
everywhere; where hardly any is found in a large connected region, the region shows something else. An occlusion looks
the same, so only a large region is called a change.
"""

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.special import bdtr

from mapless.geometry import Array
from mapless_server.method.features.views import PosedView
from mapless_server.method.structure.match import MatchOptions, search
from mapless_server.method.structure.model import PointMatches

from .comparison import Comparison
from .neighbourhood import Neighbourhood, Visibility, Visible, visible_points

SEEN_ALIKE = Visibility(max_turn_deg=20.0, max_scale=1.5)
"""Points are expected only where they are seen about as a neighbour sees them."""
SAME_VIEWPOINT = Visibility(max_turn_deg=8.0, max_scale=1.25)
"""For a photograph that no pose fits. A wall between it and its neighbours would hide everything they see, so only
neighbours at its own viewpoint count, which the wall would hide, too."""

_COLUMNS, _ROWS = 8, 6
"""Size of the grid of cells."""
_RADIUS_PX, _MIN_SIMILARITY = 6.0, 0.8
"""A point is found if a keypoint whose descriptor has at least this cosine is this near to its projection."""
_MISSING_SHARE, _MAX_CHANCE = 0.15, 1e-3
"""A cell has changed if less than this share of the usual share of its points is found, and less probably than this."""
_MIN_POINTS = 100
"""With fewer expected points in the whole image nothing is decided."""
_ALARM_SHARE = 0.35
"""A connected region of changed cells with at least this share of the judged image is an alarm. Of 149 unaltered
photographs the worst had 0.20, and 0.33 when its best neighbour was faulty; of 12 with 60 % of the image replaced 5 are
found, the others reported with their share or as unverifiable."""
_LEAST_OBSERVERS = 3
"""References that must see what a photograph should show: a single one may itself have changed."""


@dataclass(frozen=True)
class Change:
    """The comparison of an image with its neighbours' points: those that it should show, and those it shows.

    `changed_share` is the share of the judged cells that are in the largest connected region of changed cells;
    `is_alarm` whether that is a change of the scene.
    """

    expected_count: int
    found_count: int
    changed_share: float
    is_alarm: bool


def find_change(comparison: Comparison, limits: Visibility) -> Change | None:
    """Compares a photograph with its neighbours' points; None with too few of them.

    Uses the fitted pose, so that an error of the given one within the tolerance does not matter, or the given one if no
    pose fits.
    """
    neighbourhood, subject = comparison.neighbourhood, comparison.subject
    if len(neighbourhood.structure.x_in_world) < _MIN_POINTS:
        return None
    if comparison.is_usable:
        subject = replace(subject, world_from_camera=comparison.world_from_camera)
    visible = visible_points(subject.view.camera, subject.world_from_camera, neighbourhood, limits)
    if len(visible) < _MIN_POINTS or len(np.unique(visible.reference)) < _LEAST_OBSERVERS:
        return None
    found = _found(subject, neighbourhood, visible)
    camera = subject.view.camera
    cell = np.floor((visible.pixel + 0.5) / (camera.width_px, camera.height_px) * (_COLUMNS, _ROWS))
    index = (cell[:, 1] * _COLUMNS + cell[:, 0]).astype(np.intp)
    cells = _COLUMNS * _ROWS
    expected_by_cell = np.bincount(index, minlength=cells)
    found_by_cell = np.bincount(index, weights=found.astype(float), minlength=cells).astype(np.float64)
    missing, judged = _missing(expected_by_cell, found_by_cell)
    grid = missing.reshape(_ROWS, _COLUMNS).astype(np.uint8)
    count, regions = cv2.connectedComponents(grid, connectivity=4)
    largest = max((int((regions == k).sum()) for k in range(1, count)), default=0)
    share = largest / max(int(judged.sum()), 1)
    enough = judged.sum() >= cells / 4
    return Change(len(visible), int(found.sum()), share, bool(enough and share >= _ALARM_SHARE))


def _missing(expected: NDArray[np.intp], found: Array) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Masks of the cells that have changed, and of those with enough points to be judged."""
    usual = _usual_share(expected, found)
    limit = _MISSING_SHARE * usual
    # A cell can be judged if finding none of its points would be unlikely by chance.
    judged = bdtr(0, expected, usual) < _MAX_CHANCE
    unlikely = bdtr(found, expected, usual) < _MAX_CHANCE
    return judged & unlikely & (found <= limit * expected), judged


def _usual_share(expected: NDArray[np.intp], found: Array) -> float:
    """Share of expected points that are found in the best quarter of the cells; at least that of unchanged scenes."""
    known = expected >= 5
    if not known.any():
        return _LEAST_SHARE
    shares = found[known] / expected[known]
    return max(float(np.quantile(shares, 0.75)), _LEAST_SHARE)


_LEAST_SHARE = 0.15
"""An unchanged photograph shows at least this share of the points that it should show."""


def _found(subject: PosedView, neighbourhood: Neighbourhood, visible: Visible) -> NDArray[np.bool_]:
    """Mask (V,) of the visible points that have a similar keypoint nearby."""
    nothing = np.empty(0, np.intp)
    known = PointMatches(nothing, nothing, np.empty(0, bool), _RADIUS_PX)
    options = MatchOptions(radius_px=_RADIUS_PX, min_similarity=_MIN_SIMILARITY)
    given = subject.view, neighbourhood.references, neighbourhood.structure, subject.world_from_camera
    found = search(*given, known, options)
    return np.isin(visible.point, found.point)
