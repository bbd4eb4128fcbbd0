"""Scenes are left out only where none of their references may be considered."""

import numpy as np

from mapless.geometry import Array, rotation_from_vector
from mapless_server.scenes import Narrowing
from mapless_server.scenes.retrieval.narrowing import PRIOR_MARGIN_M, REACH_SIGMA, Ellipsoid


def test_a_sphere_with_a_likely_camera_is_reached() -> None:
    """The spheres touch ellipsoids from outside, where the sum of both is furthest from longer half-axes."""
    generator, left_out = np.random.default_rng(7), 0
    for _ in range(100):
        axes = rotation_from_vector(generator.normal(size=3))
        sigmas_m = 10.0 ** generator.uniform(-2, 3, 3)
        position = generator.normal(0.0, 100.0, 3)
        narrowing = Narrowing(likely_positions=(Ellipsoid(position, axes @ np.diag(sigmas_m**2) @ axes.T),))
        half_axes_m = REACH_SIGMA * sigmas_m + PRIOR_MARGIN_M
        on_sphere = _directions(generator, 200)
        on_surface_m = (1 - 1e-6) * half_axes_m * on_sphere
        outward = on_sphere / half_axes_m
        outward /= np.linalg.norm(outward, axis=1, keepdims=True)
        radii_m = 10.0 ** generator.uniform(0, 3, 200)
        cameras = on_surface_m @ axes.T + position
        assert narrowing.keeps(cameras, np.tile([0.0, 0.0, 1.0], (200, 1))).all()
        centres = (on_surface_m + radii_m[:, None] * outward) @ axes.T + position
        assert narrowing.reaches(centres, radii_m * (1 + 1e-9)).all()
        far = np.vstack([position, (on_surface_m + 3 * (radii_m[:, None] + 10) * outward) @ axes.T + position])
        left_out += int((~narrowing.reaches(far, np.append(1.0, radii_m))).sum())
    assert left_out > 10_000


def _directions(generator: np.random.Generator, count: int) -> Array:
    vectors = generator.normal(size=(count, 3))
    return np.asarray(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
