"""How far a pose may be off: its covariance, from what it rests on.

The answer's covariance is that of world_from_camera in ROS's order (see `perturbation`), and is the sum of

    references   the dispersion of the poses that leave out one reference each (see `dispersion`): errors of reference
                 poses, lens models and shutters, which all points of a reference share. In it is the structure's
                 uncertainty as well: other references see other points, and see them by other pixels.
    photograph   what its own pixels are off, scaled by its residuals.
    scale        s^2 d d^T, d = camera centre - centroid of the references, s the relative uncertainty of the metric
                 scale: where the scale, and not points that the references triangulate, places the camera. That is so
                 of initial poses and of predicted points (`no_structure`). Elsewhere the references' poses are the
                 yardstick, and what they are off is in their dispersion.
    offset       o o^T, o the Gauss-Newton step that would lead from the pose to its optimum: zero there, and what an
                 initial pose that is answered as it is may be off.
    shared       what all references and the photograph share, so that no dispersion shows it (one lens model, one
                 survey) does not average out over matches. It moves the camera, as observed: positions are never
                 better than `shared_matches` independent matches at the structure's noise would make them.

With K references a covariance of six numbers from K poses is rough, so the dispersion C is drawn halfway towards a
covariance of known shape, that of independent matches, H^-1 (points eliminated, references fixed), as large as C when
both are seen in units of the latter (Ledoit and Wolf 2004, with another measure of size):

    (1 - a) C + a i^2 H^-1,    i^2 = trace(H C) / 6.

Against planted noise, of pixels and of reference poses, the sum of C and the photograph's part is right within a
quarter (the tests). What is drawn towards i^2 H^-1 claims more than that where noise is as planted, and is what holds
on photographs: their errors are larger in poorly determined directions than the references' disagreement shows.

What remains are two factors on standard deviations, one for positions and one for angles, and one for the tail: errors
have heavier ones than the normal distribution. `research.radii` measures all three on scenes with
known poses, each tested on a scene that it was not measured on.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.special import gammaincinv

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
        shrinkage: a, of the dispersion towards the shape of independent matches: halfway. Between a third and two
            thirds no difference is measurable on some hundred photographs.
        shared_matches: so many independent matches are as good as any number. Without this bound positions of the two
            surveyed scenes, where a thousand matches agree, are claimed twice as exact as they are.
        position_factor, rotation_factor: on standard deviations; as `research.radii` prints them.
        max_matches: of the photograph that are looked at, evenly thinned; twice as many take twice the time, and the
            references' errors are in all of them.
        loss_scale_sigma: of the Cauchy loss that weighs matches, for poses without an adjustment.
        max_error_px: matches further from such a pose say nothing.
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
    """The references', the offset's and the shared part of a pose's covariance, with the factors.

    Args:
        jackknife: the observations it rests on; its unknowns a left perturbation (v, w) of camera_from_world.
        world_from_camera: the pose.
        one_match: (6, 6) covariance of the pose, in the world, if it rested on one match of average place at the
            structure's noise.
        options: see there.
        is_offset: whether the pose is known not to be at its optimum.

    Returns:
        None where the observations determine no pose.
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
    """Covariance (6, 6) of a pose, in the world, that rests on one match at this noise, of average place.

    Args:
        camera: pinhole.
        world_from_camera: the pose.
        x_in_world: (N, 3) points, in front of it, over which the information is averaged.
        level_px: standard deviation of a match, each coordinate.
    """
    information = pose_hessian(camera, world_from_camera, x_in_world) / max(len(x_in_world), 1)
    return world_covariance(information / level_px**2, world_from_camera)


def scale_covariance(world_from_camera: RigidTransform, centroid: Array, relative_sigma: float) -> Array:
    """s^2 d d^T as (6, 6): of a pose that a scale places at a distance d from the references' centroid (3,)."""
    covariance = np.zeros((6, 6))
    arm = world_from_camera.translation - centroid
    covariance[:3, :3] = relative_sigma**2 * np.outer(arm, arm)
    return covariance


TAIL_95 = 1.4
"""Errors have heavier tails than the normal distribution: by so much the radius for 95 % is larger than the
covariance's, which is right at 68 %. Measured by `research.radii`."""


@dataclass(frozen=True)
class Accuracy:
    """Errors not exceeded in 68 and 95 % of cases, if the covariance is right."""

    position_68_m: float
    position_95_m: float
    rotation_68_deg: float
    rotation_95_deg: float


def accuracy_from_covariance(covariance: Array) -> Accuracy:
    """Radii of a pose's covariance (6, 6): order x y z rx ry rz, metres and radians."""
    shares = np.array([0.68, 0.95])
    position_68_m, position_95_m = error_radii(covariance[:3, :3], shares).tolist()
    rotation_68, rotation_95 = error_radii(covariance[3:, 3:], shares).tolist()
    return Accuracy(
        position_68_m=position_68_m,
        position_95_m=TAIL_95 * position_95_m,
        rotation_68_deg=math.degrees(rotation_68),
        rotation_95_deg=TAIL_95 * math.degrees(rotation_95),
    )


def error_radius(covariance: Array, probability: float) -> float:
    """Length that a zero-mean normal vector with this covariance (n, n) does not exceed with this probability.

    The squared length is a sum of chi-squares weighted by the eigenvalues; it is taken as one scaled chi-square with
    the same mean and variance (Satterthwaite). Exact where all eigenvalues are equal or all but one vanish, within 4 %
    between.
    """
    return float(error_radii(covariance, np.array([probability]))[0])


def error_radii(covariance: Array, probabilities: Array) -> Array:
    """The same (P,) for each of some probabilities (P,)."""
    eigenvalues = np.linalg.eigvalsh(covariance).clip(min=0)
    total = float(eigenvalues.sum())
    if total <= 0:
        return np.zeros(len(probabilities))
    scale = float((eigenvalues**2).sum()) / total
    degrees_of_freedom = total / scale
    return np.asarray(np.sqrt(2 * scale * gammaincinv(degrees_of_freedom / 2, probabilities)), float)


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
