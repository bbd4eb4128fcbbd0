"""Candidates for a pose that what is known of it brings, which one is best, and how far priors pull it.

Priors have a say in which candidate wins, but never more than about one good match has. The winner is compared with
each prior by the pose that the photograph alone gives in its place, and pulled by those that are consistent with it. So
a wrong prior costs nothing: it is found to be one, and is not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform

from .gravity import ransac_with_gravity
from .pose_only import PoseOnlyOptions, information, refine_pose, reprojection_errors_px
from .priors import NO_PRIORS, PriorCheck, Priors

SOMEWHERE = np.diag([1e-6] * 3 + [1e-2] * 3)
"""Information of a pose of which nothing is known: within kilometres, turned in any way."""


@dataclass(frozen=True)
class InformedOptions:
    """Options of what is done with priors.

    Attributes:
        inlier_px: largest reprojection error of a right match.
        refine: how poses are refined.
        min_inliers: fewer give no pose.
        enough_inliers: gravity is not asked for poses of its own if one has been found with so many: nothing that it
            finds could win. Repeated structure has fooled no more than 23 matches.
        min_kept_share: a refinement without priors that loses more of the inliers has run off: then the photograph
            alone gives no pose here, and priors are compared with the one that they helped to find.
    """

    inlier_px: float = 4.0
    refine: PoseOnlyOptions = field(default_factory=PoseOnlyOptions)
    min_inliers: int = 4
    enough_inliers: int = 50
    min_kept_share: float = 0.8

    def __post_init__(self) -> None:
        if not (self.inlier_px > 0 and self.min_inliers >= 3 and 0 < self.min_kept_share <= 1):
            raise ValueError(f"senseless options: {self}")


@dataclass(frozen=True, eq=False)
class Pulled:
    """A pose with everything that is consistent with it.

    Attributes:
        world_from_camera: metric.
        checks: of each prior.
        used: those that pulled.
    """

    world_from_camera: RigidTransform
    checks: tuple[PriorCheck, ...]
    used: Priors


def informed_pose(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    found: Sequence[RigidTransform],
    priors: Priors,
    options: InformedOptions,
) -> Pulled | None:
    """The best of the poses found so far and of those that priors bring, pulled by the consistent ones; None if none.

    Args:
        camera: pinhole.
        x_in_world: (N, 3) points.
        pixels: (N, 2) where they are seen.
        found: world_from_camera of the candidates so far, possibly none.
        priors: what is known.
        options: see there.
    """
    candidates = [*found, *more_candidates(camera, x_in_world, pixels, found, priors, options)]
    if not candidates:
        return None
    best = candidates[least_contradicted(camera, x_in_world, pixels, candidates, priors, options)]
    return pull(camera, x_in_world, pixels, best, priors, options)


def more_candidates(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    found: Sequence[RigidTransform],
    priors: Priors,
    options: InformedOptions,
) -> list[RigidTransform]:
    """What else the pose may be: gravity finds some, a prior on the whole pose is one, and those found may be pulled.

    For the arguments see `informed_pose`.
    """
    starts = [*found, priors.pose.world_from_camera] if priors.pose else found
    poses = [refine_pose(camera, x_in_world, pixels, start, priors, options.refine) for start in starts]
    most = max((supporting(camera, x_in_world, pixels, pose, options) for pose in found), default=0)
    if priors.gravity and most < options.enough_inliers:
        poses += ransac_with_gravity(camera, x_in_world, pixels, priors, options.inlier_px)
    return poses


def least_contradicted(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    candidates: Sequence[RigidTransform],
    priors: Priors,
    options: InformedOptions,
) -> int:
    """Index of the candidate that matches and priors say least against; the first of several.

    That is the sum of squared errors in units of a keypoint's, none counted for more than an outlier's, and of what
    `Priors.penalty` counts.
    """
    costs = []
    for pose in candidates:
        errors_px = reprojection_errors_px(camera, pose, x_in_world, pixels)
        limited = np.where(errors_px < options.inlier_px, errors_px, options.inlier_px) / options.refine.sigma_px
        costs.append(float((limited**2).sum()) + priors.penalty(pose))
    return int(np.argmin(costs))


def pull(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    world_from_camera: RigidTransform,
    priors: Priors,
    options: InformedOptions,
) -> Pulled:
    """A pose that at least `min_inliers` matches support, with priors checked and the consistent ones used."""
    alone = refine_pose(camera, x_in_world, pixels, world_from_camera, NO_PRIORS, options.refine)
    before, after = (supporting(camera, x_in_world, pixels, it, options) for it in (world_from_camera, alone))
    if after < max(options.min_inliers, options.min_kept_share * before):
        alone = world_from_camera
    found = information(camera, x_in_world, pixels, alone, options.refine)
    checks = priors.check(alone, np.linalg.inv(found / options.refine.prior_weight + SOMEWHERE))
    used = priors.consistent(checks)
    if used:
        alone = refine_pose(camera, x_in_world, pixels, world_from_camera, used, options.refine)
    return Pulled(alone, checks, used)


def supporting(
    camera: Camera, x_in_world: Array, pixels: Array, world_from_camera: RigidTransform, options: InformedOptions
) -> int:
    """How many matches agree with a pose."""
    return int((reprojection_errors_px(camera, world_from_camera, x_in_world, pixels) < options.inlier_px).sum())
