"""The pose of matches with depths: the six unknowns, and the factor of the query's depths, by Gauss-Newton.

The equations, and what the covariance contains, stand in `by_depths`.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, cross_matrix, normalize_jacobian

from ..bundle.pose_problem import DRIFT_INFLATION, OWN_INFLATION, USUAL_DRIFT, USUAL_OWN
from ..optim.optimize import (
    cauchy_weight,
    motion_jacobian,
    normal_sigma,
    perturbed,
    solve_step,
    world_covariance,
    world_jacobian,
)
from ..structure.kept_depth import AGREEING_SIGMA
from ..structure.model import PixelPoints
from .pnp import MIN_MATCHES, PnpOptions, false_alarms, ransac
from .turned import BEHIND_PX, Rows, TurnedMatches

FIRST_SIGMA_PX, MIN_SIGMA_PX = 1.5, 0.5
"""Initial and least standard deviation of a keypoint."""

FIRST_DEPTH_SIGMA, MIN_DEPTH_SIGMA, MAX_DEPTH_SIGMA = 0.1, 0.01, 0.3
"""Initial, least and largest relative standard deviation of a depth; with a larger one nearly every match would be an
inlier along its epipolar line. The first is also that of a network, which does not state its own."""

ITERATIONS = 12
"""Steps of the estimation; errors of keypoints and depths are estimated anew in each."""

MIN_INLIERS = 12
"""Fewer give no pose."""

SHARED_MATCHES = 20.0
"""Matches over which errors average out that matches share, such as those of a lens or of the depths of one surface."""

ROTATION_FACTOR = 1.79
"""Factor on standard deviations of the rotation; not measured."""


@dataclass(frozen=True, eq=False)
class DepthProblem:
    """Matches with a depth: points at the references' depths, and last those at the query's.

    Attributes:
        seen: points at depths of the references that the query sees.
        reference_centre: (S, 3) centre of the reference of each.
        depth_sigma: the stated error of a depth, as a share; None if it is not stated.
        view: (M,) index of the reference of each match.
        turned: points at depths of the query; None if there are none.
    """

    seen: PixelPoints
    reference_centre: Array
    depth_sigma: float | None
    view: NDArray[np.intp]
    turned: TurnedMatches | None = None

    def __getitem__(self, rows: NDArray[np.bool_]) -> "DepthProblem":
        count = len(self.seen)
        turned = None if self.turned is None else self.turned[rows[count:]]
        seen, centre = self.seen[rows[:count]], self.reference_centre[rows[:count]]
        return replace(self, seen=seen, reference_centre=centre, view=self.view[rows], turned=turned)

    def inliers(self, distance: Array) -> NDArray[np.bool_]:
        """Mask (M,) of the inliers, by their distances in standard deviations."""
        near = distance < AGREEING_SIGMA
        if self.turned is None:
            return near
        return np.asarray(near & (np.bincount(self.view, near)[self.view] >= MIN_INLIERS))

    def points(self, solved: "DepthSolution") -> Array:
        """The points (M, 3) in the world."""
        if self.turned is None:
            return self.seen.x_in_world
        own = self.turned.in_world(solved.world_from_camera, solved.log_factor)
        return np.concatenate([self.seen.x_in_world, own])


@dataclass(frozen=True, eq=False)
class DepthSolution:
    """A pose with its inliers (M,), their whitened errors (M,), pixels, and the errors of keypoints and depths.

    `log_factor` is what the query's depths are multiplied by.
    """

    world_from_camera: RigidTransform
    inliers: NDArray[np.bool_]
    errors_px: Array
    sigma_px: float
    depth_sigma: float
    log_factor: float = 0.0


def linearize(problem: DepthProblem, world_from_camera: RigidTransform, log_factor: float = 0.0) -> Rows:
    """The residuals of all matches at a pose."""
    rows, turned = _linearize_seen(problem, world_from_camera), problem.turned
    if turned is None:
        return rows
    return rows.and_last(turned.linearize(world_from_camera, log_factor))


def _linearize_seen(problem: DepthProblem, world_from_camera: RigidTransform) -> Rows:
    camera, camera_from_world = problem.seen.camera, world_from_camera.inverse()
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    x = camera_from_world.apply(problem.seen.x_in_world)
    in_front = x[:, 2] > 1e-6
    x = np.where(in_front[:, None], x, [0.0, 0.0, 1.0])
    projection = normalize_jacobian(x) * focal[:, None]
    residual = np.where(in_front[:, None], camera.project(x) - problem.seen.pixels, BEHIND_PX)
    along = (problem.seen.x_in_world - problem.reference_centre) @ camera_from_world.rotation.T
    by_depth = np.einsum("mij,mj->mi", projection, along)
    return Rows(residual, projection @ motion_jacobian(x), np.where(in_front[:, None], by_depth, 0.0), in_front)


def _distances(rows: Rows, sigma_px: float, depth_sigma: float) -> Array:
    """Lengths (M,) of the residuals, in standard deviations."""
    information = rows.information(sigma_px, depth_sigma)
    squared = np.einsum("mi,mij,mj->m", rows.residual, information, rows.residual)
    return np.asarray(np.where(rows.in_front, np.sqrt(np.maximum(squared, 0)), np.inf))


def solve(problem: DepthProblem, initial: RigidTransform | None) -> DepthSolution | None:
    """Refines the candidate with the most inliers: the given pose, or one of RANSAC at two thresholds."""

    def inlier_count(pose: RigidTransform) -> int:
        distance = _distances(linearize(problem, pose), FIRST_SIGMA_PX, FIRST_DEPTH_SIGMA)
        return int((distance < AGREEING_SIGMA).sum())

    found, options = list[RigidTransform | None](), [PnpOptions(), PnpOptions(inlier_px=16.0)]
    if len(problem.seen) >= MIN_MATCHES:
        found += [ransac(problem.seen, initial, it) for it in options]
    if problem.turned is not None and len(problem.turned) >= MIN_MATCHES:
        found += [problem.turned.ransac(it) for it in options]
    candidates = [pose for pose in (initial, *found) if pose]
    return _refine(problem, max(candidates, key=inlier_count)) if candidates else None


def _refine(problem: DepthProblem, pose: RigidTransform) -> DepthSolution:
    """Refines a pose by Gauss-Newton with a Cauchy loss, and estimates both errors from the inliers.

    Not by `minimize`: the errors, and with them the cost, change after each step.
    """
    sigma_px, depth_sigma, log_factor = FIRST_SIGMA_PX, FIRST_DEPTH_SIGMA, 0.0
    for iteration in range(ITERATIONS):
        rows = linearize(problem, pose, log_factor)
        distance = _distances(rows, sigma_px, depth_sigma)
        information = rows.information(sigma_px, depth_sigma) * cauchy_weight(distance**2, 2.0)[:, None, None]
        if problem.turned is not None:
            information *= problem.inliers(distance)[:, None, None]
        hessian = np.einsum("mia,mij,mjb->ab", rows.by_pose, information, rows.by_pose)
        gradient = np.einsum("mia,mij,mj->a", rows.by_pose, information, rows.residual)
        if problem.turned is not None:
            hessian[6, 6] += problem.turned.common_sigma**-2
            gradient[6] += log_factor * problem.turned.common_sigma**-2
        step = solve_step(hessian, gradient, least_norm=True)
        if step is None:
            break
        pose = perturbed(pose.inverse(), step[:6]).inverse()
        log_factor += float(step[6]) if problem.turned is not None else 0.0
        inliers = problem.inliers(distance)
        if iteration >= 2 and inliers.sum() >= MIN_INLIERS:
            sigma_px, depth_sigma = noise(linearize(problem, pose, log_factor), inliers, problem.depth_sigma)
    distance = _distances(linearize(problem, pose, log_factor), sigma_px, depth_sigma)
    return DepthSolution(pose, problem.inliers(distance), distance * sigma_px, sigma_px, depth_sigma, log_factor)


def noise(rows: Rows, inliers: NDArray[np.bool_], stated_sigma: float | None) -> tuple[float, float]:
    """Standard deviations of keypoints across the epipolar lines, and of depths along them, at least as stated."""
    least = max(stated_sigma or 0.0, MIN_DEPTH_SIGMA)
    residual, by_depth = rows.residual[inliers], rows.by_depth[inliers]
    length = np.linalg.norm(by_depth, axis=1)
    direction = by_depth / np.maximum(length, 1e-9)[:, None]
    across = direction[:, 0] * residual[:, 1] - direction[:, 1] * residual[:, 0]
    sigma_px = max(MIN_SIGMA_PX, float(normal_sigma(across)))
    # Errors of depth show only where they move a projection by more than a keypoint errs.
    shows = length * MAX_DEPTH_SIGMA > AGREEING_SIGMA * sigma_px
    if shows.sum() < MIN_INLIERS:
        return sigma_px, min(least if stated_sigma else FIRST_DEPTH_SIGMA, MAX_DEPTH_SIGMA)
    along = (direction * residual).sum(axis=1)[shows]
    spread = float(normal_sigma(along / length[shows]))
    from_pixels = float(np.median(sigma_px / length[shows]))
    depth_sigma = float(np.sqrt(max(0.0, spread**2 - from_pixels**2)))
    return sigma_px, float(np.clip(depth_sigma, least, MAX_DEPTH_SIGMA))


def covariance_of_errors(problem: DepthProblem, solved: DepthSolution) -> Array:
    """Covariance (6, 6) in the world, without the parts of the factors that depths share."""
    covariance = world_covariance(_hessian(problem, solved)[:6, :6], solved.world_from_camera)
    covariance *= _shared(solved)
    factor = np.repeat([1.0, ROTATION_FACTOR], 3)
    return np.asarray(factor[:, None] * covariance * factor)


def _shared(solved: DepthSolution) -> float:
    """Factor on variances for what matches share."""
    return float(1 + solved.inliers.sum() / SHARED_MATCHES)


def _hessian(problem: DepthProblem, solved: DepthSolution) -> Array:
    """The information (U, U) of the inliers."""
    rows, information = _inlier_rows(problem, solved)
    return np.asarray(np.einsum("mia,mij,mjb->ab", rows.by_pose, information, rows.by_pose))


def _inlier_rows(problem: DepthProblem, solved: DepthSolution) -> tuple[Rows, Array]:
    """The residuals at a pose, and the information (M, 2, 2) of each; 0 if it is no inlier."""
    rows = linearize(problem, solved.world_from_camera, solved.log_factor)
    return rows, rows.information(solved.sigma_px, solved.depth_sigma) * solved.inliers[:, None, None]


def factor_covariance(
    problem: DepthProblem, turned: TurnedMatches, solved: DepthSolution, reference_sigmas: Sequence[float]
) -> Array:
    """Part (6, 6) of the covariance in the world by the factors of the query's depths, and of the references'.

    Those of the references, with these standard deviations (K,), are no unknowns. They have one sensor (see
    `kept_depth`), so they move the pose, and the query's factor within its prior, together.
    """
    (rows, information), hessian = _inlier_rows(problem, solved), _hessian(problem, solved)
    motion = -np.linalg.pinv(hessian[:6, :6], hermitian=True) @ hessian[:6, 6]
    of_factor = max(0.0, float(hessian[6, 6] + hessian[6, :6] @ motion)) / _shared(solved)
    of_factor += (excess_of(problem, solved) * turned.common_sigma) ** -2
    shares = np.where(np.arange(len(problem.view)) < len(problem.seen), np.take(reference_sigmas, problem.view), 0.0)
    gradient = np.einsum("mia,mij,mj->a", rows.by_pose, information, rows.by_depth * shares[:, None])
    hessian[6, 6] += turned.common_sigma**-2
    by_references = -np.linalg.pinv(hessian, hermitian=True) @ gradient
    moved = world_jacobian(solved.world_from_camera) @ np.stack(
        [motion / np.sqrt(of_factor), by_references[:6]], axis=1
    )
    return np.asarray(moved @ moved.T)


def excess_of(problem: DepthProblem, solved: DepthSolution) -> float:
    """Ratio of the depths' errors to those stated, at least 1; so much larger is what they share, too (Birge)."""
    return 1.0 if problem.depth_sigma is None else max(1.0, solved.depth_sigma / problem.depth_sigma)


def reference_covariance(problem: DepthProblem, solved: DepthSolution, reference_centre: Array) -> Array:
    """Covariance (6, 6) in the world by the errors of the reference's pose, with the sizes that are usual.

    Its own, and what its poses drift over the step (see `bundle.pose_problem`); the query's pose moves with it.
    """
    camera, pose = problem.seen.camera, solved.world_from_camera
    depth_m = float(np.median(pose.inverse().apply(problem.points(solved)[solved.inliers])[:, 2]))
    angle = solved.sigma_px / camera.focal_x_px * np.hypot(OWN_INFLATION * USUAL_OWN, DRIFT_INFLATION * USUAL_DRIFT)
    moved = np.eye(6)
    moved[:3, 3:] = cross_matrix(reference_centre - pose.translation)
    return np.asarray(moved * np.repeat([angle * depth_m, angle], 3) ** 2 @ moved.T)


def score_of(problem: DepthProblem, solved: DepthSolution) -> float:
    """-log10 of the expected number of poses with as many inliers among wrong matches.

    A wrong match agrees by chance if it falls into the ellipse of its residual.
    """
    if not solved.inliers.any():
        return -np.inf
    # Areas of the residuals' ellipses of one standard deviation, square pixels.
    by_depth = solved.depth_sigma * linearize(problem, solved.world_from_camera, solved.log_factor).by_depth
    along_px = np.sqrt(solved.sigma_px**2 + np.square(by_depth).sum(axis=1))
    areas = AGREEING_SIGMA**2 * (np.pi * solved.sigma_px * along_px)
    image = problem.seen.camera.width_px * problem.seen.camera.height_px
    chance = float(np.mean(np.minimum(areas / image, 1.0)))
    return -false_alarms(len(solved.inliers), int(solved.inliers.sum()), chance)
