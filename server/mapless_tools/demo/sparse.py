"""Points to draw: matched between photographs with known poses and triangulated, apart from the server's own work.

An answer carries a pose and no points. A person who is to believe the pose wants to see that known structure falls
where the photograph shows it, so the demo makes a little structure itself, from the references alone.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RadialTangential, RigidTransform

MAX_FEATURES = 2000
RATIO = 0.8
"""Lowe's: the best descriptor must be nearer than this share of the second best's distance."""


@dataclass(frozen=True, eq=False)
class Shot:
    """A photograph with its pose.

    Attributes:
        name: of the reference or query.
        image: (H, W, 3) uint8 RGB.
        camera: in the pixels of `image`.
        world_from_camera: its known pose.
    """

    name: str
    image: NDArray[np.uint8]
    camera: Camera
    world_from_camera: RigidTransform

    @cached_property
    def features(self) -> tuple[Array, NDArray[np.float32]]:
        """SIFT keypoints (N, 2) in pixels of the image, distorted as it is, and descriptors (N, 128)."""
        keypoints, descriptors = cv2.SIFT.create(MAX_FEATURES).detectAndCompute(self.image, None)
        if len(keypoints) == 0:
            return np.zeros((0, 2)), np.zeros((0, 128), np.float32)
        return np.array([k.pt for k in keypoints]), np.asarray(descriptors, np.float32)


@dataclass(frozen=True, eq=False)
class SparsePoints:
    """Triangulated points.

    Attributes:
        x_in_world: (N, 3).
        descriptors: (N, 128) float32, SIFT's.
    """

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


def points_to_draw(
    references: Sequence[Shot], max_error_px: float = 1.5, min_parallax_deg: float = 1.0
) -> SparsePoints:
    """Triangulate what any two of the references see.

    Args:
        references: a few that look at the same place; every pair is matched.
        max_error_px: points that reproject worse than this into either photograph are left out.
        min_parallax_deg: points whose rays meet at a smaller angle are left out.
    """
    features = [reference.features for reference in references]
    points, descriptors = [np.zeros((0, 3))], [np.zeros((0, 128), np.float32)]
    for (a, (pixels_a, of_a)), (b, (pixels_b, of_b)) in itertools.combinations(
        zip(references, features, strict=True), 2
    ):
        pairs = match(of_a, of_b)
        if len(pairs) == 0:
            continue
        x, parallax_deg = triangulate(a, b, pixels_a[pairs[:, 0]], pixels_b[pairs[:, 1]])
        good = parallax_deg > min_parallax_deg
        for shot, pixels in ((a, pixels_a[pairs[:, 0]]), (b, pixels_b[pairs[:, 1]])):
            projected = shot.camera.project(shot.world_from_camera.inverse().apply(x))
            good &= np.linalg.norm(projected - pixels, axis=-1) < max_error_px
        points.append(x[good])
        descriptors.append(of_a[pairs[good, 0]])
    return SparsePoints(np.concatenate(points), np.concatenate(descriptors))


def triangulate(a: Shot, b: Shot, pixels_a: Array, pixels_b: Array) -> tuple[Array, Array]:
    """Midpoints (N, 3) between two rays each, world, and the angles (N,) at which the rays meet, degrees."""
    ways = [shot.camera.rays(undistorted(shot.camera, p)) for shot, p in ((a, pixels_a), (b, pixels_b))]
    u, v = (w @ shot.world_from_camera.rotation.T for w, shot in zip(ways, (a, b), strict=True))
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    v /= np.linalg.norm(v, axis=-1, keepdims=True)
    baseline = b.world_from_camera.translation - a.world_from_camera.translation
    cosine = np.einsum("ij,ij->i", u, v)
    sine2 = np.maximum(1 - cosine**2, 1e-12)
    along_u = (u @ baseline - cosine * (v @ baseline)) / sine2
    along_v = (cosine * (u @ baseline) - v @ baseline) / sine2
    ends_a = a.world_from_camera.translation + along_u[:, None] * u
    ends_b = b.world_from_camera.translation + along_v[:, None] * v
    return (ends_a + ends_b) / 2, np.degrees(np.arctan2(np.sqrt(sine2), cosine))


def undistorted(camera: Camera, pixels: Array) -> Array:
    """Pixels (N, 2) that an ideal lens would give in the place of these."""
    if not isinstance(camera.distortion, RadialTangential):
        return pixels
    d, k = camera.distortion, camera.matrix()
    coefficients = np.array([d.k1, d.k2, d.p1, d.p2, d.k3])
    return np.asarray(cv2.undistortPoints(pixels[:, None], k, coefficients, P=k)[:, 0], float)


def find_in(points: SparsePoints, shot: Shot, max_offset_px: float) -> tuple[NDArray[np.int64], Array]:
    """Where a photograph shows some of the points, told by their looks alone.

    Returns:
        indices (M,) of points and the pixels (M, 2) that show them, at most `max_offset_px` from where the shot's pose
        puts them.
    """
    pixels, descriptors = shot.features
    pairs = match(points.descriptors, descriptors)
    projected = shot.camera.project(shot.world_from_camera.inverse().apply(points.x_in_world[pairs[:, 0]]))
    near = np.linalg.norm(projected - pixels[pairs[:, 1]], axis=-1) < max_offset_px
    return pairs[near, 0], pixels[pairs[near, 1]]
