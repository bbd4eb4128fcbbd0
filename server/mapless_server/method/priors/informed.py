"""Pose estimation with priors: candidates from priors, the best candidate, and its refinement with the priors.

A candidate from priors must explain more matches than the pose from the photograph; a prior's cost counts at most as
much as one match. The best pose is refined without priors, compared with each prior, and refined with the consistent
ones. So a wrong prior does no harm: it is not used, and the answer equals the one without it bit for bit.
"""

import math
from dataclasses import dataclass, field

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform

from ..options import check_bounds
from ..perturbation import reprojection_errors_px
from .gravity import ransac_with_gravity
from .known import NO_PRIORS, PriorCheck, Priors
from .pose_only import PoseOnlyOptions, information, refine_pose

WEAK_INFORMATION = np.diag([1e-6] * 3 + [1e-2] * 3)
"""Information of an unknown pose: within kilometres, of any orientation."""


@dataclass(frozen=True)
class InformedOptions:
    """Options of pose estimation with priors.

    Attributes:
        inlier_px: largest reprojection error of a right match.
        refine: options of the refinement.
        min_inliers: fewer give no pose.
        enough_inliers: with so many inliers no candidates from priors are tried, since none could be better. Repeated
            structure has supported wrong poses with at most 23 matches.
        min_kept_share: a refinement without priors that keeps a smaller share of the inliers has diverged; priors are
            then compared with the pose before it.
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
        """Cost of a match that is an outlier."""
        return (self.inlier_px / self.refine.sigma_px) ** 2


@dataclass(frozen=True, eq=False)
class InformedPose:
    """A pose refined with the priors that are consistent with it.

    Attributes:
        world_from_camera: metric.
        without_priors: the pose before priors were used.
        checks: comparison with each prior.
        used: the priors that were used.
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
    """Chooses between the pose from the photograph and those from priors; None if there is none.

    The camera is a pinhole camera; points (N, 3) in the world are seen at the pixels (N, 2). `found` is
    world_from_camera from the photograph alone; None if there is none.
    """
    support = 0 if found is None else inlier_count(camera, x_in_world, pixels, found, options)
    others = [] if support >= options.enough_inliers else _from_priors(camera, x_in_world, pixels, priors, options)
    best = found
    if others:
        costs = [_cost(camera, x_in_world, pixels, pose, priors, options) for pose in others]
        # Better by one match at least; otherwise it is the same pose found in another way.
        least = math.inf if found is None else _cost(camera, x_in_world, pixels, found, priors, options)
        if min(costs) < least - options.worst_cost:
            best = others[int(np.argmin(costs))]
    return None if best is None else use_priors(camera, x_in_world, pixels, best, priors, options)


def _from_priors(
    camera: Camera, x_in_world: Array, pixels: Array, priors: Priors, options: InformedOptions
) -> list[RigidTransform]:
    """Candidates from priors: the pose prior, and poses by RANSAC with gravity."""
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
    """Truncated sum of squared reprojection errors, in standard deviations of a keypoint, plus `Priors.penalty`."""
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
    """Checks the priors and refines a pose, which has `min_inliers` inliers or more, with the consistent ones."""
    alone = refine_pose(camera, x_in_world, pixels, world_from_camera, NO_PRIORS, options.refine)
    before, after = (inlier_count(camera, x_in_world, pixels, it, options) for it in (world_from_camera, alone))
    if after < max(options.min_inliers, options.min_kept_share * before):
        alone = world_from_camera
    found = information(camera, x_in_world, pixels, alone, options.refine)
    covariance = np.linalg.inv(found / options.refine.prior_weight + WEAK_INFORMATION)
    checks = priors.check(alone, np.asarray(covariance, np.float64))
    used = priors.consistent(checks)
    refined = world_from_camera
    if used:
        refined = refine_pose(camera, x_in_world, pixels, world_from_camera, used, options.refine)
    return InformedPose(refined, world_from_camera, checks, used)


def inlier_count(
    camera: Camera, x_in_world: Array, pixels: Array, world_from_camera: RigidTransform, options: InformedOptions
) -> int:
    """Number of inliers of a pose."""
    return int((reprojection_errors_px(camera, world_from_camera, x_in_world, pixels) < options.inlier_px).sum())
