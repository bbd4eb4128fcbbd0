"""Pose from two 2D-3D matches and gravity, in RANSAC; with few inliers, pairs need fewer samples than triples.

Gravity is known to about a degree, which is many pixels, so a pose from two matches is only a hypothesis: it is scored
with a tolerance as large as gravity's error in the image, and the best hypotheses are refined with gravity as one
measurement among others.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
import poselib
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform

from ..options import check_bounds
from .known import GravityPrior, Priors
from .pose_only import PoseOnlyOptions, refine_pose


@dataclass(frozen=True)
class GravityOptions:
    """Options of the two-point RANSAC.

    Attributes:
        max_matches: largest number of matches, evenly thinned; more do not improve the choice, and scoring is linear in
            it.
        batch: number of samples that are scored together.
        max_samples: largest number of samples; if 10 % of the matches are right, two right ones have then been drawn
            with 99.4 %.
        confidence: stop when two right matches have been drawn with this probability.
        refined: number of the best hypotheses to refine.
    """

    max_matches: int = 300
    batch: int = 64
    max_samples: int = 512
    confidence: float = 0.999
    refined: int = 3

    def __post_init__(self) -> None:
        check_bounds(self, "max_matches batch max_samples refined", at_least=1)
        check_bounds(self, "confidence", above=0, below=1)


def ransac_with_gravity(
    camera: Camera,
    x_in_world: Array,
    pixels: Array,
    priors: Priors,
    inlier_px: float,
    options: GravityOptions | None = None,
) -> list[RigidTransform]:
    """Finds the best hypotheses and refines them with all priors; none if no two matches give a pose.

    The camera is a pinhole camera; points (N, 3) in the world are seen at the pixels (N, 2). `inlier_px` is the largest
    reprojection error of a right match.
    """
    options = options or GravityOptions()
    gravity = priors.gravity
    if gravity is None:
        raise ValueError("there is no gravity prior")
    if len(pixels) < 2:
        return []
    step = -(-len(pixels) // options.max_matches)
    x_in_world, pixels = x_in_world[::step], pixels[::step]
    # An angle error in pixels; a shift of the camera compensates half of it.
    wide_px = math.hypot(inlier_px, 0.5 * camera.focal_x_px * min(gravity.sigma, 0.1))
    hypotheses = _Hypotheses(camera, x_in_world, pixels, wide_px, options.refined)
    rng = np.random.default_rng(0)
    rays = camera.rays(pixels)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    drawn, wanted = 0, float(options.max_samples)
    while drawn < min(wanted, options.max_samples):
        samples = _pairs(rng, len(pixels), options.batch)
        hypotheses.add(*solve_pairs(gravity, rays, x_in_world, samples))
        drawn += options.batch
        wanted = _samples_needed(hypotheses.inlier_share, options.confidence)
    return [_refined(camera, x_in_world, pixels, pose, priors, wide_px) for pose in hypotheses.best()]


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


def _samples_needed(inlier_share: float, confidence: float) -> float:
    """Number of samples after which two inliers have been drawn with this probability."""
    missed = 1 - inlier_share**2
    return math.log(1 - confidence) / math.log(missed) if 0 < missed < 1 else (math.inf if missed >= 1 else 1.0)


class _Hypotheses:
    """The best poses camera_from_world, by the truncated sum of their squared errors."""

    def __init__(self, camera: Camera, x_in_world: Array, pixels: Array, tolerance_px: float, kept: int) -> None:
        self._focal = np.array([camera.focal_x_px, camera.focal_y_px])
        self._ideal = camera.rays(pixels)[:, :2]
        self._x_in_world, self._tolerance_px, self._kept = x_in_world, tolerance_px, kept
        self._costs, self._poses = np.zeros(0), np.zeros((0, 3, 4))
        self.inlier_share = 0.0

    def add(self, rotation: Array, translation: Array) -> None:
        """Scores poses with rotations (H, 3, 3) and translations (H, 3), and keeps the best."""
        if not len(rotation):
            return
        x, y, z = np.moveaxis(rotation @ self._x_in_world.T + translation[:, :, None], 1, 0)  # (H, N) each
        depth = np.where(z > 0, z, np.nan)
        squared = ((x / depth - self._ideal[:, 0]) * self._focal[0]) ** 2
        squared += ((y / depth - self._ideal[:, 1]) * self._focal[1]) ** 2
        limit = self._tolerance_px**2
        inlier = squared < limit
        costs = np.where(inlier, squared, limit).sum(axis=1)
        self.inlier_share = max(self.inlier_share, float(inlier.mean(axis=1).max()))
        poses = np.concatenate([rotation, translation[:, :, None]], axis=2)
        self._costs, self._poses = np.append(self._costs, costs), np.concatenate([self._poses, poses])
        order = np.argsort(self._costs, kind="stable")[: self._kept]
        self._costs, self._poses = self._costs[order], self._poses[order]

    def best(self) -> list[RigidTransform]:
        """Returns world_from_camera of the best hypotheses, the best first."""
        return [RigidTransform(pose[:, :3], pose[:, 3]).inverse() for pose in self._poses]


def _refined(
    camera: Camera, x_in_world: Array, pixels: Array, pose: RigidTransform, priors: Priors, wide_px: float
) -> RigidTransform:
    """Refines a hypothesis, first with a loss as wide as gravity's error, then with a narrow one."""
    options = PoseOnlyOptions()
    for loss_px in (wide_px / 2, options.loss_scale_sigma * options.sigma_px):
        with_loss = replace(options, loss_scale_sigma=max(loss_px / options.sigma_px, options.loss_scale_sigma))
        pose = refine_pose(camera, x_in_world, pixels, pose, priors, with_loss)
    return pose
