"""Unknowns of a bundle adjustment: poses of cameras, points, and errors of the query's intrinsics."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.bounds import check_bounds


@dataclass(frozen=True, eq=False)
class Poses:
    """The poses `camera_from_world` of several cameras: rotation (V, 3, 3), translation (V, 3)."""

    rotation: Array
    translation: Array

    @staticmethod
    def of(world_from_camera: Iterable[RigidTransform]) -> Poses:
        """Makes the poses from `world_from_camera` of each camera."""
        poses = [it.inverse() for it in world_from_camera]
        if not poses:
            return Poses(np.empty((0, 3, 3)), np.empty((0, 3)))
        return Poses(np.stack([it.rotation for it in poses]), np.stack([it.translation for it in poses]))

    def __getitem__(self, chosen: NDArray[np.intp] | slice) -> Poses:
        return Poses(self.rotation[chosen], self.translation[chosen])

    @property
    def centres(self) -> Array:
        """Centres (V, 3) of the cameras in the world."""
        return np.asarray(-np.einsum("vji,vj->vi", self.rotation, self.translation))

    def and_last(self, camera_from_world: RigidTransform) -> Poses:
        """Returns these poses with another one appended."""
        return Poses(
            np.concatenate([self.rotation, camera_from_world.rotation[None]]),
            np.concatenate([self.translation, camera_from_world.translation[None]]),
        )

    def moved(self, motion: Array) -> Poses:
        """Returns the poses after left perturbations (V, 6)."""
        turn = _rotations(motion[:, 3:])
        return Poses(turn @ self.rotation, (turn @ self.translation[:, :, None])[..., 0] + motion[:, :3])

    def motion_from(self, given: Poses) -> Array:
        """Left perturbations (V, 6) that move the poses `given` to these, if they are small."""
        turn = self.rotation @ np.swapaxes(given.rotation, 1, 2)
        shift = self.translation - (turn @ given.translation[:, :, None])[..., 0]
        skew = (turn - np.swapaxes(turn, 1, 2)) / 2
        return np.asarray(np.concatenate([shift, skew[:, [2, 0, 1], [1, 2, 0]]], axis=1))


@dataclass(frozen=True, eq=False)
class Bundle:
    """Values of the unknowns: cameras' poses (the query's last), points (P, 3), errors (I,) of intrinsics."""

    poses: Poses
    points: Array
    intrinsics: Array = field(default_factory=lambda: np.zeros(0))

    def moved(self, motion: Array, steps: Array, intrinsics: Array | None = None) -> Bundle:
        """Values after left perturbations (V, 6) of the poses, and steps (P, 3) of points and (I,) of intrinsics."""
        errors = self.intrinsics if intrinsics is None else self.intrinsics + intrinsics
        return Bundle(self.poses.moved(motion), self.points + steps, errors)

    @property
    def world_from_query(self) -> RigidTransform:
        """The query's pose."""
        return RigidTransform(self.poses.rotation[-1], self.poses.translation[-1]).inverse()


@dataclass(frozen=True)
class IntrinsicsSigma:
    """Standard deviations of a photograph's intrinsics.

    Attributes:
        focal_share: of both focal lengths together, as a share of them. Lenses change by this much with focus and
            temperature, and calibrations are not more repeatable.
        principal_share: of each coordinate of the principal point, as a share of the image's width.
        k1: of the first radial coefficient.
    """

    focal_share: float = 0.003
    principal_share: float = 0.003
    k1: float = 0.01

    def __post_init__(self) -> None:
        check_bounds(self, "focal_share principal_share k1", above=0, at_most=1)

    def of(self, camera: Camera) -> Array:
        """Standard deviations (4,) of s, of the principal point in pixels of this camera, and of k1."""
        principal_px = self.principal_share * camera.width_px
        return np.array([self.focal_share, principal_px, principal_px, self.k1])


def _rotations(vectors: Array) -> Array:
    """Rotations (V, 3, 3) about vectors (V, 3) as `rotation_from_vector` makes each, the same bits."""
    angles = np.sqrt(vectors[:, None] @ vectors[:, :, None]).ravel().tolist()
    small = [angle < 1e-8 for angle in angles]
    first = np.array([1.0 if s else math.sin(a) / a for s, a in zip(small, angles, strict=True)])
    second = np.array([0.5 if s else (1 - math.cos(a)) / a**2 for s, a in zip(small, angles, strict=True)])
    cross = np.zeros((len(vectors), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]], cross[:, [1, 2, 0], [2, 0, 1]] = vectors, -vectors
    return np.asarray(np.eye(3) + first[:, None, None] * cross + second[:, None, None] * cross @ cross)
