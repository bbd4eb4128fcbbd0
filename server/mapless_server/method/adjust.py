"""Adjustment: a last refinement, not in the paper: bundle adjustment of the query, its points and the references.

The paper fixes the points before it solves for the query, and never moves the references. But the query observes the
points too, and reference poses are never exact: they have noise, and errors of the lens model add to it. So here all
are adjusted together,

    min  sum_obs rho(|r_o|^2 / sigma_o^2) + xi^T C^-1 xi,

over the query's pose, its points and small motions xi of the references, which a prior holds to their given poses. Its
covariance C, by which neighbours move together and far references are held less, is found for each query from the
references' observations (see `pose_errors`).

The query's intrinsics stay as given: where they are right, poses are twice as accurate without these four unknowns.
What the photograph says of their errors follows from the same normal equations, and the pose's covariance contains them
(see `intrinsics`). A parameter that the photograph contradicts is estimated with the pose, the most significant one
first, and the photograph is read again with its value.
Priors on the query's pose add their terms, unless the photograph alone contradicts them. The points are eliminated (see
`bundle`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from .bundle import Bundle, BundleProblem, bundle_of
from .intrinsics import (
    PRINCIPAL,
    ContradictionOptions,
    corrected_view,
    intrinsics_evidence,
    keypoint_motion,
)
from .optimize import MinimizeOptions, minimize
from .options import IntrinsicsSigma, check_bounds
from .perturbation import reprojection_errors_px, world_jacobian
from .pose_errors import PoseErrorOptions, most_probable, pose_errors
from .priors.known import NO_PRIORS, Priors
from .results import MetricScale, PointMatches, PoseEstimate, PoseStage, Structure, Support
from .structure import tracks_with_query
from .uncertainty.covariance import UncertaintyOptions, adjusted_covariance, scale_covariance
from .views import PosedView, View

LEAST_DAMPING = 1e-9
"""Keeps the points determined where they are eliminated at the given poses."""

SHARED_CAMERA = 0.03
"""Share of the intrinsics' usual errors that differ between photographs of one camera. What they share is in the
references' points too, and moves the pose but little: focus and stabilization remain. With 0.1 the covariance of these
errors exceeds all others in scenes of one camera, where radii hold too often."""

WIDE_SIGMA = np.array([0.3, 0.3, 0.3, 1.0])
"""Of an estimated parameter: focal length and k1, and principal point as a share of the width."""
MAX_HELD = 3.0
"""An estimate that leaves the prior by more standard deviations has diverged."""
LEAST_MATCHES = 20
"""For a pose and intrinsics."""


@dataclass(frozen=True)
class AdjustOptions:
    """Options of the adjustment.

    Attributes:
        loss_scale_sigma: of the Cauchy loss, under which the influence of outliers vanishes.
        error_inflation: factor by which standard deviations from the sum over residuals are typically too small; it
            sets the weight of priors. The answer's covariance does not use it (see `uncertainty`).
        inlier_px: as in the pose solver; the inliers of the answer are those of its own pose.
        min_kept_share: an adjustment that keeps a smaller share of the inliers has diverged and is not used.
        max_error_px: matches with a larger error under the initial pose are not used.
        iterations: at most so many Levenberg-Marquardt steps.
        min_decrease: stop when a step lowers the cost by a smaller share.
        suspicion: when a parameter of the intrinsics is estimated with the pose. A large error leaves few inliers, of
            which those with other errors are missing.
        contradiction: when this estimate is used.
        rounds: at most so many times an estimated parameter's photograph is read again.
        pose_errors: of the errors of the references' poses.
        uncertainty: of the answer's covariance.
    """

    loss_scale_sigma: float = 1.4
    error_inflation: float = 2.0
    inlier_px: float = 4.0
    min_kept_share: float = 0.8
    max_error_px: float = 8.0
    iterations: int = 8
    min_decrease: float = 1e-5
    suspicion: ContradictionOptions = field(default_factory=lambda: ContradictionOptions(2.0, 0.06, 0.06, 0.15))
    contradiction: ContradictionOptions = field(default_factory=ContradictionOptions)
    rounds: int = 4
    pose_errors: PoseErrorOptions = field(default_factory=PoseErrorOptions)
    uncertainty: UncertaintyOptions = field(default_factory=UncertaintyOptions)

    def __post_init__(self) -> None:
        check_bounds(self, "inlier_px min_kept_share loss_scale_sigma max_error_px", above=0)
        check_bounds(self, "iterations min_decrease", above=0)
        check_bounds(self, "rounds", at_least=2)  # the last one only reads the photograph again


def adjust_pose(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    estimate: PoseEstimate,
    options: AdjustOptions,
    priors: Priors = NO_PRIORS,
    intrinsics: IntrinsicsSigma | None = None,
) -> PoseEstimate:
    """Refines an estimate together with its points and, within their noise, the references.

    Args:
        query: the query.
        references: in the order that the structure's tracks number them.
        structure: metric points.
        matches: of the query with them.
        estimate: the initial pose; its errors select the matches.
        options: see there.
        priors: on the query's pose. Each is checked against the pose from the photograph alone; only consistent ones
            are used.
        intrinsics: standard deviations of the query's intrinsics; None for the defaults.

    Returns:
        The estimate with a refined pose and its covariance; unchanged if the adjustment fails.
    """

    def adjusted(start: PoseEstimate, active: Priors) -> PoseEstimate | None:
        return _adjusted(query, references, structure, matches, start, options, active, intrinsics)

    # If no prior is used, the answer is bit-identical to the one without priors.
    without_priors = estimate.without_priors or estimate
    alone = adjusted(without_priors, NO_PRIORS)
    if not priors:
        return alone or without_priors
    checks = priors.check(alone.world_from_camera, alone.covariance) if alone else estimate.prior_checks
    used = priors.consistent(checks)
    answer = (adjusted(estimate, used) or estimate) if used else (alone or without_priors)
    return replace(answer, prior_checks=checks)


def _adjusted(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    estimate: PoseEstimate,
    options: AdjustOptions,
    priors: Priors,
    intrinsics: IntrinsicsSigma | None,
) -> PoseEstimate | None:
    """The estimate at the optimum with priors; None if it diverges or has too few matches."""
    used = np.flatnonzero(estimate.errors_px < options.max_error_px)
    if len(used) < 3:  # two equations each, for six unknowns
        return None
    problem, start = pose_problem(query, references, structure, matches, used, estimate.world_from_camera, options)
    with_priors = replace(problem, priors=priors, prior_weight=options.error_inflation**2)
    bundle = minimize(with_priors, start, MinimizeOptions(options.iterations, options.min_decrease))
    usual = (intrinsics or IntrinsicsSigma()).of(query.camera)
    is_shared = 2 * sum(query.has_camera_of(it.view) for it in references) > len(references)
    held = SHARED_CAMERA * usual if intrinsics is None and is_shared else usual
    terms = (query, np.zeros(4), usual, held)
    found = _conclude(query, structure, matches, used, estimate, problem, bundle, options, terms)
    if found is not None and found.intrinsics is not None:
        found = _recalibrated(query, references, structure, matches, found, options, priors, usual)
    return found and replace(found, covariance=priors.sharpened(found.covariance, found.world_from_camera))


def _recalibrated(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    found: PoseEstimate,
    options: AdjustOptions,
    priors: Priors,
    usual: Array,
) -> PoseEstimate:
    """The estimate with the parameters that the photograph contradicts; the one found if it contradicts none."""
    held, is_held = usual.copy(), np.ones(4, bool)
    wide = np.maximum(usual, WIDE_SIGMA * np.array([1, query.camera.width_px, query.camera.width_px, 1]))
    while (worst := _contradicted(found, options.suspicion, is_held)) is not None:
        is_held[list(worst)] = False
        held[list(worst)] = wide[list(worst)]
        better = _with_errors(query, references, structure, matches, found, options, priors, usual, held)
        if better is None or better.intrinsics is None:
            break
        if not better.intrinsics.contradicted(options.contradiction)[list(worst)].any():
            break
        found = better
    return found


def _contradicted(
    found: PoseEstimate, options: ContradictionOptions, is_held: NDArray[np.bool_]
) -> tuple[int, ...] | None:
    """The parameter, or both of the principal point, that the photograph contradicts most; of those that are held."""
    evidence = found.intrinsics
    if evidence is None:
        return None
    wrong = evidence.contradicted(options) & is_held
    worst = int(np.argmax(np.where(wrong, np.abs(evidence.value) / evidence.sigma, 0.0)))
    if not wrong[worst]:
        return None
    return PRINCIPAL if worst in PRINCIPAL else (worst,)


def _with_errors(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    found: PoseEstimate,
    options: AdjustOptions,
    priors: Priors,
    usual: Array,
    held: Array,
) -> PoseEstimate | None:
    """The estimate with errors of the intrinsics as unknowns, of prior standard deviations `held`; None if it fails."""
    assert found.intrinsics is not None
    errors, pose, view = found.intrinsics.removed, found.world_from_camera, found.view or query
    steps = MinimizeOptions(options.iterations, options.min_decrease)
    change: Array | None = None
    for left in reversed(range(options.rounds)):
        pixels = view.features.keypoints[matches.keypoint].astype(np.float64)
        errors_px = reprojection_errors_px(view.camera, pose, structure.x_in_world[matches.point], pixels)
        used = np.flatnonzero(errors_px < options.max_error_px)
        if len(used) < LEAST_MATCHES:
            return None
        problem, start = pose_problem(view, references, structure, matches, used, pose, options)
        problem = replace(problem, priors=priors, prior_weight=options.error_inflation**2)
        if not left or (change is not None and (np.abs(change) < usual / 10).all()):
            break
        wider, there = with_intrinsics(problem, start, view)
        wider = replace(wider, intrinsics_information=held**-2.0, intrinsics_offset=errors)
        bundle = minimize(wider, there, steps)
        pose, change = bundle.world_from_query, bundle.intrinsics
        errors = errors + change
        if np.abs(errors / held).max() > MAX_HELD:
            return None
        view = corrected_view(query, errors)
    terms = (query, errors, usual, held)
    before = replace(found, inliers=errors_px < options.inlier_px)
    bundle = minimize(problem, start, steps)
    better = _conclude(view, structure, matches, used, before, problem, bundle, options, terms)
    return better and replace(better, view=view)


def _conclude(
    query: View,
    structure: Structure,
    matches: PointMatches,
    used: NDArray[np.intp],
    estimate: PoseEstimate,
    problem: BundleProblem,
    bundle: Bundle,
    options: AdjustOptions,
    intrinsics: tuple[View, Array, Array, Array],
) -> PoseEstimate | None:
    """The estimate at the optimum, its covariance without priors; None if it has diverged.

    `intrinsics`: the query with its intrinsics as given, the errors that are removed from them, and the standard
    deviations `prior_sigma` and `held_sigma` of `intrinsics_evidence`.
    """
    pose = bundle.world_from_query
    pixels = query.features.keypoints[matches.keypoint].astype(np.float64)
    points = structure.x_in_world.copy()
    points[np.unique(matches.point[used])] = bundle.points
    errors_px = reprojection_errors_px(query.camera, pose, points[matches.point], pixels)
    inliers = errors_px < options.inlier_px
    if inliers.sum() < max(1, options.min_kept_share * estimate.inliers.sum()):
        return None
    covariance = adjusted_covariance(problem, bundle, options.uncertainty)
    if covariance is None:
        return None
    wider, there = with_intrinsics(problem, bundle, query)
    matrix, gradient, _ = wider.linearize(there).reduced(LEAST_DAMPING)
    evidence = intrinsics_evidence(matrix, gradient, *intrinsics, options.error_inflation, world_jacobian(pose))
    if evidence is not None:
        covariance = covariance + evidence.pose_covariance
    return PoseEstimate(pose, PoseStage.REFINED, inliers, errors_px, covariance, is_adjusted=True, intrinsics=evidence)


def pose_covariance(
    support: Support,
    scale: MetricScale,
    options: AdjustOptions,
    priors: Priors = NO_PRIORS,
    points_are_predicted: bool = False,
) -> Array:
    """Covariance (6, 6) of a pose, order x y z rx ry rz, fixed world axes, metres and radians.

    Args:
        support: with an estimate, of any stage.
        scale: its metric scale, whose deviation is used as its relative standard deviation.
        options: see there.
        priors: on the pose; those that were used reduce the covariance.
        points_are_predicted: whether the structure's points are predicted by the reconstruction, rather than
            triangulated from the references' poses.

    Raises:
        ValueError: there is no estimate.
    """
    estimate, references, matches = support.estimate, support.references, support.matches
    if estimate is None:
        raise ValueError("support.estimate must not be None")
    if estimate.is_adjusted:
        return estimate.covariance
    used = np.flatnonzero(estimate.errors_px < options.max_error_px)
    if len(used) < 3:
        return estimate.covariance
    pose, is_initial = estimate.world_from_camera, estimate.stage is PoseStage.INITIAL
    problem, bundle = pose_problem(support.query, references, support.structure, matches, used, pose, options)
    covariance = adjusted_covariance(problem, bundle, options.uncertainty, is_initial)
    if covariance is None:
        return estimate.covariance
    if is_initial or points_are_predicted:
        centroid = np.mean([it.world_from_camera.translation for it in references], axis=0)
        covariance = covariance + scale_covariance(pose, centroid, scale.deviation)
    return priors.consistent(estimate.prior_checks).sharpened(covariance, pose)


def with_intrinsics(problem: BundleProblem, bundle: Bundle, query: View) -> tuple[BundleProblem, Bundle]:
    """The same problem and values with errors of the query's intrinsics as unknowns, without a prior on them."""
    is_query = problem.view == len(problem.given.rotation)
    observations = problem.observations
    motion = keypoint_motion(query.camera, query.distortion, observations.pixel[is_query])
    motion = motion / observations.sigma_px[is_query, None, None]
    wider = replace(problem, keypoint_motion=motion, intrinsics_information=np.zeros(4), intrinsics_offset=np.zeros(4))
    return wider, replace(bundle, intrinsics=np.zeros(4))


def pose_problem(
    query: View,
    references: Sequence[PosedView],
    structure: Structure,
    matches: PointMatches,
    used: NDArray[np.intp],
    world_from_query: RigidTransform,
    options: AdjustOptions,
) -> tuple[BundleProblem, Bundle]:
    """The problem of one query without priors, and its start; `used` are the indices of the matches to use."""
    views = [*references, PosedView("", "", query, world_from_query)]
    tracks, chosen = tracks_with_query(structure, matches.point[used], matches.keypoint[used], len(references))
    observations, start, depth_m = bundle_of(tracks, views, structure, chosen)
    given = start.poses[:-1]
    free = np.zeros((6 * len(references),) * 2)
    problem = BundleProblem(observations, tracks.view, given, free, options.loss_scale_sigma)
    centres = np.array([it.world_from_camera.translation for it in references])
    observing = np.unique(tracks.view)[:-1]  # the last is the query
    focal_px = float(np.median([references[i].view.camera.focal_x_px for i in observing]))
    level_px = float(structure.noise.level_px)
    errors = pose_errors(centres, given.rotation, world_from_query.translation, level_px, focal_px, depth_m, observing)
    matrix, gradient, _ = problem.linearize(start).reduced(LEAST_DAMPING)
    own, drift = most_probable(errors, matrix, gradient, options.pose_errors)
    covariance = errors.covariance(own, drift)
    return replace(problem, information=np.asarray(np.linalg.inv(covariance), np.float64)), start
