"""Poses of several cameras as one: generalized PnP by PoseLib.

A generalized camera is a set of rays without a common centre: those of all cameras, in the frame that they are fixed
to. Three 2D-3D matches of any of the cameras determine its pose (gp3p), four also the unit of that frame (gp4ps):

    lambda_i d_i + s p_i = rig_from_world x_i

for a match's ray from p_i in the direction d_i, in the frame's unit, and its point x_i in metres; s is metres per unit.
"""

import ctypes
import math
import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np
import poselib
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, Similarity

from ..features.views import Rows
from ..structure.model import PixelPoints
from .pnp import REFINEMENT, PnpOptions, inverse_of, iterations_between, poselib_camera, poselib_pose
from .with_priors import samples_needed

SAMPLE = 4
"""Matches that determine a pose and the unit of the frame."""

_libc = ctypes.CDLL(None)
_rand_lock = threading.Lock()


@dataclass(frozen=True, eq=False)
class CameraMatches:
    """One camera of a group, with M matches, and its pose in the rig; metres, or units of the rig's frame."""

    seen: PixelPoints
    rig_from_camera: RigidTransform

    def inliers(self, world_from_rig: RigidTransform | Similarity, inlier_px: float) -> NDArray[np.bool_]:
        """Mask (M,) of the matches that are inliers of a pose."""
        return self.seen.errors_px(camera_in_world(world_from_rig, self.rig_from_camera)) < inlier_px

    def __len__(self) -> int:
        return len(self.seen)

    def __getitem__(self, rows: Rows) -> "CameraMatches":
        return CameraMatches(self.seen[rows], self.rig_from_camera)


def camera_in_world(world_from_rig: RigidTransform | Similarity, rig_from_camera: RigidTransform) -> RigidTransform:
    """Metric `world_from_camera` of a camera of the rig."""
    if isinstance(world_from_rig, Similarity):
        return world_from_rig.transform_pose(rig_from_camera)
    return world_from_rig.compose(rig_from_camera)


def inlier_count(
    cameras: Sequence[CameraMatches], world_from_rig: RigidTransform | Similarity, inlier_px: float
) -> int:
    """Number of inliers of a pose, over all cameras."""
    return sum(int(camera.inliers(world_from_rig, inlier_px).sum()) for camera in cameras)


def rig_ransac(cameras: Sequence[CameraMatches], options: PnpOptions) -> RigidTransform | None:
    """Estimates `world_from_rig` by gp3p in RANSAC with a final Cauchy refinement; None without a finite pose."""
    cameras = _bounded(cameras, options.max_matches)
    if sum(len(camera) for camera in cameras) < 3:
        return None
    with _repeatable():
        pose, _ = poselib.estimate_generalized_absolute_pose(
            [camera.seen.pixels for camera in cameras],
            [camera.seen.x_in_world for camera in cameras],
            [poselib_pose(camera.rig_from_camera.inverse()) for camera in cameras],
            [poselib_camera(camera.seen.camera) for camera in cameras],
            {
                "max_reproj_error": options.inlier_px,
                **iterations_between(options.min_iterations, options.max_iterations),
            },
            REFINEMENT,
        )
    return inverse_of(pose)


def scaled_ransac(cameras: Sequence[CameraMatches], options: PnpOptions) -> Similarity | None:
    """Estimates the similarity `world_from_rig` by gp4ps in our own RANSAC; PoseLib has the solver, but no estimator.

    `rig_from_camera` of the cameras is in any common unit. Returns the pose with the most inliers; None if none has a
    scale above zero, which cameras at one place do not determine.
    """
    cameras = _bounded(cameras, options.max_matches)
    rays = np.concatenate([_rays(camera) for camera in cameras])
    starts = np.concatenate(
        [np.broadcast_to(camera.rig_from_camera.translation, (len(camera), 3)) for camera in cameras]
    )
    points = np.concatenate([camera.seen.x_in_world for camera in cameras])
    owner = np.repeat(np.arange(len(cameras)), [len(camera) for camera in cameras])
    if len(points) < SAMPLE or len(np.unique(owner)) < 2:
        return None
    random, best, best_count, needed = np.random.default_rng(0), None, SAMPLE - 1, math.inf
    for iteration in range(options.max_iterations):
        if iteration >= needed:
            break
        sample = random.choice(len(points), SAMPLE, replace=False)
        if len(np.unique(owner[sample])) < 2:
            continue
        with _repeatable():
            solutions = poselib.gp4ps(starts[sample], rays[sample], points[sample], True)
        for pose, scale in zip(*solutions, strict=True):
            world_from_rig = _similarity(pose, scale)
            count = inlier_count(cameras, world_from_rig, options.inlier_px) if world_from_rig else 0
            if count > best_count:
                best, best_count = world_from_rig, count
                # Half of all samples are of a single camera.
                needed = samples_needed((count / len(points)) ** SAMPLE / 2)
    return best


@contextmanager
def _repeatable() -> Iterator[None]:
    """Makes PoseLib's generalized solvers repeatable: they take random numbers of the C library, whatever the seed."""
    with _rand_lock:
        _libc.srand(0)
        yield


def _bounded(cameras: Sequence[CameraMatches], max_matches: int) -> list[CameraMatches]:
    step = -(-sum(len(camera) for camera in cameras) // max_matches)
    return [camera[:: max(1, step)] for camera in cameras]


def _rays(camera: CameraMatches) -> Array:
    """Unit directions (M, 3) of the matches' rays in the rig's axes."""
    rays = camera.seen.camera.rays(camera.seen.pixels) @ camera.rig_from_camera.rotation.T
    return np.asarray(rays / np.linalg.norm(rays, axis=1, keepdims=True))


def _similarity(pose: poselib.CameraPose, scale: float) -> Similarity | None:
    world_from_rig = inverse_of(pose)
    if world_from_rig is None or not (math.isfinite(scale) and scale > 0):
        return None
    return Similarity(scale, world_from_rig.rotation, world_from_rig.translation)
