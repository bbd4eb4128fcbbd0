"""The covariance of a pose.

The answer's covariance is that of world_from_camera in ROS's order (see `optimize`), and is the sum of

    references   the dispersion of the poses that leave out one reference each: errors of reference poses, lens models
                 and shutters, which all points of a reference share.
    regions      that of the regions of the photograph: noise of pixels, and whatever neighbouring matches share.
    scale        s^2 d d^T, d = camera centre - centroid of the references, s the relative uncertainty of the metric
                 scale, for poses that depend on the scale rather than on triangulated points: initial poses, and poses
                 from predicted points (`no_structure`). Otherwise the references' poses determine the scale, and their
                 errors are in the dispersion.
    depths       sum of v v^T, v the motion of the pose by one standard deviation of the factor that all depths of a
                 reference share, for points that have their depth from one (see `structure.kept_depth`).
    offset       o o^T, o the Gauss-Newton step from the pose to its optimum, for an initial pose that is answered as it
                 is.

The dispersion is how an adjusted pose changes without parts of its data: a sum over residuals would treat errors as
independent that matches share. The jackknife (Quenouille; Efron and Tibshirani 1993, chapter 11) finds what is shared
within each part of the data by leaving it out. Two kinds of parts cross each other (Cameron, Gelbach and Miller, Robust
inference with multiway clustering, 2011):

    references    from the poses q_(i) without the observations of reference i, i = 1 ... K,
                  C_r = (K - 1) / K sum_i (q_(i) - mean) (q_(i) - mean)^T;
    regions       of the photograph, with equally many matches each. One of them weighs little, so the change without it
                  is the sum of its matches' influences s_c (the infinitesimal jackknife), and
                  C_p = sum_c (s_c - mean) (s_c - mean)^T.

Both are of the pose as it is estimated: by the normal equations of the adjustment at its optimum (see `bundle`), where
the references may move and far ones are held less, and of which each q_(i) is one Newton step.

With K references the jackknife has K - 1 degrees of freedom: two that agree by chance, or because each without the
other determines little, have a small dispersion. So it is shrunk towards the covariance by the normal equations C_n,
whose noise and errors of poses are those that the residuals between the references show (see `pose_problem`),

    C = ((K - 1) (C_r + C_p) + v C_n) / (K - 1 + v),

the posterior mean of a covariance whose prior (inverse Wishart) is worth v references. It falls with the number of
references as C_n does, and is the dispersion where there are many.

What all matches share (one lens model, one survey) shows in neither, and what neighbouring references share in part:
where the references' errors drift, errors are larger than stated. Keypoints move with the viewpoint, for all references
to the same side: errors grow more than radii with the gap (see `estimate`), by which both are enlarged. Factors on the
standard deviations of positions and of angles remain; they are measured on scenes with known poses.

The step needs the curvature of the loss, which is less than its weight w: without a part of the data, residuals of the
others grow and lose weight, so the pose moves farther than with weights that stay. Cauchy's loss curves by w across a
residual and by w (2 w - 1) along it (Triggs et al. 2000), on average over the directions by w^2. So the equations are
those of weighted least squares with weights w^2 and residuals r / w, with the same gradient.

Let F F^T be what eliminating the points subtracts from the normal equations, F_p = E_p L_p^-T of point p, whose
information is L_p L_p^T; and l_p = L_p^-1 h_p, of its gradient. An observation with residual r, weight w and derivative
A by the point, with a = L_p^-1 A^T, then fits its point up to

    e = r - a^T l_p,    with the covariance    S = I / w - a^T a,

and leaving it out subtracts F_p a S^-1 a^T F_p^T from the matrix and adds F_p a S^-1 e to the gradient. So K steps cost
one product of matrices with two columns an observation, and no point is eliminated twice.

Errors of the query's intrinsics may be unknowns of the same equations. The poses q are those with the intrinsics as
they are; with the poses eliminated too, what is left says what the data and their parts know of the intrinsics (see
`intrinsics`).
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform
from mapless_server.bounds import check_bounds
from mapless_server.kernels import adjustment

from ..features.tracks import summed
from ..optim.optimize import LEAST_DAMPING, cauchy_weight, take, world_jacobian
from .bundle import BundleProblem
from .estimate import SUPPORTING_SHARE, gap_ratio
from .intrinsics import IntrinsicsEquations
from .normal_equations import Bundle, EliminatedPoints, ViewColumns, forward


@dataclass(frozen=True)
class UncertaintyOptions:
    """Options of the covariance.

    Attributes:
        region_factor: factor on the standard deviations of the regions' part: the fit of the pose hides a part of the
            errors that a region shares. Evidence: radii.
        position_factor, rotation_factor: factors on standard deviations. Below 1, because noise of a single keypoint
            is both in the references' part and in that of the regions. Evidence: radii.
        gap_growth: exponent of the gap in the factor on standard deviations. Larger ones make radii of the closest
            references too small.
        modelled_freedom: v, the references that the covariance by the normal equations is worth. Evidence:
            few-references.
        max_matches: largest number of the photograph's matches, evenly thinned; the time is linear in it.
    """

    region_factor: float = 1.5
    position_factor: float = 0.76
    rotation_factor: float = 0.78
    gap_growth: float = 0.1
    modelled_freedom: float = 1.0
    max_matches: int = 500

    def __post_init__(self) -> None:
        check_bounds(self, "region_factor position_factor rotation_factor max_matches", above=0)
        check_bounds(self, "gap_growth modelled_freedom", at_least=0)


LEAST_EIGENVALUE = 1e-7
"""Least eigenvalue of the pose's information with unit diagonal: below, the pose is not determined."""

LEAST_VARIANCE = 1e-12
"""Least variance in S, as a share of I / w, where its point has no other observation but rounding."""

LEAST_LEFT = 0.01
"""Share of the pose's information added to what is left without a reference, which may not determine a pose. Evidence:
references-left-out."""

REGIONS = 3
"""Columns of the photograph, and regions in each."""


@dataclass(frozen=True, eq=False)
class Dispersion:
    """Changes of a pose, as left perturbations (v, w) of camera_from_world.

    Attributes:
        references: (K, 6) change of the optimum without each reference's observations.
        regions: (G, 6) influence of the matches in each region of the photograph.
        offset: (6,) the Gauss-Newton step from the pose to the optimum.
        modelled: (6, 6) covariance by the normal equations, as if the modelled errors were all.
        observing_count: number of references that observe the points.
        gap: distance to the nearest reference that holds the pose, over the median depth of the points.
        intrinsics: evidence of the data about errors of the intrinsics; empty if the problem has not these unknowns.
        depths: (K, 6) motion by one standard deviation of the factor that a reference's depths share; empty without.
        by_motions: (6, 6 K) derivatives by left perturbations of the references' given poses.
    """

    references: Array
    regions: Array
    offset: Array
    modelled: Array
    observing_count: int
    gap: float
    intrinsics: IntrinsicsEquations
    depths: Array = field(default_factory=lambda: np.zeros((0, 6)))
    by_motions: Array = field(default_factory=lambda: np.zeros((6, 0)))

    def covariance(self, region_factor: float) -> Array:
        """Covariance C_r + f^2 C_p (6, 6)."""
        count = len(self.references)
        references = self.references - self.references.mean(axis=0)
        regions = region_factor * (self.regions - self.regions.mean(axis=0))
        return np.asarray((count - 1) / count * references.T @ references + regions.T @ regions)


def disperse(problem: BundleProblem, bundle: Bundle, max_matches: int, with_priors: bool = False) -> Dispersion | None:
    """Computes how the query's pose changes without parts of the data; None if all data do not determine it.

    The bundle is the optimum of the adjustment's problem, or near it; the problem's priors on the pose are used only
    `with_priors`. At most `max_matches` of the query's matches are used, evenly thinned: shared errors are the same in
    all of them.
    """
    seen, bundle, thinning = _thinned(problem.by_view, bundle, max_matches)
    there = seen.at(bundle)
    weight = cauchy_weight((there.residual**2).sum(axis=0), problem.loss_scale_sigma)
    residual, weight = there.residual / weight, weight**2
    equations = seen.equations(replace(there, residual=residual), problem.loss_scale_sigma, weight=weight)
    data, gradient, points = equations.reduced(LEAST_DAMPING)
    query, posed = problem.query_rows, slice(problem.query_rows.stop)
    prior, prior_gradient = _of_prior(problem, bundle, len(data), thinning, with_priors)
    to_pose = _rows_of_pose((data + prior)[posed, posed])
    if to_pose is None:
        return None

    matrices, gradients = _without_each(
        seen, data, gradient, points, *_whitened(seen, there.by_point, residual, weight, points)
    )
    matrices, gradients = prior + matrices, prior_gradient + gradients
    matrices[1:, query, query] += LEAST_LEFT * np.linalg.inv(to_pose[:, query])
    right = np.concatenate([matrices[:, posed, posed.stop :], gradients[:, posed, None]], axis=2)
    solved = np.linalg.solve(matrices[:, posed, posed], right)
    poses = -solved[:, query, -1]
    rest = np.concatenate([matrices[:, posed.stop :, posed.stop :], gradients[:, posed.stop :, None]], axis=2)
    rest -= matrices[:, posed.stop :, posed] @ solved  # of the intrinsics, with the poses eliminated

    to_rest = np.hstack([-solved[0, :, :-1].T, np.eye(len(data) - posed.stop)])
    regions = _regions(seen)
    to_both = np.vstack([np.hstack([-to_pose, np.zeros((6, len(to_rest)))]), to_rest])
    influences, known = _by_region(seen, regions, to_both, residual, there.by_pose, weight, points)
    if not (np.isfinite(poses).all() and np.isfinite(influences).all()):
        return None
    observing = [0, *(i + 1 for i, part in enumerate(seen.parts[:-1]) if part.start < part.stop)]
    intrinsics = IntrinsicsEquations(
        thinning * rest[observing, :, :-1],
        thinning * rest[observing, :, -1],
        thinning * known,
        thinning * influences[:, 6:],
        world_jacobian(bundle.world_from_query) @ -solved[0, query, :-1],
    )
    return Dispersion(
        poses[1:] - poses[0],
        influences[:, :6],
        poses[0],
        to_pose[:, query] / thinning,
        len(observing) - 1,
        _gap(seen, bundle),
        intrinsics,
        _by_depths(seen, to_pose, points),
        to_pose[:, : query.start] @ prior[: query.start, : query.start],
    )


def _of_prior(
    problem: BundleProblem, bundle: Bundle, size: int, thinning: int, with_priors: bool
) -> tuple[Array, Array]:
    """Matrix (U, U) and gradient (U,) of what is known of the references' poses, and of the query's `with_priors`."""
    query, held = problem.query_rows, slice(problem.query_rows.start)
    prior, gradient = np.zeros((size, size)), np.zeros(size)
    prior[held, held] = problem.information / thinning
    gradient[held] = prior[held, held] @ problem.reference_motion(bundle).ravel()
    if with_priors:
        of_priors, information = problem.of_priors(bundle.world_from_query)
        prior[query, query], gradient[query] = information / thinning, of_priors / thinning
    return prior, gradient


def dispersed_covariance(
    dispersion: Dispersion, world_from_camera: RigidTransform, options: UncertaintyOptions, is_offset: bool = False
) -> Array:
    """Covariance (6, 6) of a pose without the parts of scale and intrinsics, with the factors.

    `is_offset` is whether the pose is known not to be at the optimum.
    """
    factor, jacobian = (
        np.repeat([options.position_factor, options.rotation_factor], 3),
        world_jacobian(world_from_camera),
    )
    to_world = factor[:, None] * jacobian
    grown = gap_ratio(dispersion.gap) ** (2 * options.gap_growth)
    dispersed = to_world @ (grown * dispersion.covariance(options.region_factor)) @ to_world.T
    modelled = jacobian @ dispersion.modelled @ jacobian.T
    freedom, prior = max(dispersion.observing_count - 1, 0), options.modelled_freedom
    covariance = (freedom * dispersed + prior * modelled) / (freedom + prior)
    if is_offset:
        offset = to_world @ dispersion.offset
        covariance = covariance + np.outer(offset, offset)
    if len(dispersion.depths):
        by_depths = dispersion.depths @ jacobian.T
        covariance = covariance + by_depths.T @ by_depths
    return np.asarray((covariance + covariance.T) / 2)


def scale_covariance(world_from_camera: RigidTransform, centroid: Array, relative_sigma: float) -> Array:
    """s^2 d d^T as (6, 6), for a pose whose distance d from the references' centroid (3,) depends on the scale."""
    covariance = np.zeros((6, 6))
    arm = world_from_camera.translation - centroid
    covariance[:3, :3] = relative_sigma**2 * np.outer(arm, arm)
    return covariance


def _by_depths(seen: ViewColumns, to_pose: Array, points: EliminatedPoints) -> Array:
    """Motions (2 K, 6) of the pose by each standard deviation of errors that a reference's depths share; or none."""
    planes = seen.planes
    if planes is None:
        return np.zeros((0, 6))
    changes = [planes.normal.T * (planes.information * common) for common in planes.common.T]  # of -h
    eliminated = [np.stack(forward(points.factor, it)).ravel() for it in changes]
    return np.array([-to_pose @ (points.cross[: to_pose.shape[1]] @ it) for it in eliminated])


def _without_each(
    seen: ViewColumns, data: Array, gradient: Array, points: EliminatedPoints, gain: Array, misfit: Array
) -> tuple[Array, Array]:
    """Reduced equations (1 + V, U, U), (1 + V, U) of all observations, and of those without each of V references."""
    matrices, gradients = np.tile(data, (len(seen.parts), 1, 1)), np.tile(gradient, (len(seen.parts), 1))
    if adjustment.IS_COMPILED:
        its = seen.seen(points.factor.shape[1])
        adjustment.leave_each_out(its, gain, misfit, points.rows, matrices, gradients)
        return matrices, gradients
    count, end = len(data), seen.parts[-1].start
    # A row an observation, so that the block of its point is read from one place in memory.
    by_point = np.ascontiguousarray(points.cross.reshape(count, 3, -1).T)  # (P, 3, U)
    lost = np.ascontiguousarray(gain[:, :, :end].T) @ by_point[seen.point[:end]]  # (O, 2, U)
    misfit = np.ascontiguousarray(misfit.T)
    for i, part in enumerate(seen.parts[:-1]):
        its_own = lost[part].reshape(-1, count)
        matrices[i + 1] -= its_own.T @ its_own
        gradients[i + 1] += misfit[part].ravel() @ its_own
        pose = slice(6 * i, 6 * i + 6)  # only the prior is left of its own pose
        matrices[i + 1, pose], matrices[i + 1, :, pose], gradients[i + 1, pose] = 0, 0, 0
    return matrices, gradients


def _thinned(seen: ViewColumns, bundle: Bundle, max_matches: int) -> tuple[ViewColumns, Bundle, int]:
    """Keeps every n-th match of the query, with the other observations of its point, so that `max_matches` remain."""
    of_query = seen.point[seen.parts[-1]]
    thinning = -(-len(of_query) // max_matches)
    if thinning <= 1:
        return seen, bundle, 1
    chosen = np.zeros(len(bundle.points), bool)
    chosen[of_query[::thinning]] = True
    return seen.of_points(chosen), Bundle(bundle.poses, bundle.points[chosen], bundle.intrinsics), thinning


def _gap(seen: ViewColumns, bundle: Bundle) -> float:
    """Distance to the nearest reference that holds the pose, over the median depth of the points."""
    counts = np.array([part.stop - part.start for part in seen.parts[:-1]])
    centres, rotation, shift = bundle.poses.centres, bundle.poses.rotation[-1], bundle.poses.translation[-1]
    distances = np.linalg.norm(centres[:-1] - centres[-1], axis=1)[counts >= SUPPORTING_SHARE * counts.max()]
    return float(distances.min() / np.median(bundle.points @ rotation[2] + shift[2]))


def _rows_of_pose(matrix: Array) -> Array | None:
    """Rows (6, U) of the inverse for the query's pose; None if it is not well-conditioned and positive definite."""
    if not np.isfinite(matrix).all():
        return None
    try:
        rows = np.asarray(np.linalg.solve(matrix, np.eye(len(matrix))[:, -6:]).T)
    except np.linalg.LinAlgError:
        return None
    if not np.isfinite(rows[:, -6:]).all():
        return None
    information = np.linalg.pinv(rows[:, -6:], hermitian=True)
    unit = np.sqrt(np.diag(information).clip(min=0))  # whatever the units of the pose
    is_definite = unit.min() > 0 and np.linalg.eigvalsh(information / np.outer(unit, unit))[0] > LEAST_EIGENVALUE
    return rows if is_definite else None


def _regions(seen: ViewColumns) -> list[NDArray[np.intp]]:
    """The points of the matches in each region of the photograph."""
    query = seen.parts[-1]
    ideal, match = -seen.offset[:, query] / seen.focal[:, query], seen.point[query]
    columns = (
        match[rows[np.argsort(ideal[1, rows], kind="stable")]]
        for rows in np.array_split(np.argsort(ideal[0], kind="stable"), REGIONS)
    )
    return [it for column in columns for it in np.array_split(column, REGIONS)]


def _by_region(
    seen: ViewColumns,
    regions: Sequence[NDArray[np.intp]],
    rows: Array,
    residual: Array,
    by_pose: Array,
    weight: Array,
    points: EliminatedPoints,
) -> tuple[Array, Array]:
    """Each region's part of the gradient (G, R) in combinations (R, U) of the unknowns, and of the matrix (G, I, I).

    The points are eliminated; the matrix is in the last I combinations, of the intrinsics.
    """
    *references, query = seen.parts
    slopes = [rows[:, 6 * i : 6 * i + 6] @ by_pose[:, :, part] for i, part in enumerate(references)]
    by_query = by_pose[:, :, query]
    if seen.by_intrinsics.size:
        by_query = np.concatenate([by_query, seen.by_intrinsics], axis=1)
    slopes.append(rows[:, 6 * len(references) :] @ by_query)
    of_observation = np.concatenate(slopes, axis=2)  # (2, R, O)
    lost = (rows @ points.cross).reshape(len(rows), *points.gradient.shape)
    of_match = summed(seen.sums, (of_observation * (weight * residual)[:, None]).sum(axis=0))
    of_match -= (lost * points.gradient).sum(axis=1)
    member = np.zeros((lost.shape[2], len(regions)))  # 1 where a point is of a region
    for i, it in enumerate(regions):
        member[it, i] = 1
    of_observation, lost = of_observation[:, 6:] * np.sqrt(weight), lost[6:]
    kept, gone = np.einsum("aio,ajo->ijo", of_observation, of_observation), np.einsum("iap,jap->ijp", lost, lost)
    squares = np.tensordot(kept, member[seen.point], 1) - np.tensordot(gone, member, 1)
    return (of_match @ member).T, np.moveaxis(squares, 2, 0)


def _whitened(
    seen: ViewColumns, by_point: Array, residual: Array, weight: Array, points: EliminatedPoints
) -> tuple[Array, Array]:
    """For each observation, a R^-T (3, 2, O) and R^-1 e (2, O), with S = R R^T."""
    across = np.stack(forward(take(points.factor, seen.point), np.swapaxes(by_point, 0, 1)))
    misfit = residual - (across * take(points.gradient, seen.point)[:, None]).sum(axis=0)
    least = LEAST_VARIANCE / weight
    (xx, yy), xy = 1 / weight - (across**2).sum(axis=0), -(across[:, 0] * across[:, 1]).sum(axis=0)
    first = np.sqrt(np.maximum(xx, least))
    mixed = xy / first
    second = np.sqrt(np.maximum(yy - mixed**2, least))

    def whitened(x: Array, y: Array) -> list[Array]:
        return [x / first, (y - mixed * x / first) / second]

    return np.stack(whitened(across[:, 0], across[:, 1]), axis=1), np.stack(whitened(*misfit))
