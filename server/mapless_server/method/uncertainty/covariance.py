"""The covariance of a pose.

The answer's covariance is that of world_from_camera in ROS's order (see `perturbation`), and is the sum of

    references   the dispersion of the poses that leave out one reference each (see `dispersion`): errors of reference
                 poses, lens models and shutters, which all points of a reference share. It includes the uncertainty of
                 the structure: other references observe other points, by other pixels.
    photograph   the noise of the photograph's own pixels, scaled by its residuals.
    scale        s^2 d d^T, d = camera centre - centroid of the references, s the relative uncertainty of the metric
                 scale, for poses that depend on the scale rather than on triangulated points: initial poses, and poses
                 from predicted points (`no_structure`). Otherwise the references' poses determine the scale, and their
                 errors are in the dispersion.
    offset       o o^T, o the Gauss-Newton step from the pose to its optimum: zero at the optimum, and the error to
                 expect of an initial pose that is answered as it is.
    shared       errors that all references and the photograph share (one lens model, one survey), which no dispersion
                 shows and which do not average out over matches. Observed in positions: they are never more accurate
                 than `shared_matches` independent matches at the structure's noise would make them.

With K references a covariance of six numbers from K poses is rough, so the dispersion C is shrunk halfway towards the
covariance of independent matches, H^-1 (points eliminated, references fixed), scaled to the size of C in units of H^-1
(Ledoit and Wolf 2004, with another measure of size):

    (1 - a) C + a i^2 H^-1,    i^2 = trace(H C) / 6.

With simulated noise of pixels and of reference poses, the sum of C and the photograph's part is right within a quarter
(the tests). The shrunk covariance is larger than that, and right for photographs: their errors in poorly determined
directions are larger than the dispersion of the references.

Three factors remain: on the standard deviations of positions and of angles, and on the radii of 95 %, because errors
have heavier tails than the normal distribution. `research.radii` measures them on scenes with known poses, each tested
on a scene that it was not measured on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform

from ..observations import linearize
from ..options import check_bounds
from ..perturbation import pose_hessian, world_covariance, world_jacobian
from ..priors.known import NO_PRIORS, Priors
from ..results import MetricScale, PoseEstimate, PoseStage, Support, Uncertainty
from ..structure import observe, tracks_with_query
from ..views import PosedView
from .dispersion import Dispersion, JackknifeInput, disperse, jackknife_input


@dataclass(frozen=True)
class UncertaintyOptions:
    """Options of the covariance.

    Attributes:
        shrinkage: a, of the dispersion towards the covariance of independent matches. Between a third and two thirds no
            difference is measurable on some hundred photographs.
        shared_matches: number of independent matches beyond which positions do not become more accurate. Without this
            bound standard deviations in the two surveyed scenes, with a thousand inliers, are half the errors.
        position_factor, rotation_factor: on standard deviations, from `research.radii`.
        max_matches: of the photograph, evenly thinned; the time is linear in it, and the references' errors are the
            same in all of them.
        loss_scale_sigma: of the Cauchy loss that weights matches, for poses without an adjustment.
        max_error_px: matches with a larger error are not used, for such poses.
    """

    shrinkage: float = 0.5
    shared_matches: float = 33.0
    position_factor: float = 0.99
    rotation_factor: float = 1.79
    max_matches: int = 800
    loss_scale_sigma: float = 1.4
    max_error_px: float = 8.0

    def __post_init__(self) -> None:
        check_bounds(self, "shared_matches max_matches position_factor rotation_factor", above=0)
        check_bounds(self, "loss_scale_sigma max_error_px", above=0)
        check_bounds(self, "shrinkage", at_least=0, at_most=1)


def uncertainty_of(
    jackknife: JackknifeInput,
    world_from_camera: RigidTransform,
    one_match: Array,
    options: UncertaintyOptions,
    is_offset: bool = False,
) -> Uncertainty | None:
    """All parts of a pose's covariance but that of the scale, with the factors.

    Args:
        jackknife: its observations; the unknowns are a left perturbation (v, w) of camera_from_world.
        world_from_camera: the pose.
        one_match: see `one_match_covariance`, at the structure's noise.
        options: see there.
        is_offset: whether the pose is known not to be at its optimum.

    Returns:
        The covariance; None if the observations do not determine a pose.
    """
    dispersion = disperse(jackknife)
    if dispersion is None:
        return None
    to_world = world_jacobian(world_from_camera)
    covariance = to_world @ covariance_of(dispersion, options.shrinkage) @ to_world.T
    if is_offset:
        covariance += np.outer(to_world @ dispersion.offset, to_world @ dispersion.offset)
    covariance[:3, :3] += one_match[:3, :3] / options.shared_matches
    factor = np.repeat([options.position_factor, options.rotation_factor], 3)
    covariance = factor[:, None] * (covariance + covariance.T) / 2 * factor
    motions = dispersion.motions @ to_world.T
    return Uncertainty(covariance, motions, dispersion.inflation)


def covariance_of(dispersion: Dispersion, shrinkage: float) -> Array:
    """(U, U) of the unknowns: Q + (1 - a) C + a i^2 H^-1."""
    independent = np.linalg.pinv(dispersion.information, hermitian=True)
    shrunk = (1 - shrinkage) * dispersion.covariance + shrinkage * dispersion.inflation**2 * independent
    return np.asarray(dispersion.photograph + shrunk)


def one_match_covariance(
    camera: Camera, world_from_camera: RigidTransform, x_in_world: Array, level_px: float
) -> Array:
    """Covariance (6, 6), in the world, of a pose with the information of one average match.

    Args:
        camera: pinhole.
        world_from_camera: the pose.
        x_in_world: (N, 3) points, in front of it, over which the information is averaged.
        level_px: standard deviation of each coordinate of a match.
    """
    information = pose_hessian(camera, world_from_camera, x_in_world) / max(len(x_in_world), 1)
    return world_covariance(information / level_px**2, world_from_camera)


def scale_covariance(world_from_camera: RigidTransform, centroid: Array, relative_sigma: float) -> Array:
    """s^2 d d^T as (6, 6), for a pose whose distance d from the references' centroid (3,) depends on the scale."""
    covariance = np.zeros((6, 6))
    arm = world_from_camera.translation - centroid
    covariance[:3, :3] = relative_sigma**2 * np.outer(arm, arm)
    return covariance


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
        scale: its metric scale, whose deviation is used as its relative standard deviation.
        options: see there.
        priors: on the pose; those that were used reduce the covariance.
        points_are_predicted: whether the structure's points are predicted by the reconstruction, rather than
            triangulated from the references' poses.

    Raises:
        ValueError: there is no estimate.
    """
    estimate = support.estimate
    if estimate is None:
        raise ValueError("support.estimate must not be None")
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
