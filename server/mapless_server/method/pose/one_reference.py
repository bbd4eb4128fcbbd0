"""The pose from a single reference, with depths that a sensor measured or a network predicts.

The matches with one reference determine the rotation and the direction of the step from one camera to the other; the
length of the step follows from the depths. Both are one problem of six unknowns: each match is a point at its depth,
whose error moves its projection along the epipolar line, so the covariance of a residual is

    sigma^2 I + s_d^2 j j^T,    j the derivative of the projection by the logarithm of the depth,

where sigma and s_d, the errors of keypoints and of single depths, are estimated from the residuals. Those of depths are
at least as stated, and as stated where the step is too small to show them. An error that all depths share, of the
sensor's or the network's metre, changes no residual: it moves the camera along the step, and the covariance of the pose
contains it as s^2 d d^T, with d the step and s its relative standard deviation. Neither do errors of the reference's
pose, whose usual size the covariance contains.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, cross_matrix, normalize_jacobian

from ..bundle.dispersion import scale_covariance
from ..bundle.estimate import PosedSupport, PoseEstimate, PoseStage
from ..bundle.pose_problem import DRIFT_INFLATION, OWN_INFLATION, USUAL_DRIFT, USUAL_OWN
from ..features.tracks import Tracks
from ..features.views import Matches, PosedView, View
from ..optim.optimize import cauchy_weight, motion_jacobian, perturbed, solve_step, world_covariance
from ..pairs.stationary import StationaryOptions, are_moved
from ..rejection import Rejection, RejectionReason
from ..structure.model import PixelPoints, PointMatches, Structure
from ..structure.observations import FIRST_GUESS
from .pnp import PnpOptions, false_alarms, ransac

MAD_TO_SIGMA = 1.4826
"""Standard deviation of a normal distribution over its median absolute deviation."""

FIRST_SIGMA_PX, MIN_SIGMA_PX = 1.5, 0.5
"""Initial and least standard deviation of a keypoint."""

FIRST_DEPTH_SIGMA, MIN_DEPTH_SIGMA, MAX_DEPTH_SIGMA = 0.1, 0.01, 0.3
"""Initial, least and largest relative standard deviation of a depth; with a larger one nearly every match would be an
inlier along its epipolar line. The first is also that of a network, which does not state its own."""

INLIER_SIGMA = 3.0
"""Largest residual of an inlier, in standard deviations."""

ITERATIONS = 12
"""Steps of the estimation; errors of keypoints and depths are estimated anew in each."""

MIN_INLIERS = 12
"""Fewer give no pose."""

SHARED_MATCHES = 20.0
"""Matches over which errors average out that matches share, such as those of a lens or of the depths of one surface."""

ROTATION_FACTOR = 1.79
"""Factor on standard deviations of the rotation; not measured."""


@dataclass(frozen=True, eq=False)
class MatchedDepths:
    """Depths of the keypoints of a reference that M matches have.

    Attributes:
        depth: (M,) in the unit of the reference's pose; NaN where unknown.
        sigma: relative standard deviation of a depth; None if it is not stated.
        common_sigma: relative standard deviation of the factor that they share.
    """

    depth: Array
    sigma: float | None
    common_sigma: float


@dataclass(frozen=True, eq=False)
class Found:
    """A pose from one reference.

    Attributes:
        support: support with the estimate; its points have their depths.
        score: the larger, the less likely are so many inliers among wrong matches.
        moved_score: the same for those matches that are at other pixels than in the reference; see `judge.references`.
    """

    support: PosedSupport
    score: float
    moved_score: float


def solve_one_reference(
    query: View,
    reference: PosedView,
    matches: Matches,
    depths: MatchedDepths,
    initial: RigidTransform | None,
    origin: Array,
    stationary: StationaryOptions,
) -> Found | Rejection:
    """Estimates the pose of a query from its matches (M, 2) with a single reference.

    TOO_FEW_MATCHES or PNP_FAILED if there is none. `initial` is a pose to begin with; `origin` (3,) is that of the
    reference's world in the caller's world; `stationary` says what is at the same pixels.
    """
    points = _points(reference, depths.depth, matches)
    known = np.isfinite(points).all(axis=1)
    matches, points = matches[known], points[known]
    if len(matches) < MIN_INLIERS:
        message = f"{len(matches)} matches with a depth, {MIN_INLIERS} needed with one reference"
        return Rejection(RejectionReason.TOO_FEW_MATCHES, message)
    seen = PixelPoints(query.camera, points, query.features.pixels(matches[:, 0]))
    problem = _Problem(seen, reference.world_from_camera.translation, depths.sigma)
    solved = _solve(problem, initial)
    count = 0 if solved is None else int(solved.inliers.sum())
    if solved is None or count < MIN_INLIERS:
        message = f"no pose explains more than {count} of {len(matches)} matches, {MIN_INLIERS} needed"
        return Rejection(RejectionReason.PNP_FAILED, message)
    pose = solved.world_from_camera
    covariance = _covariance(problem, solved)
    covariance += _reference_covariance(problem, solved)
    covariance += scale_covariance(pose, reference.world_from_camera.translation, depths.common_sigma)
    estimate = PoseEstimate(pose, PoseStage.REFINED, solved.inliers, solved.errors_px, covariance)
    rows = np.arange(len(points))
    structure = Structure(
        points,
        Tracks(rows, np.zeros_like(rows), matches[:, 1].astype(np.intp)),
        replace(FIRST_GUESS, level_px=solved.sigma_px),
    )
    found = PointMatches(rows, matches[:, 0].astype(np.intp), np.zeros(len(rows), bool), 0.0)
    support = PosedSupport(query, (reference,), structure, found, origin, (matches,), estimate=estimate)
    moved = are_moved(query, reference, matches, matches, stationary)
    some = replace(solved, inliers=solved.inliers[moved], errors_px=solved.errors_px[moved])
    moved_score = score_of(replace(problem, seen=problem.seen[moved]), some)
    return Found(support, score_of(problem, solved), moved_score)


@dataclass(frozen=True, eq=False)
class _Problem:
    """Points at their depths that the query sees, the reference's centre (3,), and the stated error of a depth."""

    seen: PixelPoints
    reference_centre: Array
    depth_sigma: float | None


@dataclass(frozen=True, eq=False)
class _Solved:
    """A pose with its inliers (M,), their whitened errors (M,), pixels, and the errors of keypoints and depths."""

    world_from_camera: RigidTransform
    inliers: NDArray[np.bool_]
    errors_px: Array
    sigma_px: float
    depth_sigma: float


@dataclass(frozen=True, eq=False)
class _Rows:
    """Residuals (M, 2), and their derivatives (M, 2, 6) by a left perturbation and (M, 2) by log depths."""

    residual: Array
    by_pose: Array
    by_depth: Array
    in_front: NDArray[np.bool_]

    def information(self, sigma_px: float, depth_sigma: float) -> Array:
        """Inverse covariances (M, 2, 2) of the residuals, in closed form: points beside the camera make them huge."""
        j = depth_sigma * self.by_depth
        share = j[:, :, None] * j[:, None, :] / (sigma_px**2 + np.square(j).sum(axis=1))[:, None, None]
        return np.asarray((np.eye(2) - share) / sigma_px**2)


def _points(reference: PosedView, depth: Array, matches: Matches) -> Array:
    """Points (M, 3) in the world at the depths (M,) of the reference's keypoints; NaN without a depth."""
    rays = reference.view.camera.rays(reference.view.features.pixels(matches[:, 1]))
    points = rays / rays[:, 2:] * np.where(depth > 0, depth, np.nan)[:, None]
    return np.asarray(reference.world_from_camera.apply(points))


def _linearize(problem: _Problem, world_from_camera: RigidTransform) -> _Rows:
    camera, camera_from_world = problem.seen.camera, world_from_camera.inverse()
    focal = np.array([camera.focal_x_px, camera.focal_y_px])
    x = camera_from_world.apply(problem.seen.x_in_world)
    in_front = x[:, 2] > 1e-6
    x = np.where(in_front[:, None], x, [0.0, 0.0, 1.0])
    projection = normalize_jacobian(x) * focal[:, None]
    residual = np.where(in_front[:, None], camera.project(x) - problem.seen.pixels, 1e6)
    along = (problem.seen.x_in_world - problem.reference_centre) @ camera_from_world.rotation.T
    by_depth = np.einsum("mij,mj->mi", projection, along)
    return _Rows(residual, projection @ motion_jacobian(x), np.where(in_front[:, None], by_depth, 0.0), in_front)


def _distances(rows: _Rows, sigma_px: float, depth_sigma: float) -> Array:
    """Lengths (M,) of the residuals, in standard deviations."""
    information = rows.information(sigma_px, depth_sigma)
    squared = np.einsum("mi,mij,mj->m", rows.residual, information, rows.residual)
    return np.asarray(np.where(rows.in_front, np.sqrt(np.maximum(squared, 0)), np.inf))


def _solve(problem: _Problem, initial: RigidTransform | None) -> _Solved | None:
    """Refines the candidate with the most inliers: the given pose, or one of RANSAC at two thresholds."""

    def inlier_count(pose: RigidTransform) -> int:
        distance = _distances(_linearize(problem, pose), FIRST_SIGMA_PX, FIRST_DEPTH_SIGMA)
        return int((distance < INLIER_SIGMA).sum())

    found = [ransac(problem.seen, initial, PnpOptions(inlier_px=inlier_px)) for inlier_px in (4.0, 16.0)]
    candidates = [pose for pose in (initial, *found) if pose]
    return _refine(problem, max(candidates, key=inlier_count)) if candidates else None


def _refine(problem: _Problem, pose: RigidTransform) -> _Solved:
    """Refines a pose by Gauss-Newton with a Cauchy loss, and estimates both errors from the inliers.

    Not by `minimize`: the errors, and with them the cost, change after each step.
    """
    sigma_px, depth_sigma = FIRST_SIGMA_PX, FIRST_DEPTH_SIGMA
    for iteration in range(ITERATIONS):
        rows = _linearize(problem, pose)
        distance = _distances(rows, sigma_px, depth_sigma)
        information = rows.information(sigma_px, depth_sigma) * cauchy_weight(distance**2, 2.0)[:, None, None]
        hessian = np.einsum("mia,mij,mjb->ab", rows.by_pose, information, rows.by_pose)
        gradient = np.einsum("mia,mij,mj->a", rows.by_pose, information, rows.residual)
        step = solve_step(hessian, gradient, least_norm=True)
        if step is None:
            break
        pose = perturbed(pose.inverse(), step).inverse()
        inliers = distance < INLIER_SIGMA
        if iteration >= 2 and inliers.sum() >= MIN_INLIERS:
            sigma_px, depth_sigma = _noise(_linearize(problem, pose), inliers, problem.depth_sigma)
    distance = _distances(_linearize(problem, pose), sigma_px, depth_sigma)
    return _Solved(pose, distance < INLIER_SIGMA, distance * sigma_px, sigma_px, depth_sigma)


def _noise(rows: _Rows, inliers: NDArray[np.bool_], stated_sigma: float | None) -> tuple[float, float]:
    """Standard deviations of keypoints across the epipolar lines, and of depths along them, at least as stated."""
    least = max(stated_sigma or 0.0, MIN_DEPTH_SIGMA)
    residual, by_depth = rows.residual[inliers], rows.by_depth[inliers]
    length = np.linalg.norm(by_depth, axis=1)
    direction = by_depth / np.maximum(length, 1e-9)[:, None]
    across = direction[:, 0] * residual[:, 1] - direction[:, 1] * residual[:, 0]
    sigma_px = max(MIN_SIGMA_PX, MAD_TO_SIGMA * float(np.median(np.abs(across))))
    # Errors of depth show only where they move a projection by more than a keypoint errs.
    shows = length * MAX_DEPTH_SIGMA > INLIER_SIGMA * sigma_px
    if shows.sum() < MIN_INLIERS:
        return sigma_px, min(least if stated_sigma else FIRST_DEPTH_SIGMA, MAX_DEPTH_SIGMA)
    along = (direction * residual).sum(axis=1)[shows]
    spread = MAD_TO_SIGMA * float(np.median(np.abs(along / length[shows])))
    from_pixels = float(np.median(sigma_px / length[shows]))
    depth_sigma = float(np.sqrt(max(0.0, spread**2 - from_pixels**2)))
    return sigma_px, float(np.clip(depth_sigma, least, MAX_DEPTH_SIGMA))


def _covariance(problem: _Problem, solved: _Solved) -> Array:
    """Covariance (6, 6) in the world, without the part of the scale."""
    rows = _linearize(problem, solved.world_from_camera)
    information = rows.information(solved.sigma_px, solved.depth_sigma) * solved.inliers[:, None, None]
    hessian = np.einsum("mia,mij,mjb->ab", rows.by_pose, information, rows.by_pose)
    covariance = world_covariance(hessian, solved.world_from_camera)
    covariance *= 1 + solved.inliers.sum() / SHARED_MATCHES
    factor = np.repeat([1.0, ROTATION_FACTOR], 3)
    return np.asarray(factor[:, None] * covariance * factor)


def _reference_covariance(problem: _Problem, solved: _Solved) -> Array:
    """Covariance (6, 6) in the world by the errors of the reference's pose, with the sizes that are usual.

    Its own, and what its poses drift over the step (see `bundle.pose_problem`); the query's pose moves with it.
    """
    camera, pose = problem.seen.camera, solved.world_from_camera
    depth_m = float(np.median(pose.inverse().apply(problem.seen.x_in_world[solved.inliers])[:, 2]))
    angle = solved.sigma_px / camera.focal_x_px * np.hypot(OWN_INFLATION * USUAL_OWN, DRIFT_INFLATION * USUAL_DRIFT)
    moved = np.eye(6)
    moved[:3, 3:] = cross_matrix(problem.reference_centre - pose.translation)
    return np.asarray(moved * np.repeat([angle * depth_m, angle], 3) ** 2 @ moved.T)


def score_of(problem: _Problem, solved: _Solved) -> float:
    """-log10 of the expected number of poses with as many inliers among wrong matches.

    A wrong match agrees by chance if it falls into the ellipse of its residual.
    """
    if not solved.inliers.any():
        return -np.inf
    # Areas of the residuals' ellipses of one standard deviation, square pixels.
    by_depth = solved.depth_sigma * _linearize(problem, solved.world_from_camera).by_depth
    along_px = np.sqrt(solved.sigma_px**2 + np.square(by_depth).sum(axis=1))
    areas = INLIER_SIGMA**2 * (np.pi * solved.sigma_px * along_px)
    image = problem.seen.camera.width_px * problem.seen.camera.height_px
    chance = float(np.mean(np.minimum(areas / image, 1.0)))
    return -false_alarms(len(solved.inliers), int(solved.inliers.sum()), chance)
