"""Observations linearized at poses and points: input of the adjustment and of the uncertainty."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

from ..observations import Observations
from ..results import Structure
from ..robust import cauchy_weight
from ..tracks import Tracks
from .dispersion import JackknifeInput, LinearizedObservations
from .perturbation import motion_jacobian


@dataclass(frozen=True, eq=False)
class Linearization:
    """Row o is one observation; residuals and derivatives in standard deviations.

    Attributes:
        residual: (O, 2).
        weight: (O,) of its square, by the Cauchy loss.
        by_point: (O, 2, 3) derivative by the point, per metre.
        by_pose: (O, 2, 6) derivative by a left perturbation (v, w) of camera_from_world.
    """

    residual: Array
    weight: Array
    by_point: Array
    by_pose: Array


def linearize(observations: Observations, x_in_world: Array, loss_scale_sigma: float) -> Linearization:
    """Of points (P, 3), with a Cauchy loss of this scale."""
    x_in_camera = observations.in_camera(x_in_world)
    residual = observations.camera_residuals(x_in_camera)
    weight = cauchy_weight((residual**2).sum(axis=1), loss_scale_sigma)
    by_camera_point = observations.camera_jacobians(x_in_camera)
    by_point = by_camera_point @ observations.rotation
    return Linearization(residual, weight, by_point, by_camera_point @ motion_jacobian(x_in_camera))


def jackknife_input(
    rows: Linearization,
    point: NDArray[np.intp],
    view: NDArray[np.intp],
    max_matches: int,
    motions: Array | None = None,
) -> JackknifeInput:
    """What the last view's pose rests on.

    Args:
        rows: of all observations.
        point: (O,) of each.
        view: (O,) of each; the references, in their order, and last the photograph whose pose is asked for.
        max_matches: of its observations; more are thinned evenly.
        motions: (V, 6) left perturbations that brought the cameras from their given poses to those that `rows` is
            linearized at; None if they are at their given poses.
    """
    asked = int(view.max())
    is_asked = view == asked
    thinning = -(-int(is_asked.sum()) // max_matches)
    if thinning > 1:
        taken = np.zeros(int(point.max()) + 1, bool)
        taken[point[is_asked][::thinning]] = True
        kept = taken[point]
        rows = Linearization(rows.residual[kept], rows.weight[kept], rows.by_point[kept], rows.by_pose[kept])
        point, view, is_asked = point[kept], view[kept], is_asked[kept]
    residual = rows.residual
    if motions is not None:
        residual = residual - (rows.by_pose * motions[view][:, None, :]).sum(axis=2)

    def some(chosen: NDArray[np.bool_]) -> LinearizedObservations:
        return LinearizedObservations(point[chosen], rows.by_point[chosen], residual[chosen], rows.weight[chosen])

    return JackknifeInput(
        some(is_asked), rows.by_pose[is_asked], some(~is_asked), view[~is_asked], asked, max(thinning, 1)
    )


def tracks_with_query(
    structure: Structure, point: NDArray[np.intp], keypoint: NDArray[np.intp], view: int
) -> tuple[Tracks, NDArray[np.bool_]]:
    """Tracks over the references and the query, of the points that the query is matched with.

    Args:
        structure: of P points.
        point: (M,) of each match, none twice.
        keypoint: (M,) of the query.
        view: number that the query gets.

    Returns:
        The tracks, and which points (P,) they are of.
    """
    chosen = np.zeros(len(structure.x_in_world), bool)
    chosen[point] = True
    seen = structure.tracks.select(chosen)
    points = np.concatenate([seen.point, np.cumsum(chosen)[point] - 1])
    views = np.concatenate([seen.view, np.full(len(point), view)])
    keypoints = np.concatenate([seen.keypoint, keypoint])
    order = np.lexsort((views, points))
    return Tracks(points[order], views[order], keypoints[order]), chosen
