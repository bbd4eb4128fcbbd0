"""Adjustment: our own last refinement, a bundle adjustment of the query, its points and, a little, the references.

The paper fixes the points before it solves for the query, and fixes the references for good. But the query sees the
points too, and reference poses are never exact: they carry noise of their own, and an imperfect lens model acts like
more. So here everything moves at once,

    min  sum_obs rho(|r_o|^2 / sigma_o^2) + sum_i |xi_i|^2 / sigma_prior^2,

over the query's pose, the points it sees and a small motion xi_i of every reference, which a prior holds to its given
pose. The points are eliminated (Schur complement), leaving a dense system of 6 unknowns per camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, rotation_from_vector

from .match import PointMatches
from .observations import Observations, invert_symmetric
from .pnp import PoseEstimate, PoseStage, motion_jacobian, reprojection_errors_px, world_covariance
from .structure import Structure, observe
from .tracks import Tracks
from .views import PosedView, View


@dataclass(frozen=True)
class AdjustOptions:
    """Options of the adjustment.

    Attributes:
        loss_scale_sigma: of the Cauchy loss, which forgets gross errors rather than merely bounding them.
        prior_share: how far references may move: the standard deviation of the prior, in image pixels, as a share of
            the noise level found in the structure. What the residuals show is an upper bound of what poses are off.
        error_inflation: factor on the standard deviations of the answer. Errors of neighbouring keypoints and of one
            reference's points go together, which the sum over residuals does not know; on scenes with known poses true
            errors were 1.5 to 2.8 times what it says.
        inlier_px: as of the pose solver; the inliers of the answer are those of its own pose.
        min_kept_share: an adjustment that loses more of the inliers has run off, and is not answered.
        max_error_px: matches further from the pose found so far take no part.
        iterations: at most so many Levenberg-Marquardt steps.
        min_decrease: stop when a step lowers the cost by a smaller share.
    """

    loss_scale_sigma: float = 1.4
    prior_share: float = 0.2
    error_inflation: float = 2.0
    inlier_px: float = 4.0
    min_kept_share: float = 0.8
    max_error_px: float = 8.0
    iterations: int = 8
    min_decrease: float = 1e-5

    def __post_init__(self) -> None:
        positive = (
            self.inlier_px,
            self.min_kept_share,
            self.loss_scale_sigma,
            self.prior_share,
            self.max_error_px,
            self.iterations,
            self.min_decrease,
        )
        if not min(positive) > 0:
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True, eq=False)
class _State:
    """Poses camera_from_world of references, then query: rotation (V, 3, 3), translation (V, 3); points (P, 3)."""

    rotation: Array
    translation: Array
    points: Array

    def moved(self, motion: Array, step: Array) -> _State:
        """After left perturbations (V, 6) of the poses and steps (P, 3) of the points."""
        turn = np.stack([rotation_from_vector(w) for w in motion[:, 3:]])
        return _State(
            turn @ self.rotation, (turn @ self.translation[:, :, None])[..., 0] + motion[:, :3], self.points + step
        )


class _Problem:
    """The cost and its derivatives; knows nothing of how it is minimized."""

    def __init__(
        self,
        observations: Observations,
        view: NDArray[np.intp],
        given: _State,
        prior_sigma: Array,
        options: AdjustOptions,
    ) -> None:
        self.observations, self.view, self.given, self.options = observations, view, given, options
        self.information = prior_sigma**-2.0  # (V - 1, 6), of the references
        self.cameras = len(given.rotation)
        # Row v picks camera v's observations: sums over cameras become one matrix product.
        self.pick = (view == np.arange(self.cameras)[:, None]).astype(float)

    def at(self, state: _State) -> Observations:
        return replace(self.observations, rotation=state.rotation[self.view], translation=state.translation[self.view])

    def prior_error(self, state: _State) -> Array:
        """(V - 1, 6): the motion of each reference away from its given pose."""
        turn = state.rotation[:-1] @ np.swapaxes(self.given.rotation[:-1], 1, 2)
        shift = state.translation[:-1] - (turn @ self.given.translation[:-1, :, None])[..., 0]
        skew = (turn - np.swapaxes(turn, 1, 2)) / 2
        return np.concatenate([shift, skew[:, [2, 0, 1], [1, 2, 0]]], axis=1)

    def cost(self, state: _State) -> float:
        squared = (self.at(state).residuals(state.points) ** 2).sum(axis=1)
        scale = self.options.loss_scale_sigma**2
        prior = (self.prior_error(state) ** 2 * self.information).sum()
        return float(scale * np.log1p(squared / scale).sum() + prior)  # NaN for a point behind a camera

    def linearize(self, state: _State) -> _NormalEquations:
        observations = self.at(state)
        residual = observations.residuals(state.points)
        weight = 1 / (1 + (residual**2).sum(axis=1) / self.options.loss_scale_sigma**2)
        x_in_camera = observations.in_camera(state.points)
        by_camera_point = observations.camera_jacobians(x_in_camera)
        by_point = by_camera_point @ observations.rotation  # (O, 2, 3)
        by_pose = by_camera_point @ motion_jacobian(x_in_camera)  # (O, 2, 6)
        weighted_point = np.swapaxes(by_point * weight[:, None, None], 1, 2)
        weighted_pose = np.swapaxes(by_pose * weight[:, None, None], 1, 2)
        error = residual[:, :, None]

        pose_block = (self.pick @ (weighted_pose @ by_pose).reshape(-1, 36)).reshape(-1, 6, 6)
        pose_gradient = self.pick @ (weighted_pose @ error)[..., 0]
        pose_block[:-1] += self.information[:, :, None] * np.eye(6)
        pose_gradient[:-1] += self.information * self.prior_error(state)
        cross = np.zeros((len(state.points), self.cameras, 6, 3))
        cross[observations.point, self.view] = weighted_pose @ by_point  # a point is seen once in a view
        return _NormalEquations(
            pose_block,
            pose_gradient.ravel(),
            observations.sum_by_point(weighted_point @ by_point),
            observations.sum_by_point((weighted_point @ error)[..., 0]),
            cross.reshape(len(state.points), -1, 3),
        )


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """[B E; E^T C] [d_pose; d_point] = -[g; h], where B and C are block-diagonal.

    Attributes:
        pose_block: B, (V, 6, 6).
        pose_gradient: g, (6 V,).
        point_block: C, (P, 3, 3).
        point_gradient: h, (P, 3).
        cross: E, (P, 6 V, 3).
    """

    pose_block: Array
    pose_gradient: Array
    point_block: Array
    point_gradient: Array
    cross: Array

    def reduced(self, damping: float) -> tuple[Array, Array, Array]:
        """B - E C^-1 E^T (6 V, 6 V), g - E C^-1 h (6 V,) and C^-1 (P, 3, 3), diagonals enlarged by `damping`."""
        damped_points = self.point_block * (1 + damping * np.eye(3))
        inverse = invert_symmetric(damped_points)
        size = self.cross.shape[1]
        wide = np.swapaxes(self.cross, 0, 1).reshape(size, -1)  # (6 V, 3 P)
        gained = np.swapaxes(self.cross @ inverse, 0, 1).reshape(size, -1)
        matrix = -gained @ wide.T
        for v, block in enumerate(self.pose_block * (1 + damping * np.eye(6))):
            matrix[6 * v : 6 * v + 6, 6 * v : 6 * v + 6] += block
        return matrix, self.pose_gradient - gained @ self.point_gradient.ravel(), inverse

    def step(self, damping: float) -> tuple[Array, Array]:
        """Motions (V, 6) of the cameras and steps (P, 3) of the points."""
        matrix, gradient, inverse = self.reduced(damping)
        motion = -np.asarray(np.linalg.solve(matrix, gradient), np.float64)
        back = self.point_gradient + np.swapaxes(self.cross, 1, 2) @ motion
        return motion.reshape(-1, 6), -(inverse @ back[:, :, None])[..., 0]


def adjust_pose(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    estimate: PoseEstimate,
    options: AdjustOptions,
) -> PoseEstimate:
    """Refines an estimate together with the points it rests on and, within their noise, the references.

    Args:
        query: the query.
        references: in the order that the structure's tracks number them.
        structure: metric points.
        matches: of the query with them.
        estimate: the pose so far; its errors decide which matches take part.
        options: see there.

    Returns:
        The estimate with another pose and covariance; unchanged when there is nothing to gain.
    """
    used = np.flatnonzero(estimate.errors_px < options.max_error_px)
    if len(used) < 3:  # two equations each, for six unknowns
        return estimate
    problem, state = _pose_problem(query, references, structure, matches, used, estimate.world_from_camera, options)
    state, equations = _minimize(problem, state, options)
    matrix, _, _ = equations.reduced(0.0)
    if not np.isfinite(matrix).all():
        return estimate
    pose = RigidTransform(state.rotation[-1], state.translation[-1]).inverse()
    # The query's block of the inverse is the inverse of what is left when the references are eliminated too.
    references_block, coupling = matrix[:-6, :-6], matrix[:-6, -6:]
    hessian = matrix[-6:, -6:] - coupling.T @ np.linalg.solve(references_block, coupling)
    pixels = query.features.keypoints[matches.keypoint].astype(np.float64)
    points = structure.x_in_world.copy()
    points[np.unique(matches.point[used])] = state.points
    errors_px = reprojection_errors_px(query.camera, pose, points[matches.point], pixels)
    covariance = options.error_inflation**2 * world_covariance(hessian, pose)
    inliers = errors_px < options.inlier_px
    if inliers.sum() < options.min_kept_share * estimate.inliers.sum():
        return estimate
    return PoseEstimate(pose, PoseStage.REFINED, inliers, errors_px, covariance)


def _minimize(problem: _Problem, state: _State, options: AdjustOptions) -> tuple[_State, _NormalEquations]:
    cost, damping = problem.cost(state), 1e-4
    equations = problem.linearize(state)
    for _ in range(options.iterations):
        candidate = state.moved(*equations.step(damping))
        candidate_cost = problem.cost(candidate)
        if not candidate_cost < cost:
            damping *= 10
            continue
        converged = cost - candidate_cost < options.min_decrease * cost
        state, cost, damping = candidate, candidate_cost, damping * 0.1
        equations = problem.linearize(state)
        if converged:
            break
    return state, equations


def _pose_problem(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    used: NDArray[np.intp],
    world_from_query: RigidTransform,
    options: AdjustOptions,
) -> tuple[_Problem, _State]:
    chosen = np.zeros(len(structure.x_in_world), bool)
    chosen[matches.point[used]] = True
    seen = structure.tracks.select(chosen)
    views = [*references, PosedView("", "", query, world_from_query)]
    point = np.concatenate([seen.point, np.cumsum(chosen)[matches.point[used]] - 1])
    view = np.concatenate([seen.view, np.full(len(used), len(references))])
    keypoint = np.concatenate([seen.keypoint, matches.keypoint[used]])
    order = np.lexsort((view, point))
    tracks = Tracks(point[order], view[order], keypoint[order])
    observations = observe(tracks, views, structure.noise)

    camera_from_world = [v.world_from_camera.inverse() for v in views]
    state = _State(
        np.stack([c.rotation for c in camera_from_world]),
        np.stack([c.translation for c in camera_from_world]),
        structure.x_in_world[chosen],
    )
    # Noise of a pixel is a turn of 1 / f, or a shift of depth / f.
    turn = options.prior_share * structure.noise.level_px / np.array([r.view.camera.focal_x_px for r in references])
    depth_m = float(np.median(observations.in_camera(state.points)[:, 2]))
    prior_sigma = np.repeat(np.stack([turn * depth_m, turn], axis=1), 3, axis=1)
    return _Problem(observations, tracks.view, state, prior_sigma, options), state
