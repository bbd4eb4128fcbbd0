"""The covariance of an answer's pose: `covariance`'s parts, for whatever stage the pose is of.

An adjusted pose has its own (see `adjust`). The others are looked at from where they are: the matches near them and the
references' poses as given.
"""

from __future__ import annotations

import numpy as np

from mapless.geometry import Array

from .priors.known import NO_PRIORS, Priors
from .results import MetricScale, PoseEstimate, PoseStage, Support, Uncertainty
from .structure import observe
from .uncertainty.covariance import UncertaintyOptions, one_match_covariance, scale_covariance, uncertainty_of
from .uncertainty.linearization import jackknife_input, linearize, tracks_with_query
from .views import PosedView


def pose_covariance(
    support: Support,
    scale: MetricScale,
    options: UncertaintyOptions,
    priors: Priors = NO_PRIORS,
    points_are_predicted: bool = False,
) -> Array:
    """Covariance (6, 6) of a pose, order x y z rx ry rz, fixed world axes, metres and radians.

    Args:
        support: with an estimate, of any stage.
        scale: its metric scale, whose deviation is taken for its relative standard deviation.
        options: see there.
        priors: what was known of the pose; those that took part sharpen the covariance.
        points_are_predicted: whether the structure's points are where the reconstruction and the scale put them, and
            not triangulated from the references' poses.

    Raises:
        ValueError: there is no estimate.
    """
    estimate = support.estimate
    if estimate is None:
        raise ValueError("without an estimate there is nothing to be uncertain of")
    if estimate.uncertainty is not None:
        return estimate.covariance
    is_initial = estimate.stage is PoseStage.INITIAL
    found = _unadjusted(support, estimate, is_initial, options)
    if found is None:
        return estimate.covariance
    pose, covariance = estimate.world_from_camera, found.covariance
    if is_initial or points_are_predicted:
        centroid = np.mean([r.world_from_camera.translation for r in support.references], axis=0)
        covariance = covariance + scale_covariance(pose, centroid, scale.deviation)
    return priors.consistent(estimate.prior_checks).sharpened(covariance, pose)


def _unadjusted(
    support: Support, estimate: PoseEstimate, is_initial: bool, options: UncertaintyOptions
) -> Uncertainty | None:
    query, references, structure, matches = support.query, support.references, support.structure, support.matches
    used = np.flatnonzero(estimate.errors_px < options.max_error_px)
    if len(used) < 3:
        return None
    tracks, chosen = tracks_with_query(structure, matches.point[used], matches.keypoint[used], len(references))
    views = [*references, PosedView("", "", query, estimate.world_from_camera)]
    rows = linearize(observe(tracks, views, structure.noise), structure.x_in_world[chosen], options.loss_scale_sigma)
    pose, x_in_world = estimate.world_from_camera, structure.x_in_world[matches.point[estimate.inliers]]
    one_match = one_match_covariance(query.camera, pose, x_in_world, structure.noise.level_px)
    jackknife = jackknife_input(rows, tracks.point, tracks.view, options.max_matches)
    return uncertainty_of(jackknife, pose, one_match, options, is_initial)
