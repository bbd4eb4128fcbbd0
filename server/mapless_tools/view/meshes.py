"""Shapes to draw: the ellipsoid of a covariance, and the lines of a match."""

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array

CHI2_95_IN_SPACE = 7.8147279
"""Square of how many standard deviations an ellipsoid of 95 % reaches in three dimensions."""
_FACTORS = (1, 2, 5, 10, 20, 50, 100, 200, 500, 1000)


def ellipsoid(covariance: Array, steps: int = 18) -> tuple[Array, NDArray[np.uint32]]:
    """Vertices (V, 3) around the origin and faces (F, 3) of the ellipsoid that contains 95 % of positions.

    The covariance is (3, 3) or more, of which the first three are the position, square metres. There are half as many
    parallels as meridians.
    """
    values, axes = np.linalg.eigh(covariance[:3, :3])
    radii = np.sqrt(np.maximum(values, 0.0) * CHI2_95_IN_SPACE)
    rows = steps // 2 + 1
    polar, azimuth = np.meshgrid(np.linspace(0, np.pi, rows), np.linspace(0, 2 * np.pi, steps + 1), indexing="ij")
    unit = np.stack([np.sin(polar) * np.cos(azimuth), np.sin(polar) * np.sin(azimuth), np.cos(polar)], axis=-1)
    vertices = (unit.reshape(-1, 3) * radii) @ axes.T
    corner = (np.arange(rows - 1)[:, None] * (steps + 1) + np.arange(steps)).ravel()
    right, below, across = corner + 1, corner + steps + 1, corner + steps + 2
    faces = np.concatenate([np.stack([corner, below, right], axis=1), np.stack([right, below, across], axis=1)])
    if np.linalg.det(axes) < 0:  # a mirrored sphere is seen from within
        faces = faces[:, ::-1]
    return vertices, faces.astype(np.uint32)


def enlargement(covariance: Array, size_m: float) -> int:
    """Factor by which an ellipsoid is drawn larger, so that it is visible beside something of this size."""
    largest = float(np.sqrt(max(np.linalg.eigvalsh(covariance[:3, :3])[-1], 0.0) * CHI2_95_IN_SPACE))
    if largest <= 0:
        return 1
    return max((factor for factor in _FACTORS if factor * largest <= size_m), default=1)


def rays(centre: Array, points: Array, count: int, longest_m: float) -> Array:
    """Lines (N, 2, 3) from a camera's centre to points (M, 3): at most `count`, evenly thinned, and none too long."""
    chosen = points
    if len(points) > count:
        chosen = points[np.linspace(0, len(points) - 1, count).round().astype(int)]
    length = np.linalg.norm(chosen - centre, axis=1, keepdims=True)
    end = centre + (chosen - centre) * np.minimum(1.0, longest_m / np.maximum(length, 1e-9))
    return np.stack([np.broadcast_to(centre, end.shape), end], axis=1)
