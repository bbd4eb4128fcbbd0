"""Normal equations of a bundle adjustment with the points eliminated, and points adjusted alone, by compiled code.

It takes a fraction of the time of numpy, whose products are of all views by all points, though a point is in few views.
The plain versions are in `method.bundle` and `method.structure`, which say what is computed; sums are in another order,
so results differ by rounding. Arrays of doubles need not be contiguous. Functions raise ValueError where sizes or
indices do not fit.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

try:
    from . import _adjustment
except ImportError:  # not compiled
    IS_COMPILED = False
else:
    IS_COMPILED = True

Array = NDArray[np.float64]
Indices = NDArray[np.intp]

POSE = 6
MOST_INTRINSICS = 10
"""Unknowns of a camera's pose, and at most of the query's intrinsics and of its motion during the read-out."""


@dataclass(frozen=True, eq=False)
class Seen:
    """O observations of P points in V views, sorted by view, the query's last.

    Attributes:
        end: (V,) where the observations of each view end.
        point, view: (O,) indices of each observation's point and view; a point is at most once in a view.
        points: P.
        intrinsics: I, unknowns of the query beside its pose, at most 10. U = 6 V + I are all unknowns but the points.
    """

    end: Indices
    point: Indices
    view: Indices
    points: int
    intrinsics: int

    @property
    def of_query(self) -> int:
        """O_q, the number of the query's observations."""
        return len(self.point) - (int(self.end[-2]) if len(self.end) > 1 else 0)

    @property
    def unknowns(self) -> int:
        """U."""
        return POSE * len(self.end) + self.intrinsics


@dataclass(frozen=True, eq=False)
class Cross:
    """The rows of all observations in the part of a matrix that couples cameras and points.

    Attributes:
        by_pose: (O, 3, 6).
        by_intrinsics: (O_q, 3, I).
    """

    by_pose: Array
    by_intrinsics: Array

    def like(self) -> Cross:
        """Rows of the same shape, to be written."""
        return Cross(np.empty(self.by_pose.shape), np.empty(self.by_intrinsics.shape))


def project(
    seen: Seen, rotation: Array, translation: Array, x_in_world: Array, focal: Array, offset: Array
) -> tuple[Array, Array, Array]:
    """Residuals (2, O), derivatives (2, 3, O) by points and (2, 6, O) by poses; see `ViewColumns.at`."""
    count = len(seen.point)
    found = np.empty((2, count)), np.empty((2, 3, count)), np.empty((2, POSE, count))
    given = map(np.ascontiguousarray, (rotation, translation, x_in_world, focal, offset))
    _adjustment.project(seen.points, seen.intrinsics, seen.end, seen.point, seen.view, *given, *found)
    return found


def equations(
    seen: Seen,
    residual: Array,
    by_point: Array,
    by_pose: Array,
    by_intrinsics: Array,
    weight: Array,
    least_curvature: float,
) -> tuple[Cross, Array, Array, Array, Array]:
    """E, B (U, U), g (U,), C (6, P), h (3, P) of normal equations; see `ViewColumns.equations`."""
    count, unknowns = len(seen.point), seen.unknowns
    cross = Cross(np.empty((count, 3, POSE)), np.empty((seen.of_query, 3, seen.intrinsics)))
    pose_block, pose_gradient = np.zeros((unknowns, unknowns)), np.empty(unknowns)
    point_block, point_gradient = np.zeros((6, seen.points)), np.zeros((3, seen.points))
    given = map(np.ascontiguousarray, (residual, by_point, by_pose, by_intrinsics, weight))
    found = pose_block, pose_gradient, point_block, point_gradient
    _adjustment.equations(
        *(seen.points, seen.intrinsics, least_curvature, seen.end, seen.point, seen.view),
        *given,
        *(cross.by_pose, cross.by_intrinsics),
        *found,
    )
    return cross, *found


def eliminate(
    seen: Seen, damping: float, point_block: Array, point_gradient: Array, cross: Cross, matrix: Array, vector: Array
) -> tuple[Array, Array, Cross]:
    """Factors L (6, P), L^-1 h (3, P) and E L^-T; subtracts E C^-1 E^T from matrix, E C^-1 h from vector, in place.

    The diagonal of C is enlarged by the damping first; see `NormalEquations.reduced`.
    """
    factor, gradient, left = np.empty((6, seen.points)), np.empty((3, seen.points)), cross.like()
    _adjustment.eliminate(
        *(seen.points, seen.intrinsics, damping, seen.end, seen.point, seen.view),
        *(np.ascontiguousarray(point_block), np.ascontiguousarray(point_gradient)),
        *(cross.by_pose, cross.by_intrinsics),
        *(factor, gradient, left.by_pose, left.by_intrinsics),
        *(matrix, vector),
    )
    return factor, gradient, left


def step(seen: Seen, factor: Array, gradient: Array, cross: Cross, motion: Array) -> Array:
    """Steps (P, 3) of the points for a motion (U,) of the cameras; see `EliminatedPoints.steps`."""
    steps = np.empty((seen.points, 3))
    its = cross.by_pose, cross.by_intrinsics, np.ascontiguousarray(motion)
    _adjustment.step(seen.points, seen.intrinsics, seen.end, seen.point, seen.view, factor, gradient, *its, steps)
    return steps


def leave_each_out(seen: Seen, gain: Array, misfit: Array, cross: Cross, matrices: Array, gradients: Array) -> None:
    """Subtracts the parts of each reference from matrices (V, U, U) and gradients (V, U), the first of all, in place.

    See `dispersion`.
    """
    given = np.ascontiguousarray(gain), np.ascontiguousarray(misfit), cross.by_pose, cross.by_intrinsics
    _adjustment.leave_each_out(
        seen.points, seen.intrinsics, seen.end, seen.point, seen.view, *given, matrices, gradients
    )


def adjust_each(
    start: Indices,
    rotation: Array,
    translation: Array,
    focal: Array,
    offset: Array,
    x_in_world: Array,
    loss_scale_sigma: float,
    iterations: int,
) -> Array:
    """Points (P, 3) with the least cost of their observations, start[p] to start[p + 1]; see `observations`."""
    points = np.array(x_in_world, np.float64, order="C")
    given = map(np.ascontiguousarray, (start, rotation, translation, focal, offset))
    _adjustment.adjust_each(loss_scale_sigma, iterations, *given, points)
    return points
