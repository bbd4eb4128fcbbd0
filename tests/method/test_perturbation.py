"""Pose errors in world coordinates: derivatives by finite differences, covariances and radii by sampling."""

import numpy as np
import pytest
from support.compare import assert_jacobian, finite_differences
from support.scenes import CAMERA, random_for

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.perturbation import (
    motion_jacobian,
    moved,
    perturbed,
    pose_hessian,
    rotation_vector,
    world_covariance,
    world_jacobian,
)
from mapless_server.method.uncertainty.radii import error_radii

POSE = RigidTransform(rotation_from_vector([0.7, -1.1, 0.4]), np.array([3.0, -2.0, 1.5]))


def error_in_world(pose: RigidTransform) -> Array:
    """X y z rx ry rz: the centre's shift, and the turn about fixed world axes."""
    return np.concatenate([pose.translation - POSE.translation, rotation_vector(pose.rotation @ POSE.rotation.T)])


def perturbed_camera(error: Array) -> RigidTransform:
    """world_from_camera after an error (v, w) of camera_from_world."""
    return perturbed(POSE.inverse(), error).inverse()


def test_world_jacobian_is_the_derivative_of_the_world_error() -> None:
    assert_jacobian(
        world_jacobian(POSE), lambda error: error_in_world(perturbed_camera(error)), np.zeros(6), tolerance=1e-7
    )


def test_motion_jacobian_equals_finite_differences() -> None:
    for x in random_for("motion").normal(size=(5, 3)):

        def moved_point(motion: Array, x: Array = x) -> Array:
            return np.asarray(rotation_from_vector(motion[3:]) @ x + motion[:3])

        assert_jacobian(motion_jacobian(x), moved_point, np.zeros(6), tolerance=1e-7)


def test_covariance_from_projections_is_in_world_axes() -> None:
    """The inverse of J^T J, with J by finite differences in the coordinates of the covariance."""
    pose = RigidTransform(rotation_from_vector([0.2, -0.3, 0.1]), np.array([0.4, -0.2, -4.0]))
    x_in_world = random_for("covariance").normal(size=(60, 3))

    def projections(error: Array) -> Array:
        return CAMERA.project(moved(pose, error).inverse().apply(x_in_world)).ravel()

    jacobian = finite_differences(projections, np.zeros(6))
    covariance = world_covariance(pose_hessian(CAMERA, pose, x_in_world) / 0.5**2, pose)
    expected = 0.5**2 * np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(covariance, expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0


@pytest.mark.parametrize(
    "eigenvalues", [(1, 1, 1), (1, 0, 0), (1, 1, 0), (1, 0.1, 0.1), (1, 0.5, 0.01), (1, 1e-3, 1e-6), (4, 4, 0.1)]
)
@pytest.mark.parametrize("probability", [0.68, 0.95])
def test_radius_equals_the_quantile_of_samples(eigenvalues: tuple[float, ...], probability: float) -> None:
    rng = np.random.default_rng(7)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    errors = np.sqrt((rng.normal(size=(200_000, 3)) ** 2 * eigenvalues).sum(axis=1))
    covariance = axes @ np.diag(eigenvalues) @ axes.T
    (radius,) = error_radii(covariance, [probability])
    assert radius == pytest.approx(np.quantile(errors, probability), rel=0.04)


def test_zero_covariance_has_radius_zero() -> None:
    assert error_radii(np.zeros((3, 3)), [0.95]) == 0.0
