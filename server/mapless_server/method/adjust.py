"""Adjustment: our own last refinement, a bundle adjustment of the query, its points and, a little, the references.

The paper fixes the points before it solves for the query, and fixes the references for good. But the query sees the
points too, and reference poses are never exact: they carry noise of their own, and an imperfect lens model acts like
more. So here everything moves at once,

    min  sum_obs rho(|r_o|^2 / sigma_o^2) + sum_i |xi_i|^2 / sigma_prior^2,

over the query's pose, the points it sees and a small motion xi_i of every reference, which a prior holds to its given
pose. What is known of the query's own pose beforehand adds its terms too, if the photograph alone does not contradict
it. The points are eliminated (Schur complement), leaving a dense system of 6 unknowns per camera.
"""

from __future__ import annotations

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, rotation_from_vector

from .match import PointMatches
from .observations import Observations, invert_symmetric
from .pnp import PoseEstimate, PoseStage, reprojection_errors_px
from .priors.known import NO_PRIORS, Priors
from .structure import Structure, observe
from .uncertainty.covariance import Uncertainty, UncertaintyOptions, one_match_covariance, uncertainty_of
from .uncertainty.linearization import Linearization, grounds_of, linearize, tracks_with_query
from .views import PosedView, View


@dataclass(frozen=True)
class AdjustOptions:
    """Options of the adjustment.

    Attributes:
        loss_scale_sigma: of the Cauchy loss, which forgets gross errors rather than merely bounding them.
        prior_share: how far references may move: the standard deviation of the prior, in image pixels, as a share of
            the noise level found in the structure. What the residuals show is an upper bound of what poses are off.
        error_inflation: by how much standard deviations that are told from the sum over residuals are too small, as a
            rule: it decides what priors weigh. The answer's covariance does not rest on it (see `uncertainty`).
        inlier_px: as of the pose solver; the inliers of the answer are those of its own pose.
        min_kept_share: an adjustment that loses more of the inliers has run off, and is not answered.
        max_error_px: matches further from the pose found so far take no part.
        iterations: at most so many Levenberg-Marquardt steps.
        min_decrease: stop when a step lowers the cost by a smaller share.
        uncertainty: of the answer's covariance.
    """

    loss_scale_sigma: float = 1.4
    prior_share: float = 0.2
    error_inflation: float = 2.0
    inlier_px: float = 4.0
    min_kept_share: float = 0.8
    max_error_px: float = 8.0
    iterations: int = 8
    min_decrease: float = 1e-5
    uncertainty: UncertaintyOptions = field(default_factory=UncertaintyOptions)

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

    @property
    def world_from_query(self) -> RigidTransform:
        """The query's pose."""
        return RigidTransform(self.rotation[-1], self.translation[-1]).inverse()


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
        self.priors = NO_PRIORS  # of the query, the last camera
        self.observations, self.view, self.given, self.options = observations, view, given, options
        self.information = prior_sigma**-2.0  # (V - 1, 6), of the references
        self.cameras = len(given.rotation)
        # Row v picks camera v's observations: sums over cameras become one matrix product.
        self.pick = (view == np.arange(self.cameras)[:, None]).astype(float)

    def with_priors(self, priors: Priors) -> _Problem:
        """The same with something known of the query's pose."""
        problem = copy(self)
        problem.priors = priors
        return problem

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
        if self.priors:
            prior += self.options.error_inflation**2 * self.priors.cost(state.world_from_query)
        return float(scale * np.log1p(squared / scale).sum() + prior)  # NaN for a point behind a camera

    def query_terms(self, world_from_query: RigidTransform) -> tuple[Array, Array]:
        """Gradient (6,) and information (6, 6) of the query's priors, by a left perturbation of camera_from_world.

        That moves the centre by -R v and turns the camera by -R w about fixed axes (see `world_covariance`). Weighed
        like what the observations say, which is too much by `error_inflation`.
        """
        gradient, information = self.priors.gradient_and_information(world_from_query)
        turn = -np.kron(np.eye(2), world_from_query.rotation)
        weight = self.options.error_inflation**2
        return weight * turn.T @ gradient, weight * turn.T @ information @ turn

    def linearize(self, state: _State) -> _NormalEquations:
        observations = self.at(state)
        rows = linearize(observations, state.points, self.options.loss_scale_sigma)
        weight, by_point, by_pose = rows.weight, rows.by_point, rows.by_pose
        weighted_point = np.swapaxes(by_point * weight[:, None, None], 1, 2)
        weighted_pose = np.swapaxes(by_pose * weight[:, None, None], 1, 2)
        error = rows.residual[:, :, None]

        pose_block = (self.pick @ (weighted_pose @ by_pose).reshape(-1, 36)).reshape(-1, 6, 6)
        pose_gradient = self.pick @ (weighted_pose @ error)[..., 0]
        pose_block[:-1] += self.information[:, :, None] * np.eye(6)
        pose_gradient[:-1] += self.information * self.prior_error(state)
        if self.priors:
            known_gradient, known = self.query_terms(state.world_from_query)
            pose_gradient[-1] += known_gradient
            pose_block[-1] += known
        cross = np.zeros((len(state.points), self.cameras, 6, 3))
        cross[observations.point, self.view] = weighted_pose @ by_point  # a point is seen once in a view
        return _NormalEquations(
            pose_block,
            pose_gradient.ravel(),
            observations.sum_by_point(weighted_point @ by_point),
            observations.sum_by_point((weighted_point @ error)[..., 0]),
            cross.reshape(len(state.points), -1, 3),
            rows,
        )

    def uncertainty(self, state: _State, rows: Linearization, one_match: Array) -> Uncertainty | None:
        """Of the query's pose at an optimum, linearized there, without what priors say of it."""
        motions = np.concatenate([self.prior_error(state), np.zeros((1, 6))])
        options = self.options.uncertainty
        grounds = grounds_of(rows, self.observations.point, self.view, options.max_matches, motions)
        return uncertainty_of(grounds, state.world_from_query, one_match, options)


@dataclass(frozen=True, eq=False)
class _NormalEquations:
    """[B E; E^T C] [d_pose; d_point] = -[g; h], where B and C are block-diagonal.

    Attributes:
        pose_block: B, (V, 6, 6).
        pose_gradient: g, (6 V,).
        point_block: C, (P, 3, 3).
        point_gradient: h, (P, 3).
        cross: E, (P, 6 V, 3).
        rows: of the observations, from which all this is summed.
    """

    pose_block: Array
    pose_gradient: Array
    point_block: Array
    point_gradient: Array
    cross: Array
    rows: Linearization

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
    priors: Priors = NO_PRIORS,
) -> PoseEstimate:
    """Refines an estimate together with the points it rests on and, within their noise, the references.

    Args:
        query: the query.
        references: in the order that the structure's tracks number them.
        structure: metric points.
        matches: of the query with them.
        estimate: the pose so far; its errors decide which matches take part.
        options: see there.
        priors: what is known of the query's pose. Each is checked against the pose that the photograph alone gives;
            those that are consistent with it take part, and the others do not.

    Returns:
        The estimate with another pose and covariance; unchanged when there is nothing to gain.
    """

    def adjusted(start: PoseEstimate, pulling: Priors) -> PoseEstimate | None:
        return _adjusted(query, references, structure, matches, start, options, pulling)

    # Where priors turn out not to be used, the answer is, to the last bit, the one without them.
    unpulled = estimate.unpulled or estimate
    alone = adjusted(unpulled, NO_PRIORS)
    if not priors:
        return alone or unpulled
    checks = priors.check(alone.world_from_camera, alone.covariance) if alone else estimate.prior_checks
    used = priors.consistent(checks)
    answer = (adjusted(estimate, used) or estimate) if used else (alone or unpulled)
    return replace(answer, prior_checks=checks)


def _adjusted(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    estimate: PoseEstimate,
    options: AdjustOptions,
    priors: Priors,
) -> PoseEstimate | None:
    """The estimate at the optimum that priors pull; None if there is none nearby, or too few matches for any."""
    used = np.flatnonzero(estimate.errors_px < options.max_error_px)
    if len(used) < 3:  # two equations each, for six unknowns
        return None
    problem, start = _pose_problem(query, references, structure, matches, used, estimate.world_from_camera, options)
    state, equations = _minimize(problem.with_priors(priors), start, options)
    found = _conclude(query, structure, matches, used, estimate, problem, state, equations)
    if found is None:
        return None
    return replace(found, covariance=priors.sharpened(found.covariance, found.world_from_camera))


def _conclude(
    query: View,
    structure: Structure,
    matches: PointMatches,
    used: NDArray[np.intp],
    estimate: PoseEstimate,
    problem: _Problem,
    state: _State,
    equations: _NormalEquations,
) -> PoseEstimate | None:
    """The estimate at the optimum, its covariance without priors; None if it has run off."""
    pose, options = state.world_from_query, problem.options
    pixels = query.features.keypoints[matches.keypoint].astype(np.float64)
    points = structure.x_in_world.copy()
    points[np.unique(matches.point[used])] = state.points
    errors_px = reprojection_errors_px(query.camera, pose, points[matches.point], pixels)
    inliers = errors_px < options.inlier_px
    if inliers.sum() < max(1, options.min_kept_share * estimate.inliers.sum()):
        return None
    x_in_world = points[matches.point[inliers]]
    one_match = one_match_covariance(query.camera, pose, x_in_world, structure.noise.level_px)
    uncertainty = problem.uncertainty(state, equations.rows, one_match)
    if uncertainty is None:
        return None
    covariance = uncertainty.covariance
    return PoseEstimate(pose, PoseStage.REFINED, inliers, errors_px, covariance, uncertainty=uncertainty)


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
    views = [*references, PosedView("", "", query, world_from_query)]
    tracks, chosen = tracks_with_query(structure, matches.point[used], matches.keypoint[used], len(references))
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
