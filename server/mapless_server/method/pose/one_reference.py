"""The pose from matches with depths, which a sensor measured or a network predicts: one reference is enough.

The matches with one reference determine the rotation and the direction of the step from one camera to the other; the
length of the step follows from the depths. Both are one problem of six unknowns: each match is a point at its depth,
whose error moves its projection along the epipolar line, so the covariance of a residual is

    sigma^2 I + s_d^2 j j^T,    j the derivative of the projection by the logarithm of the depth,

where sigma and s_d, the errors of keypoints and of single depths, are estimated from the residuals. Those of depths are
at least as stated, and as stated where the step is too small to show them. An error that all depths share, of the
sensor's or the network's metre, changes no residual: it moves the camera along the step, and the covariance of the pose
contains it as s^2 d d^T, with d the step and s its relative standard deviation. Neither do errors of the reference's
pose, whose usual size the covariance contains.

A match whose reference has no depth is a point of the photograph's own depth, in the photograph's frame, that the
reference sees: the same problem turned around. The factor that these depths share is an unknown with its prior, since
several references, or depths of both sides, show it. The scene's unit remains that of the references' poses. A few
matches that agree by chance would give the factor any value, so only references with enough inliers for a pose count.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, cross_matrix, normalize_jacobian

from ..bundle.dispersion import scale_covariance
from ..bundle.estimate import PosedSupport, PoseEstimate, PoseStage
from ..bundle.pose_problem import DRIFT_INFLATION, OWN_INFLATION, USUAL_DRIFT, USUAL_OWN
from ..features.tracks import Tracks
from ..features.views import Matches, PosedView, View
from ..optim.optimize import (
    MAD_TO_SIGMA,
    cauchy_weight,
    motion_jacobian,
    perturbed,
    solve_step,
    world_covariance,
    world_jacobian,
)
from ..pairs.stationary import StationaryOptions, are_moved
from ..rejection import Rejection, RejectionReason
from ..structure.model import DepthPlanes, PixelPoints, PointMatches, Structure
from ..structure.observations import FIRST_GUESS
from .pnp import MIN_MATCHES, PnpOptions, false_alarms, ransac
from .turned import BEHIND_PX, Rows, TurnedMatches

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
        own_covariance: (6, 6) by the errors that the matches show: without those that depths share, or may have.
        excess: ratio of the depths' errors, by the residuals, to those stated; at least 1.
        carried: points of V matches, each by its own reference alone; those of several references may contradict.
        carried_view: (V,) index of the reference of each.
        carried_keypoint: (V,) index of the query's keypoint of each; several references may share it.
    """

    support: PosedSupport
    score: float
    moved_score: float
    own_covariance: Array
    excess: float
    carried: PixelPoints
    carried_view: NDArray[np.intp]
    carried_keypoint: NDArray[np.intp]


def solve_by_depths(
    query: View,
    references: Sequence[PosedView],
    query_matches: Sequence[Matches],
    depths: Sequence[MatchedDepths],
    initial: RigidTransform | None,
    origin: Array,
    stationary: StationaryOptions,
) -> Found | Rejection:
    """Estimates the pose of a query from its matches (M, 2) with references, one or more, of which a side has a depth.

    TOO_FEW_MATCHES or PNP_FAILED if there is none. `depths` are those of the references' keypoints that the matches
    have; the query's own, if any, make the points of the other matches. `initial` is a pose to begin with; `origin`
    (3,) is that of the references' world in the caller's world; `stationary` says what is at the same pixels.
    """
    problem, view, matches = _problem_of(query, references, query_matches, depths)
    if len(matches) < MIN_INLIERS:
        message = f"{len(matches)} matches with a depth, {MIN_INLIERS} needed with one reference"
        return Rejection(RejectionReason.TOO_FEW_MATCHES, message)
    solved = _solve(problem, initial)
    count = 0 if solved is None else int(solved.inliers.sum())
    if solved is None or count < MIN_INLIERS:
        message = f"no pose explains more than {count} of {len(matches)} matches, {MIN_INLIERS} needed"
        return Rejection(RejectionReason.PNP_FAILED, message)
    pose = solved.world_from_camera
    nearest = int(np.bincount(view[solved.inliers], minlength=len(references)).argmax())
    centre = references[nearest].world_from_camera.translation
    covariance = _covariance(problem, solved) + _reference_covariance(problem, solved, centre)
    if problem.turned is None:
        covariance += scale_covariance(pose, centre, depths[nearest].common_sigma)
    else:
        covariance += _factor_covariance(problem, problem.turned, solved, [it.common_sigma for it in depths])
    _, shown_sigma = _noise(_linearize(problem, pose, solved.log_factor), solved.inliers, None)
    as_shown = replace(solved, depth_sigma=min(solved.depth_sigma, shown_sigma))
    own = _covariance(problem, as_shown) + _reference_covariance(problem, solved, centre)
    estimate = PoseEstimate(pose, PoseStage.REFINED, solved.inliers, solved.errors_px, covariance)
    rows = np.arange(len(matches))
    structure = Structure(
        problem.points(solved),
        Tracks(rows, view, matches[:, 1].astype(np.intp)),
        replace(FIRST_GUESS, level_px=solved.sigma_px),
        None if problem.depth_sigma is None else _planes(problem, solved, references, view, depths),
    )
    found = PointMatches(rows, matches[:, 0].astype(np.intp), np.zeros(len(rows), bool), 0.0)
    used = tuple(matches[view == i] for i in range(len(references)))
    support = PosedSupport(query, tuple(references), structure, found, origin, used, estimate=estimate)
    moved = np.ones(len(matches), bool)
    for i, (reference, its) in enumerate(zip(references, used, strict=True)):
        moved[view == i] = are_moved(query, reference, its, its, stationary)
    some = replace(solved, inliers=solved.inliers[moved], errors_px=solved.errors_px[moved])
    excess = _excess(problem, solved)
    carried = _carried(query, references, query_matches, depths, solved.log_factor)
    return Found(support, score_of(problem, solved), score_of(problem[moved], some), own, excess, *carried)


@dataclass(frozen=True, eq=False)
class _Problem:
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

    def __getitem__(self, rows: NDArray[np.bool_]) -> "_Problem":
        count = len(self.seen)
        turned = None if self.turned is None else self.turned[rows[count:]]
        seen, centre = self.seen[rows[:count]], self.reference_centre[rows[:count]]
        return replace(self, seen=seen, reference_centre=centre, view=self.view[rows], turned=turned)

    def inliers(self, distance: Array) -> NDArray[np.bool_]:
        """Mask (M,) of the inliers, by their distances in standard deviations."""
        near = distance < INLIER_SIGMA
        if self.turned is None:
            return near
        return np.asarray(near & (np.bincount(self.view, near)[self.view] >= MIN_INLIERS))

    def points(self, solved: "_Solved") -> Array:
        """The points (M, 3) in the world."""
        if self.turned is None:
            return self.seen.x_in_world
        own = self.turned.in_world(solved.world_from_camera, solved.log_factor)
        return np.concatenate([self.seen.x_in_world, own])


@dataclass(frozen=True, eq=False)
class _Solved:
    """A pose with its inliers (M,), their whitened errors (M,), pixels, and the errors of keypoints and depths.

    `log_factor` is what the query's depths are multiplied by.
    """

    world_from_camera: RigidTransform
    inliers: NDArray[np.bool_]
    errors_px: Array
    sigma_px: float
    depth_sigma: float
    log_factor: float = 0.0


def _problem_of(
    query: View,
    references: Sequence[PosedView],
    query_matches: Sequence[Matches],
    depths: Sequence[MatchedDepths],
) -> tuple[_Problem, NDArray[np.intp], Matches]:
    """The problem of the matches with a depth, with the index (M,) of each one's reference, and the matches (M, 2).

    A keypoint has one point at most by depths of references: that of the reference with most matches with a depth.
    """
    view, matches, points = _all_points(references, query_matches, depths)
    known: NDArray[np.bool_] = np.asarray(np.isfinite(points).all(axis=1))
    stated = [it.sigma for it in depths if it.sigma is not None]
    sigma = float(np.median(stated)) if len(stated) > 1 else next(iter(stated), None)
    centres = np.array([it.world_from_camera.translation for it in references])
    own = np.zeros_like(known)
    if query.depths is not None:
        own = ~known & np.isfinite(query.depths.depth[matches[:, 0]])
    counts, keys = np.bincount(view[known], minlength=len(references)), [it.key for it in references]
    rank = np.argsort(sorted(range(len(references)), key=lambda i: (-counts[i], keys[i])))
    at = np.flatnonzero(known)
    at = at[np.argsort(rank[view[at]], kind="stable")]
    known[np.delete(at, np.unique(matches[at, 0], return_index=True)[1])] = False
    seen = PixelPoints(query.camera, points[known], query.features.pixels(matches[known, 0]))
    problem = _Problem(seen, centres[view[known]], sigma, view[known])
    if query.depths is None or not own.any():
        return problem, view[known], matches[known]
    turned = TurnedMatches.of(query, query.depths, references, view[own], matches[own])
    sigma, view = turned.depth_sigma if sigma is None else sigma, np.concatenate([view[known], view[own]])
    problem = replace(problem, depth_sigma=sigma, view=view, turned=turned)
    return problem, view, np.concatenate([matches[known], matches[own]])


def _all_points(
    references: Sequence[PosedView], query_matches: Sequence[Matches], depths: Sequence[MatchedDepths]
) -> tuple[NDArray[np.intp], Matches, Array]:
    """All matches (V, 2), the index (V,) of each one's reference, and its point (V, 3) by the depth of that."""
    view = np.repeat(np.arange(len(references)), [len(it) for it in query_matches])
    points = np.concatenate([_points(*it) for it in zip(references, depths, query_matches, strict=True)])
    return view, np.concatenate(query_matches), points


def _carried(
    query: View,
    references: Sequence[PosedView],
    query_matches: Sequence[Matches],
    depths: Sequence[MatchedDepths],
    log_factor: float,
) -> tuple[PixelPoints, NDArray[np.intp], NDArray[np.intp]]:
    """The matches carried to points by their own references alone, the reference (V,) and the keypoint (V,) of each.

    With the query's depths a reference alone has a pose among these, and so the depths of its own keypoints.
    """
    view, matches, points = _all_points(references, query_matches, depths)
    if query.depths is not None:
        own = ~np.isfinite(points).all(axis=1) & np.isfinite(query.depths.depth[matches[:, 0]])
        if own.any():
            turned = TurnedMatches.of(query, query.depths, references, view[own], matches[own])
            points[own] = turned.carried(log_factor)
    known = np.isfinite(points).all(axis=1)
    keypoint = matches[known, 0].astype(np.intp)
    return PixelPoints(query.camera, points[known], query.features.pixels(keypoint)), view[known], keypoint


def _points(reference: PosedView, depths: MatchedDepths, matches: Matches) -> Array:
    """Points (M, 3) in the world at the depths (M,) of the reference's keypoints; NaN without a depth."""
    rays, depth = reference.view.camera.rays(reference.view.features.pixels(matches[:, 1])), depths.depth
    points = rays / rays[:, 2:] * np.where(depth > 0, depth, np.nan)[:, None]
    return np.asarray(reference.world_from_camera.apply(points))


def _planes(
    problem: _Problem,
    solved: _Solved,
    references: Sequence[PosedView],
    view: NDArray[np.intp],
    depths: Sequence[MatchedDepths],
) -> DepthPlanes:
    """Planes of the points at the references' depths; those at the query's are near none."""
    count = len(problem.seen)
    normal = np.array([it.world_from_camera.rotation[:, 2] for it in references])[view[:count]]
    depth = (normal * (problem.seen.x_in_world - problem.reference_centre)).sum(axis=1)
    offset = depth + (normal * problem.reference_centre).sum(axis=1)
    common = np.zeros((count, 2))
    common[:, 0] = np.array([it.common_sigma for it in depths])[view[:count]] * depth
    planes = DepthPlanes(normal, offset, (solved.depth_sigma * depth) ** -2.0, view[:count], common)
    return planes.and_last(DepthPlanes.unknown(len(view) - count))


def _linearize(problem: _Problem, world_from_camera: RigidTransform, log_factor: float = 0.0) -> Rows:
    """The residuals of all matches at a pose."""
    rows, turned = _linearize_seen(problem, world_from_camera), problem.turned
    if turned is None:
        return rows
    return rows.and_last(turned.linearize(world_from_camera, log_factor))


def _linearize_seen(problem: _Problem, world_from_camera: RigidTransform) -> Rows:
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


def _solve(problem: _Problem, initial: RigidTransform | None) -> _Solved | None:
    """Refines the candidate with the most inliers: the given pose, or one of RANSAC at two thresholds."""

    def inlier_count(pose: RigidTransform) -> int:
        distance = _distances(_linearize(problem, pose), FIRST_SIGMA_PX, FIRST_DEPTH_SIGMA)
        return int((distance < INLIER_SIGMA).sum())

    found, options = list[RigidTransform | None](), [PnpOptions(inlier_px=inlier_px) for inlier_px in (4.0, 16.0)]
    if len(problem.seen) >= MIN_MATCHES:
        found += [ransac(problem.seen, initial, it) for it in options]
    if problem.turned is not None and len(problem.turned) >= MIN_MATCHES:
        found += [problem.turned.ransac(it) for it in options]
    candidates = [pose for pose in (initial, *found) if pose]
    return _refine(problem, max(candidates, key=inlier_count)) if candidates else None


def _refine(problem: _Problem, pose: RigidTransform) -> _Solved:
    """Refines a pose by Gauss-Newton with a Cauchy loss, and estimates both errors from the inliers.

    Not by `minimize`: the errors, and with them the cost, change after each step.
    """
    sigma_px, depth_sigma, log_factor = FIRST_SIGMA_PX, FIRST_DEPTH_SIGMA, 0.0
    for iteration in range(ITERATIONS):
        rows = _linearize(problem, pose, log_factor)
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
            sigma_px, depth_sigma = _noise(_linearize(problem, pose, log_factor), inliers, problem.depth_sigma)
    distance = _distances(_linearize(problem, pose, log_factor), sigma_px, depth_sigma)
    return _Solved(pose, problem.inliers(distance), distance * sigma_px, sigma_px, depth_sigma, log_factor)


def _noise(rows: Rows, inliers: NDArray[np.bool_], stated_sigma: float | None) -> tuple[float, float]:
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
    """Covariance (6, 6) in the world, without the parts of the factors that depths share."""
    covariance = world_covariance(_hessian(problem, solved)[:6, :6], solved.world_from_camera)
    covariance *= _shared(solved)
    factor = np.repeat([1.0, ROTATION_FACTOR], 3)
    return np.asarray(factor[:, None] * covariance * factor)


def _shared(solved: _Solved) -> float:
    """Factor on variances for what matches share."""
    return float(1 + solved.inliers.sum() / SHARED_MATCHES)


def _hessian(problem: _Problem, solved: _Solved) -> Array:
    """The information (U, U) of the inliers."""
    rows, information = _inlier_rows(problem, solved)
    return np.asarray(np.einsum("mia,mij,mjb->ab", rows.by_pose, information, rows.by_pose))


def _inlier_rows(problem: _Problem, solved: _Solved) -> tuple[Rows, Array]:
    """The residuals at a pose, and the information (M, 2, 2) of each; 0 if it is no inlier."""
    rows = _linearize(problem, solved.world_from_camera, solved.log_factor)
    return rows, rows.information(solved.sigma_px, solved.depth_sigma) * solved.inliers[:, None, None]


def _factor_covariance(
    problem: _Problem, turned: TurnedMatches, solved: _Solved, reference_sigmas: Sequence[float]
) -> Array:
    """Part (6, 6) of the covariance in the world by the factors of the query's depths, and of the references'.

    Those of the references, with these standard deviations (K,), are no unknowns. They have one sensor (see
    `kept_depth`), so they move the pose, and the query's factor within its prior, together.
    """
    (rows, information), hessian = _inlier_rows(problem, solved), _hessian(problem, solved)
    motion = -np.linalg.pinv(hessian[:6, :6], hermitian=True) @ hessian[:6, 6]
    of_factor = max(0.0, float(hessian[6, 6] + hessian[6, :6] @ motion)) / _shared(solved)
    of_factor += (_excess(problem, solved) * turned.common_sigma) ** -2
    shares = np.where(np.arange(len(problem.view)) < len(problem.seen), np.take(reference_sigmas, problem.view), 0.0)
    gradient = np.einsum("mia,mij,mj->a", rows.by_pose, information, rows.by_depth * shares[:, None])
    hessian[6, 6] += turned.common_sigma**-2
    by_references = -np.linalg.pinv(hessian, hermitian=True) @ gradient
    moved = world_jacobian(solved.world_from_camera) @ np.stack(
        [motion / np.sqrt(of_factor), by_references[:6]], axis=1
    )
    return np.asarray(moved @ moved.T)


def _excess(problem: _Problem, solved: _Solved) -> float:
    """Ratio of the depths' errors to those stated, at least 1; so much larger is what they share, too (Birge)."""
    return 1.0 if problem.depth_sigma is None else max(1.0, solved.depth_sigma / problem.depth_sigma)


def _reference_covariance(problem: _Problem, solved: _Solved, reference_centre: Array) -> Array:
    """Covariance (6, 6) in the world by the errors of the reference's pose, with the sizes that are usual.

    Its own, and what its poses drift over the step (see `bundle.pose_problem`); the query's pose moves with it.
    """
    camera, pose = problem.seen.camera, solved.world_from_camera
    depth_m = float(np.median(pose.inverse().apply(problem.points(solved)[solved.inliers])[:, 2]))
    angle = solved.sigma_px / camera.focal_x_px * np.hypot(OWN_INFLATION * USUAL_OWN, DRIFT_INFLATION * USUAL_DRIFT)
    moved = np.eye(6)
    moved[:3, 3:] = cross_matrix(reference_centre - pose.translation)
    return np.asarray(moved * np.repeat([angle * depth_m, angle], 3) ** 2 @ moved.T)


def score_of(problem: _Problem, solved: _Solved) -> float:
    """-log10 of the expected number of poses with as many inliers among wrong matches.

    A wrong match agrees by chance if it falls into the ellipse of its residual.
    """
    if not solved.inliers.any():
        return -np.inf
    # Areas of the residuals' ellipses of one standard deviation, square pixels.
    by_depth = solved.depth_sigma * _linearize(problem, solved.world_from_camera, solved.log_factor).by_depth
    along_px = np.sqrt(solved.sigma_px**2 + np.square(by_depth).sum(axis=1))
    areas = INLIER_SIGMA**2 * (np.pi * solved.sigma_px * along_px)
    image = problem.seen.camera.width_px * problem.seen.camera.height_px
    chance = float(np.mean(np.minimum(areas / image, 1.0)))
    return -false_alarms(len(solved.inliers), int(solved.inliers.sum()), chance)
