"""The problem that adjusts one query's pose, and the estimate at its optimum.

    min  sum_obs rho(|r_o|^2 / sigma_o^2) + xi^T C^-1 xi,

over the query's pose, its points and small motions xi of the references, which a prior holds to their given poses. Its
covariance C, by which neighbours move together and far references are held less, is found for each query from the
references' observations (below). The points are eliminated (see `bundle`).

A given pose has an error of its own (a marker, a surveyor's reading) and one that it shares with its neighbours and
that drifts with the distance (odometry, the lens model, the scale of a reconstruction). What counts are these errors
relative to the place of the query, x_q. The drift is a random walk over space, whose variance grows in proportion to
the distance (the linear variogram: Matheron, Principles of geostatistics, 1963). Errors i and j have the covariance

    C_ij = a^2 delta_ij + b^2 (|x_i - x_q| + |x_j - x_q| - |x_i - x_j|) / 2 d,

in units of the structure's noise in the image (a shift by depth / focal length, or a rotation by 1 / focal length, for
each pixel), where d is the median distance between two references that observe the points. So references near the query
hold it, far ones hold little, and several far ones that are neighbours no more than one of them. A reference whose pose
has an accuracy of its own, as one that mapless placed or adopted, adds what this states to C_ii (see `stated`).

The sizes a and b are the most probable ones under the observations of the references. At the given poses, with points
and query eliminated from the normal equations of the adjustment, the gradient g of the references' motions has the
covariance S + S C S, where S is the matrix. Where references share little, the prior of a and b decides.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform
from mapless.provenance import ADOPTED, Provenance
from mapless_server.bounds import check_bounds

from ..features.limits import INLIER_PX
from ..features.views import Matches, PosedView, View
from ..optim.optimize import LEAST_DAMPING, MinimizeOptions, columns, minimize
from ..structure.model import MIN_ADDED_SHARE, PointMatches, Structure
from ..structure.structure import StructureOptions, tracks_with_query
from .bundle import BundleProblem, free_problem
from .dispersion import UncertaintyOptions, disperse, dispersed_covariance
from .estimate import PoseEstimate, PoseStage, Support
from .intrinsics import ContradictionOptions, IntrinsicsEvidence, IntrinsicsTerms, intrinsics_evidence, keypoint_motion
from .normal_equations import Bundle, Linearized, NormalEquations, Poses
from .priors import IntrinsicsSigma
from .stated import common_covariance, stated_covariance

LEAST_EIGENVALUE = 1e-6
"""Directions with a smaller share of the largest eigenvalue are not observed: motions of the references as a whole."""
LEAST_SPACING = 0.05
"""Smallest d, as a share of the depth of the points: references at one place have no distance to measure drift by."""

OWN = (0.05, 0.1, 0.2, 0.4, 0.8, 1.6)
DRIFT = (0.1, 0.2, 0.4, 1.0, 2.0, 4.0)
"""Values of a and b that are tried, in units of the structure's noise."""
USUAL_OWN, USUAL_DRIFT, PRIOR_LOG = 0.1, 0.4, 1.5
"""Medians of the priors of a and b, log-normal and wide, and the standard deviation of their logarithms: ten references
determine both, three do not. Reconstructions are smooth, so without evidence the poses drift."""
OWN_INFLATION, DRIFT_INFLATION = 1.5, 2.0
"""Factors on the a and b that are found from residuals. Keypoints move with the viewpoint, by the same for far
references, so the drift is larger than residuals say. Evidence: adjustment."""


@dataclass(frozen=True)
class AdjustOptions:
    """Options of the adjustment.

    Attributes:
        loss_scale_sigma: scale of the Cauchy loss, with which the influence of outliers vanishes.
        error_inflation: factor by which standard deviations from the sum over residuals are typically too small; it
            sets the weight of priors. The answer's covariance does not use it (see `dispersion`).
        inlier_px: as in the pose solver; the inliers of the answer are those of its own pose.
        min_kept_share: an adjustment that keeps a smaller share of the inliers has diverged and is not used.
        max_error_px: matches with a larger error under the initial pose are not used.
        iterations: largest number of Levenberg-Marquardt steps.
        min_decrease: stop when a step lowers the cost by a smaller share.
        min_motion_sigma: stop when a step moves the pose by less, in standard deviations by the residuals; errors are
            several of these. Evidence: adjustment.
        least_curvature: see `BundleProblem`.
        suspicion: when an error of the intrinsics counts in full in the covariance.
        trial: when it is tried to estimate the intrinsics with the pose. A large error makes residuals large, where the
            loss hardly curves: with the intrinsics as given it seems undetermined, and is not where it is estimated.
        agreeing_share: or when a smaller share of the matches are inliers. Evidence: adjustment.
        contradiction: when this estimate is used.
        rounds: how often, at most, the query's keypoints are corrected by an estimated parameter.
        min_added_share: keypoints that the query shares with references, and no point has, are adjusted too where there
            are so many for each inlier. Evidence: adjustment.
        query_points: options of triangulating these.
        uncertainty: options of the answer's covariance.
    """

    loss_scale_sigma: float = 1.4
    error_inflation: float = 2.0
    inlier_px: float = INLIER_PX
    min_kept_share: float = 0.8
    max_error_px: float = 8.0
    iterations: int = 8
    min_decrease: float = 1e-5
    min_motion_sigma: float = 0.25
    least_curvature: float = 0.5
    suspicion: ContradictionOptions = field(default_factory=lambda: ContradictionOptions(2.0, 0.06, 0.06, 0.15))
    trial: ContradictionOptions = field(default_factory=lambda: ContradictionOptions(2.0, *[math.inf] * 3))
    contradiction: ContradictionOptions = field(default_factory=ContradictionOptions)
    agreeing_share: float = 0.6
    rounds: int = 4
    min_added_share: float = MIN_ADDED_SHARE
    query_points: StructureOptions = field(default_factory=StructureOptions)
    uncertainty: UncertaintyOptions = field(default_factory=UncertaintyOptions)

    def __post_init__(self) -> None:
        check_bounds(self, "inlier_px min_kept_share loss_scale_sigma max_error_px agreeing_share", above=0)
        check_bounds(self, "iterations min_decrease", above=0)
        check_bounds(self, "min_motion_sigma min_added_share", at_least=0)
        check_bounds(self, "least_curvature", above=0, at_most=1)
        check_bounds(self, "rounds", at_least=2)  # the last one only reads the photograph again


@dataclass(frozen=True, eq=False)
class AdjustInput:
    """The data that a pose is adjusted to.

    Attributes:
        query: the query.
        references: the references, in the order of the structure's tracks.
        structure: metric points.
        matches: 2D-3D matches of the query with these points.
        options: options of the adjustment.
        intrinsics: standard deviations of the query's intrinsics; None for the defaults.
        query_matches: matches of the query with each reference; where many belong to no point, they are used too.
    """

    query: View
    references: Sequence[PosedView]
    structure: Structure
    matches: PointMatches
    options: AdjustOptions
    intrinsics: IntrinsicsSigma | None = None
    query_matches: Sequence[Matches] = ()

    @staticmethod
    def of(support: Support, options: AdjustOptions) -> "AdjustInput":
        """The data of a support."""
        it = support
        return AdjustInput(
            it.query, it.references, it.structure, it.matches, options, it.intrinsics_sigma, it.query_matches
        )

    def errors_px(self, world_from_query: RigidTransform, rows: slice = slice(None)) -> Array:
        """Reprojection errors (M,) of matches at a pose, pixels; NaN behind the camera."""
        return self.matches.select(rows).seen(self.query, self.structure.x_in_world).errors_px(world_from_query)

    def with_points(self, used: NDArray[np.intp], points: Array) -> "AdjustInput":
        """Moves the points of the `used` matches to `points` (P, 3), in the order of the structure."""
        x_in_world = self.structure.x_in_world.copy()
        chosen = np.zeros(len(x_in_world), bool)
        chosen[self.matches.point[used]] = True
        x_in_world[chosen] = points
        return replace(self, structure=replace(self.structure, x_in_world=x_in_world))


@dataclass(frozen=True, eq=False)
class Solved:
    """The solution of a query's adjustment.

    Attributes:
        given: the data that the pose was adjusted to.
        problem: the problem, without priors on the pose or with them.
        there: values of its unknowns, at its optimum or near it.
        used: indices of the matches that it uses.
    """

    given: AdjustInput
    problem: BundleProblem
    there: Linearized
    used: NDArray[np.intp]

    @property
    def bundle(self) -> Bundle:
        """The values alone."""
        return self.there.bundle


def pose_problem(
    given: AdjustInput,
    used: NDArray[np.intp],
    world_from_query: RigidTransform,
    known: tuple[Array, Poses] | None = None,
) -> tuple[BundleProblem, Linearized]:
    """Sets up the problem of one query without priors, and its start; `used` are the indices of the matches to use.

    `known` are the information of the prior on the references' poses, which is estimated if None, and all poses of the
    start, which are the given ones if None.
    """
    query, references, structure, matches = given.query, given.references, given.structure, given.matches
    views = [*references, PosedView("", "", query, world_from_query)]
    tracks, chosen = tracks_with_query(structure, matches.point[used], matches.keypoint[used], len(references))
    problem, start, depth_m = free_problem(tracks, views, structure, chosen, given.options.loss_scale_sigma)
    if known is not None:
        return replace(problem, information=known[0]), problem.at(replace(start, poses=known[1]))
    centres = np.array([it.world_from_camera.translation for it in references])
    observing = np.flatnonzero(np.bincount(tracks.view))[:-1]  # the last is the query
    focal_px = float(np.median([references[i].view.camera.focal_x_px for i in observing]))
    centre, level_px, rotations = world_from_query.translation, structure.noise.level_px, problem.given.rotation
    stated = [it.provenance for it in references]
    errors = pose_errors(centres, rotations, centre, level_px, focal_px, depth_m, observing, stated)
    there = problem.at(start)
    matrix, gradient, _ = problem.linearize(there).reduced(LEAST_DAMPING)
    own, drift = most_probable(errors, matrix, gradient)
    covariance = errors.covariance(own, drift)
    return replace(problem, information=np.asarray(np.linalg.inv(covariance), np.float64)), there


def optimum(problem: BundleProblem, start: Linearized, options: AdjustOptions) -> Linearized:
    """The values at the minimum of a problem, as near to it as matters for the query's pose."""
    curved = replace(problem, least_curvature=options.least_curvature)

    def is_near(before: Linearized, after: Linearized, equations: NormalEquations) -> bool:
        return curved.query_motion_sigma(before, after, equations) < options.min_motion_sigma

    return minimize(curved, start, MinimizeOptions(options.iterations, options.min_decrease), is_near)


def with_intrinsics(problem: BundleProblem, bundle: Bundle, query: View) -> tuple[BundleProblem, Bundle]:
    """Adds errors of the query's intrinsics to the unknowns of a problem, without a prior on them."""
    observations = problem.observations
    is_query = observations.tracks.view == len(problem.given.rotation)
    motion = keypoint_motion(query.camera, query.distortion, observations.pixel[:, is_query].T)
    motion = motion / observations.sigma_px[is_query, None, None]
    by_view, none = replace(problem.by_view, by_intrinsics=columns(motion)), np.zeros(4)
    wider = replace(problem, by_view=by_view, intrinsics_information=none, intrinsics_offset=none)
    return wider, replace(bundle, intrinsics=np.zeros(4))


def shares_camera(query: View, references: Sequence[PosedView]) -> bool:
    """Whether most references are of the query's camera."""
    return 2 * sum(query.has_camera_of(it.view) for it in references) > len(references)


@dataclass(frozen=True, eq=False)
class PoseUncertainty:
    """The errors of a pose.

    Attributes:
        covariance: (6, 6), of all errors.
        intrinsics: evidence about errors of the intrinsics; None without any.
        by_references: (6, 6) its part by what adopted references are off in common; None without such.
    """

    covariance: Array
    intrinsics: IntrinsicsEvidence | None
    by_references: Array | None = None

    @staticmethod
    def of(estimate: PoseEstimate) -> "PoseUncertainty":
        """The errors of an estimate."""
        return PoseUncertainty(estimate.covariance, estimate.intrinsics, estimate.reference_covariance)

    def on(self, estimate: PoseEstimate) -> PoseEstimate:
        """An estimate with these errors."""
        found = replace(estimate, covariance=self.covariance, intrinsics=self.intrinsics)
        return replace(found, reference_covariance=self.by_references)


def adjusted_estimate(solved: Solved, estimate: PoseEstimate, errors: PoseUncertainty | None) -> PoseEstimate | None:
    """Returns the estimate at the optimum; None if it has diverged. `errors` are what `errors_of_pose` returns."""
    pose, options = solved.bundle.world_from_query, solved.given.options
    errors_px = solved.given.with_points(solved.used, solved.bundle.points).errors_px(pose)
    inliers = errors_px < options.inlier_px
    if errors is None or inliers.sum() < max(1, options.min_kept_share * estimate.inliers.sum()):
        return None
    return errors.on(PoseEstimate(pose, PoseStage.REFINED, inliers, errors_px, errors.covariance, is_adjusted=True))


def errors_of_pose(solved: Solved, intrinsics: IntrinsicsTerms, is_offset: bool = False) -> PoseUncertainty | None:
    """The errors of a pose without those by scale and priors; None if it is not determined.

    `is_offset` as for `dispersed_covariance`.
    """
    pose, options = solved.bundle.world_from_query, solved.given.options
    wider, bundle = with_intrinsics(solved.problem, solved.bundle, solved.given.query)
    dispersion = disperse(wider, bundle, options.uncertainty.max_matches)
    if dispersion is None:
        return None
    covariance = dispersed_covariance(dispersion, pose, options.uncertainty, is_offset)
    factors = options.error_inflation, options.uncertainty.region_factor
    evidence = intrinsics_evidence(dispersion.intrinsics, intrinsics, options.suspicion, *factors)
    covariance = covariance if evidence is None else covariance + evidence.pose_covariance
    references = solved.given.references
    if not any(it.provenance.source == ADOPTED for it in references):
        return PoseUncertainty(covariance, evidence)
    by_references = common_covariance(references, dispersion.by_motions, pose)
    return PoseUncertainty(covariance + by_references, evidence, by_references)


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """The parts of the covariance of K references' errors, each (6 K, 6 K), the first two with a = b = 1.

    The errors are left perturbations (v, w) of camera_from_world, metres and radians. `stated` is None if no reference
    has an accuracy of its own.
    """

    own: Array
    drift: Array
    stated: Array | None = None

    def covariance(self, own: float, drift: float) -> Array:
        """The covariance C (6 K, 6 K) for sizes a = `own` and b = `drift`."""
        estimated = own**2 * self.own + drift**2 * self.drift
        return estimated if self.stated is None else estimated + self.stated


def pose_errors(
    centres: Array,
    rotations: Array,
    query_centre: Array,
    level_px: float,
    focal_px: float,
    depth_m: float,
    observing: NDArray[np.intp] | None = None,
    stated: Sequence[Provenance] = (),
) -> PoseErrors:
    """Computes the parts of the covariance of the errors of K references.

    Centres (K, 3) and (3,) of the query are in metres, rotations (K, 3, 3) are camera_from_world. `level_px` is the
    noise of the structure, `depth_m` the median depth of the points. References that are not `observing` points (None
    for all) may be in another part of the scene, and do not count for d. `stated` says how the poses of references are
    known, of all or of none.
    """
    unit = level_px / focal_px * np.array([depth_m, 1.0])
    between = np.linalg.norm(centres[:, None] - centres, axis=2)
    to_query = np.linalg.norm(centres - query_centre, axis=1)
    distances = [between[i, j] for i, j in combinations(range(len(centres)) if observing is None else observing, 2)]
    spacing = max(float(np.median(distances)) if distances else 0.0, LEAST_SPACING * depth_m)
    drift = (to_query[:, None] + to_query - between) / (2 * spacing)
    own = _of_motions(np.eye(len(centres)), rotations, unit)
    its_own = stated_covariance(stated, rotations) if any(it.accuracy for it in stated) else None
    return PoseErrors(own, _of_motions(drift, rotations, unit), its_own)


def _of_motions(covariance: Array, rotations: Array, unit: Array) -> Array:
    """Covariance (6 K, 6 K) of left perturbations, from that (K, K) of shifts and rotations along each world axis."""
    count = len(rotations)
    turned = np.einsum("ij,iab,jcb->iajc", covariance, rotations, rotations)
    result = np.zeros((count, 2, 3, count, 2, 3))
    for kind in range(2):
        result[:, kind, :, :, kind] = unit[kind] ** 2 * turned
    return result.reshape(6 * count, 6 * count)


def most_probable(errors: PoseErrors, matrix: Array, gradient: Array) -> tuple[float, float]:
    """Most probable a and b, from normal equations of 6 K unknowns and, last, the query's, at the given poses."""
    finite = bool(np.isfinite(matrix).all() and np.isfinite(gradient).all())
    if not finite:
        return OWN_INFLATION * USUAL_OWN, DRIFT_INFLATION * USUAL_DRIFT
    project, data = _whitened(*_without_query(matrix, gradient, len(errors.own)), np.sqrt(np.diag(errors.own)))
    if errors.stated is not None:
        values, vectors = np.linalg.eigh(np.eye(len(data)) + project @ errors.stated @ project.T)
        whiten = vectors.T / np.sqrt(np.maximum(values, 1.0))[:, None]  # below 1 is rounding
        project, data = whiten @ project, whiten @ data
    own, drift = project @ errors.own @ project.T, project @ errors.drift @ project.T
    sizes = np.array([(a, b) for a in OWN for b in DRIFT])
    squares = sizes[:, :, None, None] ** 2
    # The last row of a Cholesky factor [L 0; (L^-1 d)^T .] of the matrix bordered by d.
    bordered = np.empty((len(sizes), len(data) + 1, len(data) + 1))
    bordered[:, :-1, :-1] = np.eye(len(data)) + squares[:, 0] * own + squares[:, 1] * drift
    bordered[:, -1, :-1] = bordered[:, :-1, -1] = data
    bordered[:, -1, -1] = 1 + data @ data
    factor = np.linalg.cholesky(bordered)
    error = factor[:, -1, :-1]
    log_determinant = np.log(np.diagonal(factor, axis1=1, axis2=2)[:, :-1]).sum(axis=1)
    usual = np.array([USUAL_OWN, USUAL_DRIFT])
    unusual = (np.log(sizes / usual) / PRIOR_LOG) ** 2
    best = np.argmax(-0.5 * (error**2).sum(axis=1) - log_determinant - 0.5 * unusual.sum(axis=1))
    return OWN_INFLATION * float(sizes[best, 0]), DRIFT_INFLATION * float(sizes[best, 1])


def _without_query(matrix: Array, gradient: Array, n: int) -> tuple[Array, Array]:
    """Normal equations (n, n), (n,) of the references, with the query's unknowns eliminated."""
    coupling = matrix[:n, n:]
    solved = np.linalg.lstsq(matrix[n:, n:], np.column_stack([coupling.T, gradient[n:]]), rcond=None)[0]
    return matrix[:n, :n] - coupling @ solved[:, :-1], gradient[:n] - coupling @ solved[:, -1]


def _whitened(matrix: Array, gradient: Array, unit: Array) -> tuple[Array, Array]:
    """Linear observations of the errors e: P (M, 6 K) and d (M,), with d = P e + noise of standard deviation 1."""
    values, vectors = np.linalg.eigh(matrix * unit[:, None] * unit)
    seen = values > LEAST_EIGENVALUE * max(values[-1], 1.0)
    root, vectors = np.sqrt(values[seen]), vectors[:, seen]
    return root[:, None] * vectors.T / unit, vectors.T @ (gradient * unit) / root
