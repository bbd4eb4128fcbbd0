"""The pose from a single reference, with depths in metres that a network predicts.

Nothing can be triangulated with one reference. Its matches with the photograph determine the rotation and the direction
of the step from one camera to the other; the length of the step follows from the predicted depths. Both are one
problem of six unknowns: each match is a point at its predicted depth, whose error moves its projection along the
epipolar line, so the covariance of a residual is

    sigma^2 I + s_d^2 j j^T,    j the derivative of the projection by the logarithm of the depth,

where sigma and s_d, the errors of keypoints and of single depths, are estimated from the residuals. An error that all
depths share, of the network's metre, changes no residual: it moves the camera along the step, and the covariance of the
pose contains it as s^2 d d^T, with d the step and s its relative standard deviation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, normalize_jacobian
from mapless_server.bounds import check_bounds

from ..bundle.dispersion import scale_covariance
from ..bundle.estimate import PosedSupport, PoseEstimate, PoseStage
from ..features.tracks import Tracks
from ..features.views import Matches, PosedView, Reconstruction, View
from ..optim.optimize import motion_jacobian, perturbed, world_covariance
from ..pairs.stationary import StationaryOptions, are_moved
from ..rejection import Rejection, RejectionReason
from ..structure.model import MetricScale, PixelPoints, PointMatches, Structure
from ..structure.observations import FIRST_GUESS
from .pnp import PnpOptions, false_alarms, ransac

MAD_TO_SIGMA = 1.4826
"""Of a normal distribution."""


@dataclass(frozen=True)
class OneReferenceOptions:
    """Options of the pose from one reference.

    Attributes:
        first_sigma_px, first_depth_sigma: initial values of the errors of keypoints, pixels, and of single depths,
            relative.
        min_sigma_px, min_depth_sigma: least values of these errors.
        max_depth_sigma: largest error of depth; with a larger one nearly every match would be an inlier along its
            epipolar line.
        inlier_sigma: largest residual of an inlier, in standard deviations.
        iterations: number of iterations of the estimation; the errors are estimated anew in each.
        min_inliers: fewer give no pose.
        shared_matches: largest number of matches over which errors average out that matches share, such as those of a
            lens or of the depths of one surface.
        rotation_factor: factor on standard deviations of the rotation. Poses from several references needed it with a
            covariance of this form; with one reference it is not measured.
    """

    first_sigma_px: float = 1.5
    first_depth_sigma: float = 0.1
    min_sigma_px: float = 0.5
    min_depth_sigma: float = 0.01
    max_depth_sigma: float = 0.3
    inlier_sigma: float = 3.0
    iterations: int = 12
    min_inliers: int = 12
    shared_matches: float = 20.0
    rotation_factor: float = 1.79

    def __post_init__(self) -> None:
        check_bounds(self, "min_sigma_px min_depth_sigma inlier_sigma iterations", above=0)
        check_bounds(self, "shared_matches rotation_factor", above=0)
        check_bounds(self, "first_sigma_px", at_least=self.min_sigma_px)
        check_bounds(self, "first_depth_sigma", at_least=self.min_depth_sigma, at_most=self.max_depth_sigma)
        check_bounds(self, "min_inliers", at_least=6)


@dataclass(frozen=True, eq=False)
class Found:
    """A pose from one reference.

    Attributes:
        support: support with the estimate; its points have their predicted depths.
        score: the larger, the less likely are so many inliers among wrong matches.
        moved_score: the same for those matches that are at other pixels than in the reference; see `judge.references`.
    """

    support: PosedSupport
    score: float
    moved_score: float


def solve_one_reference(
    query: View,
    references: Sequence[PosedView],
    reconstruction: Reconstruction,
    scale: MetricScale,
    query_matches: Sequence[Matches],
    origin: Array,
    options: OneReferenceOptions,
    stationary: StationaryOptions,
) -> Found | Rejection:
    """Estimates the pose of a query from its matches with a single reference.

    TOO_FEW_MATCHES or PNP_FAILED if there is none. The reconstruction has predicted depths; the scale is metres per
    unit of it, with the relative standard deviation; `origin` (3,) is that of the reference's world in the caller's
    world; `stationary` says what is at the same pixels.
    """
    (reference,), (matches,) = references, query_matches
    points = _predicted(reference, reconstruction, scale, matches)
    known = np.isfinite(points).all(axis=1)
    matches, points = matches[known], points[known]
    if len(matches) < options.min_inliers:
        message = f"{len(matches)} matches with a predicted depth, {options.min_inliers} needed with one reference"
        return Rejection(RejectionReason.TOO_FEW_MATCHES, message)
    seen = PixelPoints(query.camera, points, query.features.pixels(matches[:, 0]))
    problem = _Problem(seen, reference.world_from_camera.translation)
    solved = _solve(problem, scale.world_from_query, options)
    count = int(solved.inliers.sum())
    if count < options.min_inliers:
        message = f"no pose explains more than {count} of {len(matches)} matches, {options.min_inliers} needed"
        return Rejection(RejectionReason.PNP_FAILED, message)
    step = solved.world_from_camera
    covariance = _covariance(problem, solved, options)
    covariance += scale_covariance(step, reference.world_from_camera.translation, scale.relative_sigma)
    estimate = PoseEstimate(step, PoseStage.REFINED, solved.inliers, solved.errors_px, covariance)
    rows = np.arange(len(points))
    structure = Structure(
        points,
        Tracks(rows, np.zeros_like(rows), matches[:, 1].astype(np.intp)),
        replace(FIRST_GUESS, level_px=solved.sigma_px),
    )
    found = PointMatches(rows, matches[:, 0].astype(np.intp), np.zeros(len(rows), bool), 0.0)
    support = PosedSupport(query, tuple(references), structure, found, origin, estimate=estimate)
    moved = are_moved(query, reference, matches, matches, stationary)
    return Found(support, score_of(problem, solved, options), score_of(*_of_rows(problem, solved, moved), options))


@dataclass(frozen=True, eq=False)
class _Problem:
    """Points at predicted depths that the query sees, and the reference's centre (3,)."""

    seen: PixelPoints
    reference_centre: Array


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

    def areas(self, sigma_px: float, depth_sigma: float) -> Array:
        """Areas (M,) of the residuals' ellipses of one standard deviation, square pixels."""
        along_px = np.sqrt(sigma_px**2 + np.square(depth_sigma * self.by_depth).sum(axis=1))
        return np.asarray(np.pi * sigma_px * along_px)


def _of_rows(problem: _Problem, solved: _Solved, rows: NDArray[np.bool_]) -> tuple[_Problem, _Solved]:
    """The problem and its solution with some of the matches; `rows` is (M,)."""
    some = replace(problem, seen=problem.seen[rows])
    return some, replace(solved, inliers=solved.inliers[rows], errors_px=solved.errors_px[rows])


def _predicted(reference: PosedView, reconstruction: Reconstruction, scale: MetricScale, matches: Matches) -> Array:
    """Points (M, 3) in the world at the predicted depths of the reference's keypoints; NaN without a depth."""
    camera = reference.view.camera
    pixels = reference.view.features.pixels(matches[:, 1])
    depth = scale.metres_per_unit * reconstruction.references[0].depth_at(pixels, camera)
    rays = camera.rays(pixels)
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


def _solve(problem: _Problem, initial: RigidTransform, options: OneReferenceOptions) -> _Solved:
    """Refines the candidate with the most inliers: the network's own pose, or one of RANSAC at two thresholds."""
    candidates = [initial]
    for inlier_px in (4.0, 16.0):
        found = ransac(problem.seen, initial, PnpOptions(inlier_px=inlier_px))
        candidates += [found] if found else []
    return _refine(problem, max(candidates, key=lambda it: _inlier_count(problem, it, options)), options)


def _inlier_count(problem: _Problem, pose: RigidTransform, options: OneReferenceOptions) -> int:
    """Counts the inliers of a pose, at the initial errors of keypoints and depths."""
    distance = _distances(_linearize(problem, pose), options.first_sigma_px, options.first_depth_sigma)
    return int((distance < options.inlier_sigma).sum())


def _refine(problem: _Problem, pose: RigidTransform, options: OneReferenceOptions) -> _Solved:
    """Refines a pose by Gauss-Newton with a Cauchy loss, and estimates both errors from the inliers."""
    sigma_px, depth_sigma = options.first_sigma_px, options.first_depth_sigma
    for iteration in range(options.iterations):
        rows = _linearize(problem, pose)
        distance = _distances(rows, sigma_px, depth_sigma)
        weight = np.where(np.isfinite(distance), 1 / (1 + np.square(distance / 2)), 0.0)
        information = rows.information(sigma_px, depth_sigma) * weight[:, None, None]
        hessian = np.einsum("mia,mij,mjb->ab", rows.by_pose, information, rows.by_pose)
        gradient = np.einsum("mia,mij,mj->a", rows.by_pose, information, rows.residual)
        if not (np.isfinite(hessian).all() and np.isfinite(gradient).all()):
            break
        step = -np.linalg.pinv(hessian, hermitian=True) @ gradient
        pose = perturbed(pose.inverse(), step).inverse()
        inliers = distance < options.inlier_sigma
        if iteration >= 2 and inliers.sum() >= options.min_inliers:
            sigma_px, depth_sigma = _noise(_linearize(problem, pose), inliers, options)
    rows = _linearize(problem, pose)
    distance = _distances(rows, sigma_px, depth_sigma)
    return _Solved(pose, distance < options.inlier_sigma, distance * sigma_px, sigma_px, depth_sigma)


def _noise(rows: _Rows, inliers: NDArray[np.bool_], options: OneReferenceOptions) -> tuple[float, float]:
    """Standard deviations of keypoints across the epipolar lines, and of depths along them."""
    residual, by_depth = rows.residual[inliers], rows.by_depth[inliers]
    length = np.linalg.norm(by_depth, axis=1)
    direction = by_depth / np.maximum(length, 1e-9)[:, None]
    across = direction[:, 0] * residual[:, 1] - direction[:, 1] * residual[:, 0]
    sigma_px = max(options.min_sigma_px, MAD_TO_SIGMA * float(np.median(np.abs(across))))
    # Errors of depth show only where they move a projection by more than a keypoint errs.
    shows = length * options.max_depth_sigma > 3 * sigma_px
    if shows.sum() < options.min_inliers:
        return sigma_px, options.first_depth_sigma
    along = (direction * residual).sum(axis=1)[shows]
    spread = MAD_TO_SIGMA * float(np.median(np.abs(along / length[shows])))
    from_pixels = float(np.median(sigma_px / length[shows]))
    depth_sigma = float(np.sqrt(max(0.0, spread**2 - from_pixels**2)))
    return sigma_px, float(np.clip(depth_sigma, options.min_depth_sigma, options.max_depth_sigma))


def _covariance(problem: _Problem, solved: _Solved, options: OneReferenceOptions) -> Array:
    """Covariance (6, 6) in the world, without the part of the scale."""
    rows = _linearize(problem, solved.world_from_camera)
    information = rows.information(solved.sigma_px, solved.depth_sigma) * solved.inliers[:, None, None]
    hessian = np.einsum("mia,mij,mjb->ab", rows.by_pose, information, rows.by_pose)
    covariance = world_covariance(hessian, solved.world_from_camera)
    covariance *= 1 + solved.inliers.sum() / options.shared_matches
    factor = np.repeat([1.0, options.rotation_factor], 3)
    return np.asarray(factor[:, None] * covariance * factor)


def score_of(problem: _Problem, solved: _Solved, options: OneReferenceOptions) -> float:
    """-log10 of the expected number of poses with as many inliers among wrong matches.

    A wrong match agrees by chance if it falls into the ellipse of its residual.
    """
    if not solved.inliers.any():
        return -np.inf
    rows = _linearize(problem, solved.world_from_camera)
    areas = options.inlier_sigma**2 * rows.areas(solved.sigma_px, solved.depth_sigma)
    image = problem.seen.camera.width_px * problem.seen.camera.height_px
    chance = float(np.mean(np.minimum(areas / image, 1.0)))
    return -false_alarms(len(solved.inliers), int(solved.inliers.sum()), chance)
