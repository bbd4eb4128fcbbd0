"""The conventions of mapless, stated once: frames, transforms, cameras, projection.

* Cameras look along +z, x points right, y points down (OpenCV). World frames are right-handed and metric.
* A transform is named target_from_source and a point for its frame: ``x_in_world = world_from_camera @ x_in_camera``.
  The paper's ``P = [R | t]`` is ``world_from_camera``: ``t`` is the camera centre in the world.
* A similarity (with scale) is another type than a rigid motion, so metric and up-to-scale quantities cannot be mixed.
* Pixel (0, 0) is the centre of the top-left pixel; intrinsics always travel with the image size they belong to.
* Quaternions are named x, y, z, w, with w >= 0.

Everything is float64 NumPy. Points are rows: ``(..., 3)``; pixels are ``(..., 2)`` in x, y order.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .lenses import Distortion

Array = NDArray[np.float64]

MAX_COORDINATE_M = 1e7
"""Largest coordinate of a stored pose: the Earth's centre is not as far from anything on it."""

ROTATION_TOLERANCE = 1e-3
"""How far a given rotation may be from orthonormal (or a quaternion's norm from 1) before it is rejected."""


@dataclass(frozen=True)
class Quaternion:
    """A unit quaternion with named parts; ``q`` and ``-q`` are the same rotation; the one with w >= 0 is written."""

    x: float
    y: float
    z: float
    w: float

    def matrix(self) -> Array:
        """The rotation matrix, (3, 3).

        ValueError if not finite, or the norm is further than ROTATION_TOLERANCE from one.
        """
        q = np.array([self.x, self.y, self.z, self.w])
        norm = float(np.linalg.norm(q))
        if not abs(norm - 1.0) <= ROTATION_TOLERANCE:
            raise ValueError(f"quaternion must have norm 1, has {norm:g}")
        x, y, z, w = q / norm
        return np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
                [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
                [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
            ]
        )

    def normalized(self) -> Quaternion:
        """The same rotation with norm 1 and w >= 0; one that has both keeps its bits. ValueError as of `matrix`."""
        self.matrix()
        norm = math.hypot(self.x, self.y, self.z, self.w)
        factor = math.copysign(1.0, self.w) / (1.0 if abs(norm - 1) < 1e-12 else norm)
        x, y, z, w = (factor * it + 0.0 for it in (self.x, self.y, self.z, self.w))  # + 0.0: no negative zeros
        return Quaternion(x, y, z, w)

    @staticmethod
    def from_matrix(rotation: ArrayLike) -> Quaternion:
        """The quaternion of a rotation matrix (3, 3), with w >= 0."""
        r = np.asarray(rotation, float)
        # The eigenvector of the largest eigenvalue of this symmetric matrix is the nearest unit quaternion (Bar-Itzhack
        # 2000): no case distinction by the largest diagonal entry, and rounding in `rotation` is averaged out.
        k = np.array(
            [
                [r[0, 0] - r[1, 1] - r[2, 2], r[0, 1] + r[1, 0], r[0, 2] + r[2, 0], r[2, 1] - r[1, 2]],
                [r[0, 1] + r[1, 0], r[1, 1] - r[0, 0] - r[2, 2], r[1, 2] + r[2, 1], r[0, 2] - r[2, 0]],
                [r[0, 2] + r[2, 0], r[1, 2] + r[2, 1], r[2, 2] - r[0, 0] - r[1, 1], r[1, 0] - r[0, 1]],
                [r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1], r[0, 0] + r[1, 1] + r[2, 2]],
            ]
        )
        q = np.linalg.eigh(k)[1][:, -1]
        x, y, z, w = (q if q[3] >= 0 else -q).tolist()
        return Quaternion(x, y, z, w)


def nearest_rotation(matrix: ArrayLike) -> Array:
    """The rotation nearest to a matrix that is almost one, (3, 3).

    ValueError if it is not finite, further than ROTATION_TOLERANCE from orthonormal, or a reflection.
    """
    m = np.asarray(matrix, float)
    if m.shape != (3, 3):
        raise ValueError(f"rotation is not an orthonormal 3x3 matrix: its shape is {m.shape}")
    if not (deviation := np.abs(m @ m.T - np.eye(3)).max()) <= 2 * ROTATION_TOLERANCE:
        raise ValueError(
            f"rotation is not an orthonormal 3x3 matrix: products of its rows are off by {deviation:.3g}, "
            f"at most {2 * ROTATION_TOLERANCE:g} is allowed"
        )
    if np.linalg.det(m) < 0:
        raise ValueError("rotation is a reflection (determinant -1)")
    u, _, vt = np.linalg.svd(m)
    return np.asarray(u @ vt)


def rotation_from_vector(vector: ArrayLike) -> Array:
    """Rodrigues' formula: rotation about ``vector`` (3,) by its length in radians, (3, 3)."""
    v = np.asarray(vector, float)
    k = cross_matrix(v)
    angle = float(np.linalg.norm(v))
    if angle < 1e-8:
        return np.eye(3) + k + 0.5 * k @ k
    return np.eye(3) + math.sin(angle) / angle * k + (1 - math.cos(angle)) / angle**2 * k @ k


def cross_matrix(vector: ArrayLike) -> Array:
    """The matrix [v]x with [v]x w = v x w, (3, 3)."""
    x, y, z = np.asarray(vector, float)
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotation_angle_deg(rotation: ArrayLike) -> float:
    """Angle of a rotation matrix (3, 3), in degrees, 0 to 180; accurate near both ends."""
    r = np.asarray(rotation, float)
    sine = 0.5 * float(np.linalg.norm([r[2, 1] - r[1, 2], r[0, 2] - r[2, 0], r[1, 0] - r[0, 1]]))
    return math.degrees(math.atan2(sine, 0.5 * (float(np.trace(r)) - 1)))


@dataclass(frozen=True, eq=False)
class RigidTransform:
    """``x_in_target = rotation @ x_in_source + translation``.

    Attributes:
        rotation: (3, 3), orthonormal with determinant 1, from source to target axes.
        translation: (3,), origin of the source in the target frame; metres when both frames are metric.
    """

    rotation: Array
    translation: Array

    @staticmethod
    def identity() -> RigidTransform:
        """Source and target are the same frame."""
        return RigidTransform(np.eye(3), np.zeros(3))

    @staticmethod
    def from_matrix(matrix: ArrayLike) -> RigidTransform:
        """From a homogeneous matrix, (4, 4) or (3, 4); its rotation is re-orthonormalized.

        ValueError if its shape is another, it is not finite, or the rotation part is not a rotation.
        """
        m = np.asarray(matrix, float)
        if m.shape not in ((4, 4), (3, 4)):
            raise ValueError(f"expected a 4x4 or 3x4 matrix, got shape {m.shape}")
        if not np.isfinite(m).all():
            raise ValueError("the matrix of a rigid transform is not finite")
        if m.shape == (4, 4) and not np.abs(m[3] - [0, 0, 0, 1]).max() <= ROTATION_TOLERANCE:
            turned = "; is the matrix given column by column?" if np.array_equal(m[:, 3], [0, 0, 0, 1]) else ""
            raise ValueError(f"last row of a rigid transform must be 0 0 0 1{turned}")
        return RigidTransform(nearest_rotation(m[:3, :3]), m[:3, 3].copy())

    def matrix(self) -> Array:
        """The homogeneous matrix, (4, 4)."""
        return np.block([[self.rotation, self.translation[:, None]], [np.zeros((1, 3)), np.ones((1, 1))]])

    def quaternion(self) -> Quaternion:
        """The rotation as a quaternion with w >= 0."""
        return self._quaternion

    @cached_property
    def _quaternion(self) -> Quaternion:
        return Quaternion.from_matrix(self.rotation)

    def inverse(self) -> RigidTransform:
        """``source_from_target``."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)

    def compose(self, source_from_other: RigidTransform) -> RigidTransform:
        """``target_from_other``."""
        translation = self.rotation @ source_from_other.translation + self.translation
        return RigidTransform(self.rotation @ source_from_other.rotation, translation)

    def shifted(self, offset: ArrayLike) -> RigidTransform:
        """The same motion seen from a target frame in which everything lies ``offset`` (3,) further."""
        return RigidTransform(self.rotation, self.translation + np.asarray(offset, float))

    def apply(self, x_in_source: ArrayLike) -> Array:
        """Points (..., 3) in the target frame."""
        return np.asarray(x_in_source, float) @ self.rotation.T + self.translation


@dataclass(frozen=True, eq=False)
class Similarity:
    """``x_in_target = scale * rotation @ x_in_source + translation``: relates an up-to-scale frame to a metric one.

    Attributes:
        scale: above 0; target units (metres) per source unit.
        rotation: (3, 3), from source to target axes.
        translation: (3,), origin of the source in the target frame, target units.
    """

    scale: float
    rotation: Array
    translation: Array

    def apply(self, x_in_source: ArrayLike) -> Array:
        """Points (..., 3) in the target frame."""
        return self.scale * (np.asarray(x_in_source, float) @ self.rotation.T) + self.translation

    def inverse(self) -> Similarity:
        """``source_from_target``."""
        rotation = self.rotation.T
        return Similarity(1 / self.scale, rotation, -(rotation @ self.translation) / self.scale)

    def transform_pose(self, source_from_camera: RigidTransform) -> RigidTransform:
        """``target_from_camera`` of a camera posed in the source frame."""
        return RigidTransform(self.rotation @ source_from_camera.rotation, self.apply(source_from_camera.translation))


@dataclass(frozen=True)
class Camera:
    """Intrinsics bound to the size of the image they belong to, in its pixels.

    Attributes:
        width_px, height_px: size of the image.
        focal_x_px, focal_y_px: focal lengths.
        principal_x_px, principal_y_px: principal point; (0, 0) is the centre of the top-left pixel.
        distortion: None for a pinhole.
    """

    width_px: int
    height_px: int
    focal_x_px: float
    focal_y_px: float
    principal_x_px: float
    principal_y_px: float
    distortion: Distortion | None = None

    @classmethod
    def from_fov(cls, width_px: int, height_px: int, horizontal_fov_deg: float) -> Camera:
        """The pinhole camera with square pixels and a centred principal point, as in simulators and data sheets.

        The field of view is the angle between the image's left and its right edge, above 0 and below 180 degrees.
        """
        if not 0 < horizontal_fov_deg < 180:
            raise ValueError(f"horizontal_fov_deg must be above 0 and below 180, is {horizontal_fov_deg:g}")
        return cls.centred(width_px, height_px, width_px / 2 / math.tan(math.radians(horizontal_fov_deg) / 2))

    @classmethod
    def centred(cls, width_px: int, height_px: int, focal_px: float) -> Camera:
        """The pinhole camera with square pixels and a centred principal point."""
        return cls(width_px, height_px, focal_px, focal_px, (width_px - 1) / 2, (height_px - 1) / 2)

    def matrix(self) -> Array:
        """K, (3, 3)."""
        return np.array(
            [[self.focal_x_px, 0.0, self.principal_x_px], [0.0, self.focal_y_px, self.principal_y_px], [0.0, 0.0, 1.0]]
        )

    def pinhole(self) -> Camera:
        """The ideal camera with the same K and size."""
        return self if self.distortion is None else replace(self, distortion=None)

    def resized(self, width_px: int, height_px: int) -> Camera:
        """The camera of the same photograph resampled to another size.

        A pixel covers [-1/2, 1/2] around its centre, so the image's edge, not its first pixel's centre, is the fixed
        point of resizing: c' = s (c + 1/2) - 1/2.
        """
        scale_x, scale_y = width_px / self.width_px, height_px / self.height_px
        return replace(
            self,
            width_px=width_px,
            height_px=height_px,
            focal_x_px=self.focal_x_px * scale_x,
            focal_y_px=self.focal_y_px * scale_y,
            principal_x_px=resized_pixel(self.principal_x_px, scale_x),
            principal_y_px=resized_pixel(self.principal_y_px, scale_y),
        )

    def project(self, x_in_camera: ArrayLike) -> Array:
        """Pixels (..., 2) of points (..., 3) in the camera frame; NaN for points that are not in front of it."""
        ideal = normalize(x_in_camera)
        if self.distortion is not None:
            ideal = self.distortion.distort(ideal)
        return ideal * (self.focal_x_px, self.focal_y_px) + (self.principal_x_px, self.principal_y_px)

    def rays(self, pixels: ArrayLike) -> Array:
        """Points (..., 3) at depth 1 in the camera frame seen at ``pixels`` (..., 2) of the ideal pinhole camera."""
        ideal = (np.asarray(pixels, float) - (self.principal_x_px, self.principal_y_px)) / (
            self.focal_x_px,
            self.focal_y_px,
        )
        return np.concatenate([ideal, np.ones_like(ideal[..., :1])], axis=-1)


def normalize(x_in_camera: ArrayLike) -> Array:
    """The perspective division: (..., 3) in the camera frame to (..., 2) at depth 1; NaN where not in front."""
    x = np.asarray(x_in_camera, float)
    return np.asarray(x[..., :2] / np.where(x[..., 2:] > 0, x[..., 2:], np.nan))


def normalize_jacobian(x_in_camera: ArrayLike) -> Array:
    """Derivative (..., 2, 3) of `normalize` by its argument."""
    x = np.asarray(x_in_camera, float)
    inverse_depth = 1 / np.where(x[..., 2] > 0, x[..., 2], np.nan)
    by_depth = -normalize(x) * inverse_depth[..., None]
    zero = np.zeros_like(inverse_depth)
    entries = [inverse_depth, zero, by_depth[..., 0], zero, inverse_depth, by_depth[..., 1]]
    return np.stack(entries, -1).reshape((*x.shape[:-1], 2, 3))


Number = TypeVar("Number", float, NDArray[np.floating])


def resized_pixel(pixel: Number, scale: float) -> Number:
    """A pixel coordinate after its image was resampled by ``scale`` (new size / old size)."""
    return scale * (pixel + 0.5) - 0.5
