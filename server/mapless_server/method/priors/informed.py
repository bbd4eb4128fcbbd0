"""Poses that priors find, whether one of them is better, and the best one refined with the priors.

A pose that priors bring must explain more than the one that the photograph gave; what priors say against a pose counts
like one match and no more. The winner is compared with each prior by the pose that the photograph alone gives in its
place, and refined with those that are consistent with it. So a wrong prior costs nothing: it is found to be one and not
used, and then the answer is, to the last bit, the one without it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform

from ..options import check_bounds
from ..perturbation import reprojection_errors_px
from .gravity import ransac_with_gravity
from .known import NO_PRIORS, PriorCheck, Priors
from .pose_only import PoseOnlyOptions, information, refine_pose

SOMEWHERE = np.diag([1e-6] * 3 + [1e-2] * 3)
"""Information of a pose of which nothing is known: within kilometres, turned in any way."""


@dataclass(frozen=True)
class InformedOptions:
    """Options of what is done with priors.

    Attributes:
        inlier_px: largest reprojection error of a right match.
        refine: how poses are refined.
        min_inliers: fewer give no pose.
        enough_inliers: priors are not asked for poses of their own if one has been found with so many: nothing that
            they bring could win. Repeated structure has fooled no more than 23 matches.
        min_kept_share: a refinement without priors that loses more of the inliers has run off: then the photograph
            alone gives no pose here, and priors are compared with the one that they helped to find.
    """

    inlier_px: float = 4.0
    refine: PoseOnlyOptions = field(default_factory=PoseOnlyOptions)
    min_inliers: int = 4
    enough_inliers: int = 50
    min_kept_share: float = 0.8

    def __post_init__(self) -> None:
        check_bounds(self, "inlier_px", above=0)
        check_bounds(self, "min_inliers", at_least=3)
        check_bounds(self, "min_kept_share", above=0, at_most=1)

    @property
    def worst_cost(self) -> float:
        """What a match that does not agree with a pose counts against it."""
        return (self.inlier_px / self.refine.sigma_px) ** 2


@dataclass(frozen=True, eq=False)
class InformedPose:
    """A pose with everything that is consistent with it.

    Attributes:
        world_from_camera: metric.
        without_priors: the same before priors were used.
        checks: of each prior.
        used: those that took part.
    """

    world_from_camera: RigidTransform
    without_priors: RigidTransform
    checks: tuple[PriorCheck, ...]
    used: Priors


def informed_pose(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    found: RigidTransform | None,
    priors: Priors,
    options: InformedOptions,
) -> InformedPose | None:
    """The best pose that the photograph and the priors find together; None if neither finds any.

    Args:
        camera: pinhole.
        x_in_world: (N, 3) points.
        pixels: (N, 2) where they are seen.
        found: world_from_camera that the photograph gave alone; None if it gave none.
        priors: what is known.
        options: see there.
    """
    support = 0 if found is None else supporting(camera, x_in_world, pixels, found, options)
    others = [] if support >= options.enough_inliers else _from_priors(camera, x_in_world, pixels, priors, options)
    best = found
    if others:
        costs = [_cost(camera, x_in_world, pixels, pose, priors, options) for pose in others]
        # One match more, or it is the same pose found in another way.
        least = math.inf if found is None else _cost(camera, x_in_world, pixels, found, priors, options)
        if min(costs) < least - options.worst_cost:
            best = others[int(np.argmin(costs))]
    return None if best is None else use_priors(camera, x_in_world, pixels, best, priors, options)


def _from_priors(
    camera: Camera, x_in_world: Array, pixels: Array, priors: Priors, options: InformedOptions
) -> list[RigidTransform]:
    """Gravity finds poses; a prior on the whole pose is one."""
    poses = []
    if priors.pose:
        poses.append(refine_pose(camera, x_in_world, pixels, priors.pose.world_from_camera, priors, options.refine))
    if priors.gravity:
        poses += ransac_with_gravity(camera, x_in_world, pixels, priors, options.inlier_px)
    return poses


def _cost(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    world_from_camera: RigidTransform,
    priors: Priors,
    options: InformedOptions,
) -> float:
    """What matches and priors say against a pose: squared errors in units of a keypoint's, and `Priors.penalty`.

    No match counts for more than an outlier does.
    """
    errors_px = reprojection_errors_px(camera, world_from_camera, x_in_world, pixels)
    squared = (np.where(errors_px < options.inlier_px, errors_px, options.inlier_px) / options.refine.sigma_px) ** 2
    return float(squared.sum()) + priors.penalty(world_from_camera)


def use_priors(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    world_from_camera: RigidTransform,
    priors: Priors,
    options: InformedOptions,
) -> InformedPose:
    """A pose that at least `min_inliers` matches support, with priors checked and the consistent ones used."""
    alone = refine_pose(camera, x_in_world, pixels, world_from_camera, NO_PRIORS, options.refine)
    before, after = (supporting(camera, x_in_world, pixels, it, options) for it in (world_from_camera, alone))
    if after < max(options.min_inliers, options.min_kept_share * before):
        alone = world_from_camera
    found = information(camera, x_in_world, pixels, alone, options.refine)
    covariance = np.linalg.inv(found / options.refine.prior_weight + SOMEWHERE)
    checks = priors.check(alone, np.asarray(covariance, np.float64))
    used = priors.consistent(checks)
    refined = world_from_camera
    if used:
        refined = refine_pose(camera, x_in_world, pixels, world_from_camera, used, options.refine)
    return InformedPose(refined, world_from_camera, checks, used)


def supporting(
    camera: Camera, x_in_world: Array, pixels: Array, world_from_camera: RigidTransform, options: InformedOptions
) -> int:
    """How many matches agree with a pose."""
    return int((reprojection_errors_px(camera, world_from_camera, x_in_world, pixels) < options.inlier_px).sum())
