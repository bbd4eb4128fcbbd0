"""Points to draw: matched between photographs with known poses and triangulated, independent of the server.

An answer has a pose, but no points. Known structure that is projected to where the photograph shows it makes a pose
credible, so the demo triangulates some points itself, from the references alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform
from mapless_server.method.features.image import undistort_pixels

from .photographs import Photograph

MAX_FEATURES = 2000
RATIO = 0.8
"""Lowe's: the best descriptor must be nearer than this share of the second best's distance."""
MAX_ERROR_PX = 1.5
"""Points that reproject worse than this into either photograph are left out."""
MIN_PARALLAX_DEG = 1.0
"""Points whose rays meet at a smaller angle are left out."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A decoded photograph (H, W, 3) uint8 RGB with its pose, and its camera in the image's pixels."""

    name: str
    image: NDArray[np.uint8]
    camera: Camera
    world_from_camera: RigidTransform

    @staticmethod
    def of(photograph: Photograph, max_side_px: int) -> Shot:
        """Decodes a photograph, reduced if it is large, without EXIF orientation; ValueError if it cannot be read."""
        flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
        image = cv2.imdecode(np.frombuffer(photograph.data, np.uint8), flags)
        if image is None:
            raise ValueError(f"{photograph.name} is not an image that can be read")
        scale = min(1.0, max_side_px / max(image.shape[:2]))
        size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
        drawn = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
        return Shot(photograph.name, drawn, photograph.camera.resized(*size), photograph.world_from_camera)

    @cached_property
    def features(self) -> tuple[Array, NDArray[np.float32]]:
        """SIFT keypoints (N, 2) in pixels of the distorted image, and descriptors (N, 128)."""
        keypoints, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(self.image, None)
        if len(keypoints) == 0:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        return np.array([k.pt for k in keypoints]), np.asarray(descriptors, np.float32)

    def project(self, x_in_world: Array) -> Array:
        """Pixels (N, 2) of points (N, 3); NaN behind the camera."""
        return self.camera.project(self.world_from_camera.inverse().apply(x_in_world))


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Triangulated points (N, 3) in the world, and their SIFT descriptors (N, 128) float32."""

    x_in_world: Array
    descriptors: NDArray[np.float32]


def match(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.int64]:
    """Pairs (M, 2) of rows that are each other's best and clearly better than the second."""
    if min(len(a), len(b)) < 2:
        return np.zeros((0, 2), np.int64)
    forward = cv2.BFMatcher().knnMatch(a, b, k=2)
    back = {m.queryIdx: m.trainIdx for m in cv2.BFMatcher().match(b, a)}
    pairs = [
        (best.queryIdx, best.trainIdx)
        for best, second in forward
        if best.distance < RATIO * second.distance and back[best.trainIdx] == best.queryIdx
    ]
    return np.array(pairs, np.int64).reshape(-1, 2)


def points_to_draw(references: Sequence[Shot]) -> SparsePoints:
    """Triangulates points from all pairs of a few references that show the same place."""
    points, descriptors = [np.zeros((0, 3))], [np.zeros((0, 128), np.float32)]
    for a, b in itertools.combinations(references, 2):
        (pixels_a, of_a), (pixels_b, of_b) = a.features, b.features
        pairs = match(of_a, of_b)
        pixels_a, pixels_b = pixels_a[pairs[:, 0]], pixels_b[pairs[:, 1]]
        x, parallax_deg = triangulate(a, b, pixels_a, pixels_b)
        errors = [np.linalg.norm(it.project(x) - pixels, axis=-1) for it, pixels in ((a, pixels_a), (b, pixels_b))]
        good = (parallax_deg > MIN_PARALLAX_DEG) & (np.maximum(*errors) < MAX_ERROR_PX)
        points.append(x[good])
        descriptors.append(of_a[pairs[good, 0]])
    return SparsePoints(np.concatenate(points), np.concatenate(descriptors))


def triangulate(a: Shot, b: Shot, pixels_a: Array, pixels_b: Array) -> tuple[Array, Array]:
    """Triangulates points (N, 3), world; also returns the angles (N,) between their rays, degrees."""
    if len(pixels_a) == 0:
        return np.zeros((0, 3)), np.zeros(0)
    poses = [shot.world_from_camera.inverse().matrix()[:3] for shot in (a, b)]
    # What has no undistorted pixel gets a wrong one, and reprojects badly.
    ideal = [
        np.nan_to_num(shot.camera.rays(undistort_pixels(pixels, shot.camera))[:, :2]).T
        for shot, pixels in ((a, pixels_a), (b, pixels_b))
    ]
    homogeneous = cv2.triangulatePoints(*poses, *ideal).T
    x = np.asarray(homogeneous[:, :3] / homogeneous[:, 3:], float)
    u, v = (x - shot.world_from_camera.translation for shot in (a, b))
    cosine = np.einsum("ij,ij->i", u, v) / (np.linalg.norm(u, axis=-1) * np.linalg.norm(v, axis=-1))
    return x, np.degrees(np.arccos(np.clip(cosine, -1, 1)))


def find_in(points: SparsePoints, shot: Shot, max_offset_px: float) -> tuple[NDArray[np.int64], Array]:
    """Finds which of the points a photograph shows, by their descriptors alone.

    Returns indices (M,) of points and the pixels (M, 2) that show them, at most `max_offset_px` from their projections
    by the shot's pose.
    """
    pixels, descriptors = shot.features
    pairs = match(points.descriptors, descriptors)
    offsets = shot.project(points.x_in_world[pairs[:, 0]]) - pixels[pairs[:, 1]]
    near = np.linalg.norm(offsets, axis=-1) < max_offset_px
    return pairs[near, 0], pixels[pairs[near, 1]]
