"""Adjustment: a last refinement, not in the paper: bundle adjustment of the query, its points and the references.

The paper fixes the points before it solves for the query, and never moves the references. But the query observes the
points too, and reference poses are never exact: they have noise, and errors of the lens model add to it. So here all
are adjusted together (see `pose_problem`).

The query's intrinsics stay as given: where they are right, poses are twice as accurate without these four unknowns.
What the photograph says of their errors follows from the same normal equations, and the pose's covariance contains them
(see `intrinsics`). A parameter that the photograph contradicts is estimated with the pose (see `recalibrate`).
Priors on the query's pose add their terms, unless the photograph alone contradicts them.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mapless.geometry import Array

from .options import IntrinsicsSigma
from .pose_problem import AdjustOptions, adjusted_estimate, errors_of_pose, optimum, pose_problem, shares_camera
from .priors.known import NO_PRIORS, Priors
from .recalibrate import recalibrated
from .results import MetricScale, PointMatches, PoseEstimate, PoseStage, Structure, Support
from .uncertainty.covariance import scale_covariance
from .views import PosedView, View

SHARED_CAMERA = 0.03
"""Share of the intrinsics' usual errors that differ between photographs of one camera. What they share is in the
references' points too, and moves the pose but little: focus and stabilization remain. With 0.1 the covariance of these
errors exceeds all others in scenes of one camera, where radii hold too often."""


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
        references: the references, in the order of the structure's tracks.
        structure: metric points.
        matches: 2D-3D matches of the query with these points.
        estimate: the initial pose; its errors select the matches.
        options: of the adjustment.
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
    """Returns the estimate at the optimum with priors; None if it diverges or has too few matches."""
    used = np.flatnonzero(estimate.errors_px < options.max_error_px)
    if len(used) < 3:  # two equations each, for six unknowns
        return None
    problem, start = pose_problem(query, references, structure, matches, used, estimate.world_from_camera, options)
    with_priors = problem.replaced(priors=priors, prior_weight=options.error_inflation**2)
    bundle = optimum(with_priors, start, options)
    terms = intrinsics_terms(query, references, intrinsics)
    found = adjusted_estimate(query, structure, matches, used, estimate, problem, bundle, options, terms)
    if found and found.intrinsics:
        solved = problem, bundle, used
        found = recalibrated(query, references, structure, matches, found, options, priors, terms[2], solved)
    return found and replace(found, covariance=priors.sharpened(found.covariance, found.world_from_camera))


def intrinsics_terms(
    query: View, references: Sequence[PosedView], intrinsics: IntrinsicsSigma | None
) -> tuple[View, Array, Array, Array]:
    """A photograph with its intrinsics as given, for `errors_of_pose`."""
    usual = (intrinsics or IntrinsicsSigma()).of(query.camera)
    is_shared = intrinsics is None and shares_camera(query, references)
    return query, np.zeros(4), usual, SHARED_CAMERA * usual if is_shared else usual


def with_covariance(
    support: Support,
    scale: MetricScale,
    options: AdjustOptions,
    priors: Priors = NO_PRIORS,
    points_are_predicted: bool = False,
    intrinsics: IntrinsicsSigma | None = None,
) -> PoseEstimate:
    """The estimate with the covariance of its pose, and the evidence of errors of its intrinsics.

    Args:
        support: the pose's support, with an estimate of any stage.
        scale: its metric scale, whose deviation is used as its relative standard deviation.
        options: of the adjustment.
        priors: on the pose; those that were used reduce the covariance.
        points_are_predicted: whether the structure's points are predicted by the reconstruction, rather than
            triangulated from the references' poses.
        intrinsics: standard deviations of the query's intrinsics; None for the defaults.

    Raises:
        ValueError: there is no estimate.
    """
    estimate, references, matches = support.estimate, support.references, support.matches
    if estimate is None:
        raise ValueError("support.estimate must not be None")
    if estimate.is_adjusted:
        return estimate
    used = np.flatnonzero(estimate.errors_px < options.max_error_px)
    if len(used) < 3:
        return estimate
    pose, is_initial = estimate.world_from_camera, estimate.stage is PoseStage.INITIAL
    problem, bundle = pose_problem(support.query, references, support.structure, matches, used, pose, options)
    terms = intrinsics_terms(support.query, references, intrinsics)
    errors = errors_of_pose(support.query, problem, bundle, options, terms, is_initial)
    if errors is None:
        return estimate
    covariance, evidence = errors
    if is_initial or points_are_predicted:
        centroid = np.mean([it.world_from_camera.translation for it in references], axis=0)
        covariance = covariance + scale_covariance(pose, centroid, scale.deviation)
    covariance = priors.consistent(estimate.prior_checks).sharpened(covariance, pose)
    found = replace(estimate, covariance=covariance, intrinsics=evidence)
    if evidence is None:
        return found
    # The pose stays as it is; but an error is not seen in full before it is estimated.
    given = support.query, references, support.structure, matches
    solved = problem, bundle, used
    estimated = recalibrated(*given, found, options, NO_PRIORS, terms[2], solved).intrinsics
    if estimated is not None and estimated.contradicted(options.contradiction, terms[2]).any():
        found = replace(found, intrinsics=estimated)
    return found
