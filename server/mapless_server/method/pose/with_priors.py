"""Pose estimation with priors: candidates from priors, the best candidate, and its refinement with the priors.

A candidate from priors must explain more matches than the pose from the photograph; a prior's cost counts at most as
much as one match. The best pose is refined without priors, compared with each prior, and refined with the consistent
ones. So a wrong prior does no harm: it is not used, and the answer equals the one without it bit for bit.

The refinement has fixed points, and the pose alone as unknowns (PoseLib's has no priors):

    min  sum_i rho(|u_i - pi(P, X_i)|^2) + w sum_k r_k^T C_k^-1 r_k,    rho(s) = c^2 log(1 + s / c^2)

With few inliers, RANSAC also draws poses from two matches and gravity, which need fewer samples than three matches.
Gravity is known to about a degree, which is many pixels, so they are scored with a tolerance as large as gravity's
error in the image, and the best are refined with gravity as one measurement among others.
"""

import math
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..bundle.pose_problem import AdjustOptions
from ..bundle.priors import NO_PRIORS, GravityPrior, PriorCheck, Priors
from ..features.limits import MIN_INLIERS
from ..optim.optimize import (
    MinimizeOptions,
    cauchy_cost,
    cauchy_weight,
    damped_step,
    minimize,
    moved,
    pose_jacobian,
    world_jacobian,
)
from ..structure.model import PixelPoints

LOSS_SCALE_PX = AdjustOptions.loss_scale_sigma
"""Scale c of the Cauchy loss; a right match has a standard deviation of one pixel."""

PRIOR_WEIGHT = AdjustOptions.error_inflation**2
"""The factor w by which the matches have less information than if their errors were independent."""

STEPS = MinimizeOptions(iterations=10, min_decrease=1e-4)
"""Steps of a refinement with priors."""

ENOUGH_INLIERS = 50
"""With so many no candidates from priors are tried: more than repeated structure gives a wrong pose."""

WEAK_INFORMATION = np.diag([1e-6] * 3 + [1e-2] * 3)
"""Information of an unknown pose: within kilometres, of any orientation."""

MAX_MATCHES = 300
"""Largest number for RANSAC with gravity, and of each photograph of a group, evenly thinned; more do not improve the
choice, and scoring is linear in them."""

BATCH, MAX_SAMPLES = 64, 512
"""Samples that are scored together, and at most."""

CONFIDENCE = 0.999
"""Probability that a sample of right matches has been drawn with which sampling stops."""

REFINED = 3
"""Number of the best hypotheses that are refined."""


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
    seen: PixelPoints, found: RigidTransform | None, priors: Priors, inlier_px: float
) -> InformedPose | None:
    """Chooses between the pose `found` from the photograph alone and those from priors; None if there is none.

    `inlier_px` is the largest reprojection error of a right match.
    """

    def cost(pose: RigidTransform) -> float:
        """Truncated sum of squared errors, in standard deviations of a keypoint, plus `Priors.penalty`."""
        errors_px = seen.errors_px(pose)
        squared = np.where(errors_px < inlier_px, errors_px, inlier_px) ** 2
        return float(squared.sum()) + priors.penalty(pose)

    best, others = found, list[RigidTransform]()
    if found is None or seen.inlier_count(found, inlier_px) < ENOUGH_INLIERS:
        if priors.pose:
            others.append(refine_pose(seen, priors.pose.world_from_camera, priors))
        if priors.gravity:
            others += ransac_with_gravity(seen, priors.gravity, priors, inlier_px)
    if others:
        costs = [cost(pose) for pose in others]
        # Better by one match at least; otherwise it is the same pose found in another way.
        least = math.inf if found is None else cost(found)
        if min(costs) < least - inlier_px**2:
            best = others[int(np.argmin(costs))]
    return None if best is None else _with_priors(seen, best, priors, inlier_px)


def _with_priors(seen: PixelPoints, pose: RigidTransform, priors: Priors, inlier_px: float) -> InformedPose:
    """Checks the priors and refines a pose, which has `MIN_INLIERS` inliers or more, with the consistent ones.

    A refinement without priors that keeps a small share of the inliers has diverged; priors are then compared with the
    pose before it.
    """
    alone = refine_pose(seen, pose, NO_PRIORS)
    before, after = (seen.inlier_count(it, inlier_px) for it in (pose, alone))
    if after < max(MIN_INLIERS, AdjustOptions.min_kept_share * before):
        alone = pose
    # The inverse covariance of the pose error if the matches' errors were independent.
    information = _Problem(seen, alone, NO_PRIORS, LOSS_SCALE_PX).linearize(alone)[1]
    covariance = np.linalg.inv(information / PRIOR_WEIGHT + WEAK_INFORMATION)
    checks = priors.check(alone, np.asarray(covariance, np.float64))
    used = priors.consistent(checks)
    return InformedPose(refine_pose(seen, pose, used) if used else pose, pose, checks, used)


def refine_pose(
    seen: PixelPoints, world_from_camera: RigidTransform, priors: Priors, loss_scale_px: float = LOSS_SCALE_PX
) -> RigidTransform:
    """Minimizes the cost, starting from a pose; all priors are used, and no points behind the camera at the start."""
    return minimize(_Problem(seen, world_from_camera, priors, loss_scale_px), world_from_camera, STEPS)


class _Problem:
    """The cost and its derivatives by the pose error; see `optimize.Problem`."""

    def __init__(self, seen: PixelPoints, start: RigidTransform, priors: Priors, loss_scale_px: float) -> None:
        self.seen = seen[start.inverse().apply(seen.x_in_world)[:, 2] > 0]
        self.priors, self.loss_scale_px = priors, loss_scale_px

    def residuals(self, pose: RigidTransform) -> tuple[Array, Array]:
        """Points in the camera frame (N, 3), and reprojection errors (N, 2), pixels."""
        x_in_camera = (self.seen.x_in_world - pose.translation) @ pose.rotation
        return x_in_camera, self.seen.camera.project(x_in_camera) - self.seen.pixels

    def cost(self, pose: RigidTransform) -> float:
        """Cost at a pose; NaN if a point is behind the camera, so that the step is rejected."""
        _, residual = self.residuals(pose)
        matched = cauchy_cost((residual**2).sum(axis=1), self.loss_scale_px)
        return matched + PRIOR_WEIGHT * self.priors.cost(pose)

    def linearize(self, pose: RigidTransform) -> tuple[Array, Array]:
        """Half the cost's gradient (6,) and its information (6, 6), in ROS's order."""
        x_in_camera, residual = self.residuals(pose)
        weight = cauchy_weight((residual**2).sum(axis=1), self.loss_scale_px)
        jacobian = pose_jacobian(self.seen.camera, x_in_camera)
        weighted, to_camera = weight * jacobian, np.linalg.inv(world_jacobian(pose))
        by_pose = weighted[0] @ residual[:, 0] + weighted[1] @ residual[:, 1]
        hessian = weighted[0] @ jacobian[0].T + weighted[1] @ jacobian[1].T
        gradient, information = self.priors.gradient_and_information(pose)
        return (
            to_camera.T @ by_pose + PRIOR_WEIGHT * gradient,
            to_camera.T @ hessian @ to_camera + PRIOR_WEIGHT * information,
        )

    def step(self, pose: RigidTransform, equations: tuple[Array, Array], damping: float) -> RigidTransform | None:
        """See `optimize.Problem`."""
        gradient, hessian = equations
        error = damped_step(hessian, gradient, damping)
        return None if error is None else moved(pose, error)


def ransac_with_gravity(
    seen: PixelPoints, gravity: GravityPrior, priors: Priors, inlier_px: float
) -> list[RigidTransform]:
    """Finds the best hypotheses and refines them with all priors; none if no two matches give a pose.

    `inlier_px` is the largest reprojection error of a right match.
    """
    if len(seen) < 2:
        return []
    seen = seen[:: -(-len(seen) // MAX_MATCHES)]
    # An angle error in pixels; a shift of the camera compensates half of it.
    wide_px = math.hypot(inlier_px, 0.5 * seen.camera.focal_x_px * min(gravity.sigma, 0.1))
    rng = np.random.default_rng(0)
    rays = seen.camera.rays(seen.pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    best, costs, inlier_share, drawn = np.zeros((0, 3, 4)), np.zeros(0), 0.0, 0
    while drawn < min(samples_needed(inlier_share**2), MAX_SAMPLES):
        rotation, translation = solve_pairs(gravity, rays, seen.x_in_world, _pairs(rng, len(seen), BATCH))
        drawn += BATCH
        squared = _squared_errors(seen, rotation, translation)
        inlier = squared < wide_px**2
        inlier_share = float(inlier.mean(axis=1).max(initial=inlier_share))
        costs = np.append(costs, np.where(inlier, squared, wide_px**2).sum(axis=1))
        best = np.concatenate([best, np.concatenate([rotation, translation[:, :, None]], axis=2)])
        order = np.argsort(costs, kind="stable")[:REFINED]
        best, costs = best[order], costs[order]
    poses = [RigidTransform(pose[:, :3], pose[:, 3]).inverse() for pose in best]
    # Refined first with a loss as wide as gravity's error, then with a narrow one.
    for scale_px in (max(wide_px / 2, LOSS_SCALE_PX), LOSS_SCALE_PX):
        poses = [refine_pose(seen, pose, priors, scale_px) for pose in poses]
    return poses


def solve_pairs(gravity: GravityPrior, rays: Array, x_in_world: Array, pairs: NDArray[np.int64]) -> tuple[Array, Array]:
    """Poses that see two points along two rays, with the direction of gravity, down, given in both frames.

    PoseLib's solver (Kukelova et al., "Closed-form solutions to minimal absolute pose problems with known vertical
    direction", ACCV 2010) takes both frames with their y axes along the vertical, both up or both down. Points (N, 3),
    viewing rays (N, 3) of unit length in the camera, pairs (S, 2) of their indices. Returns rotations (H, 3, 3) and
    translations (H, 3) of camera_from_world, none to two for each pair.
    """
    from_camera, from_world = _to_y(gravity.in_camera), _to_y(gravity.in_world)
    turned_rays, turned_points = rays @ from_camera.T, x_in_world @ from_world.T
    poses = [pose for pair in pairs for pose in poselib.up2p(turned_rays[pair], turned_points[pair])]
    if not poses:
        return np.zeros((0, 3, 3)), np.zeros((0, 3))
    rotation = from_camera.T @ np.stack([pose.R for pose in poses]) @ from_world
    translation = np.stack([pose.t for pose in poses]) @ from_camera
    finite = np.isfinite(rotation).all(axis=(1, 2)) & np.isfinite(translation).all(axis=1)
    return rotation[finite], translation[finite]


def _to_y(direction: Array) -> Array:
    """A rotation (3, 3) that maps a direction of unit length to the y axis."""
    # The other two axes are arbitrary; the cross product with the least parallel axis is the most accurate.
    other = np.eye(3)[int(np.argmin(np.abs(direction)))]
    x = np.cross(direction, other)
    x /= np.linalg.norm(x)
    return np.stack([x, direction, np.cross(x, direction)])


def _pairs(rng: np.random.Generator, count: int, size: int) -> NDArray[np.int64]:
    """Draws pairs (size, 2) of two different indices below `count`."""
    first = rng.integers(count, size=size)
    return np.stack([first, (first + rng.integers(1, count, size=size)) % count], axis=1)


def samples_needed(good_share: float) -> float:
    """Number of samples after which a good one has been drawn with probability `CONFIDENCE`, if this share is good."""
    if not 0 < good_share < 1:
        return 1.0 if good_share >= 1 else math.inf
    return math.log(1 - CONFIDENCE) / math.log1p(-good_share)


def _squared_errors(seen: PixelPoints, rotation: Array, translation: Array) -> Array:
    """Squared errors (H, N) of poses camera_from_world (H, 3, 3) and (H, 3), square pixels; NaN behind the camera."""
    x, y, z = np.moveaxis(rotation @ seen.x_in_world.T + translation[:, :, None], 1, 0)  # (H, N) each
    depth, ideal = np.where(z > 0, z, np.nan), seen.camera.rays(seen.pixels)
    squared = ((x / depth - ideal[:, 0]) * seen.camera.focal_x_px) ** 2
    squared += ((y / depth - ideal[:, 1]) * seen.camera.focal_y_px) ** 2
    return np.asarray(squared)
