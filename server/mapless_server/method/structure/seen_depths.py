"""Depths of what a photograph shows, from other references: triangulated with them, or measured by their sensors.

Each belongs to a group, a neighbour's points or a neighbour's depth, whose errors are common: poses that are off move
all points of a pair in one direction.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from ..features.limits import EPIPOLAR_PX
from ..features.views import Matches, PosedView
from ..optim.optimize import normal_sigma
from ..pairs.epipolar import MIN_PARALLAX_DEG, PosedMatches, triangulate_depths
from .measured_depth import MeasuredDepth

KEYPOINT_PX = 1.0
"""Standard deviation of a keypoint, at least; more where matches of a pair are further from its epipolar lines."""
MAX_RELATIVE_SIGMA = 0.2
"""Triangulated points that are worse say nothing of a depth."""
POSE_SIGMA_M = 0.003
"""Standard deviation of the distance between two references, metres: a triangulated depth is off by as large a share.
Chosen so that right depths of four recordings fit."""
MOST_POINTS, GRID = 150, 1200
"""Triangulated points of a neighbour that are compared, at most, and depths of all neighbours together: more take
longer, and are not independent."""


@dataclass(frozen=True, eq=False)
class SeenDepths:
    """Depths of M places in a photograph.

    Attributes:
        pixel: (M, 2) in the view's camera.
        place: (M,) number of the place: a keypoint is one place for all neighbours.
        depth: (M,) along the viewing direction of the photograph, in the unit of its pose.
        relative_sigma: (M,) standard deviation of each, as a share.
        group: (M,) number of the group.
        common_sigma: (G,) standard deviation of the factor of each group, as a share; infinite for depths that others
            measured.
    """

    pixel: Array
    place: NDArray[np.intp]
    depth: Array
    relative_sigma: Array
    group: NDArray[np.intp]
    common_sigma: Array

    def __len__(self) -> int:
        return len(self.depth)

    @property
    def are_triangulated(self) -> NDArray[np.bool_]:
        """Whether each is a triangulated point's (M,)."""
        return np.isfinite(self.common_sigma)[self.group]

    @staticmethod
    def of(parts: Sequence["SeenDepths"]) -> "SeenDepths":
        """All of them; places of different parts are different if their numbers are."""
        begin = np.cumsum([0, *(len(it.common_sigma) for it in parts)])[:-1]
        return SeenDepths(
            np.concatenate([np.zeros((0, 2)), *(it.pixel for it in parts)]),
            np.concatenate([np.zeros(0, np.intp), *(it.place for it in parts)]),
            np.concatenate([np.zeros(0), *(it.depth for it in parts)]),
            np.concatenate([np.zeros(0), *(it.relative_sigma for it in parts)]),
            np.concatenate([np.zeros(0, np.intp), *(it.group + first for it, first in zip(parts, begin, strict=True))]),
            np.concatenate([np.zeros(0), *(it.common_sigma for it in parts)]),
        )


def triangulated_depths(subject: PosedView, neighbour: PosedView, matches: Matches) -> SeenDepths:
    """Depths of the subject's keypoints, triangulated with one neighbour; the matches are (subject, neighbour).

    With the parallax p and the standard deviation s of a ray's angle, that of a depth is sqrt(2) s / sin(p). The factor
    of all is off by the mean distance from the epipolar lines, as far as poses are as wrong along the lines as across
    them, and by the error of the distance between the cameras.
    """
    posed = PosedMatches.of_pair(subject, neighbour, matches)
    views = subject, neighbour
    centre = np.stack([np.broadcast_to(it.world_from_camera.translation, (len(matches), 3)) for it in views], axis=1)
    rays = [ray @ it.world_from_camera.rotation.T for ray, it in zip(posed.rays[:, 0], views, strict=True)]
    depth, parallax_deg = triangulate_depths(centre, np.stack(rays, axis=1))
    distance_px = posed.distances_px()[0]
    near = np.abs(distance_px) <= EPIPOLAR_PX
    if posed.are_at_one_place[0] or not near.any():
        return _nothing()
    px = max(KEYPOINT_PX, float(normal_sigma(distance_px[near])))
    px_to_share = np.sqrt(2) / posed.focal.min() / np.sin(np.radians(parallax_deg.clip(MIN_PARALLAX_DEG)))
    kept = near & (depth > 0).all(axis=1) & (parallax_deg >= MIN_PARALLAX_DEG)
    kept &= px * px_to_share <= MAX_RELATIVE_SIGMA
    if not kept.any():
        return _nothing()
    signed = distance_px[kept]
    rows = np.flatnonzero(kept)
    rows = rows[:: -(-len(rows) // MOST_POINTS)]
    bias_px = abs(float(signed.mean())) + float(signed.std()) / np.sqrt(len(signed))
    apart_m = float(np.linalg.norm(posed.baseline[0]))
    common = float(np.hypot(bias_px * np.median(px_to_share[kept]), POSE_SIGMA_M / apart_m))
    return SeenDepths(
        posed.pixels[0, 0, rows],
        matches[rows, 0].astype(np.intp),
        depth[rows, 0],
        px * px_to_share[rows],
        np.zeros(len(rows), np.intp),
        np.array([common]),
    )


def depths_of_neighbour(
    subject: PosedView, neighbour: PosedView, depth: MeasuredDepth, first_place: int, count: int = GRID
) -> SeenDepths:
    """Depths in the subject's photograph of what a neighbour's sensor measured, on a grid of so many pixels of it.

    What is hidden from the subject is among them. Places are numbered from `first_place` on.
    """
    pixels, values = depth.on_grid(neighbour.view.camera, count)
    rays = neighbour.view.camera.rays(pixels)
    x = neighbour.world_from_camera.apply(rays * values[:, None])
    x = subject.world_from_camera.inverse().apply(x)
    camera, in_front = subject.view.camera, x[:, 2] > 0
    pixel = camera.project(np.where(in_front[:, None], x, (0.0, 0.0, 1.0)))
    inside = in_front & ((pixel >= 0) & (pixel <= (camera.width_px - 1, camera.height_px - 1))).all(axis=1)
    sigma = depth.noise.relative_sigma(values[inside])
    places = first_place + np.arange(len(sigma))
    return SeenDepths(pixel[inside], places, x[inside, 2], sigma, np.zeros(len(sigma), np.intp), np.array([np.inf]))


def _nothing() -> SeenDepths:
    return SeenDepths.of([])
