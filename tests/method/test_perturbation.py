"""Errors of a pose in three coordinates: derivatives by differences, covariances by drawn errors."""

from __future__ import annotations

import numpy as np
import pytest
from support.jacobians import assert_jacobian, finite_differences
from support.scenes import CAMERA, random_for

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.rigid import rotation_vector
from mapless_server.method.uncertainty.perturbation import (
    Perturbation,
    motion_jacobian,
    pose_hessian,
    world_covariance,
    world_jacobian,
)

POSE = RigidTransform(rotation_from_vector([0.7, -1.1, 0.4]), np.array([3.0, -2.0, 1.5]))
EVERY_WAY = pytest.mark.parametrize("perturbation", list(Perturbation))


def perturbed(perturbation: Perturbation, error: Array) -> RigidTransform:
    """world_from_camera after an error (v, w) of camera_from_world, by the definition of each."""
    given, turn = POSE.inverse(), rotation_from_vector(error[3:])
    if perturbation is Perturbation.SE3_LEFT:  # up to a factor of v that is one to first order
        moved = RigidTransform(turn, error[:3]).compose(given)
    elif perturbation is Perturbation.DECOUPLED_LEFT:
        moved = RigidTransform(turn @ given.rotation, given.translation + error[:3])
    else:
        moved = RigidTransform(given.rotation @ turn, given.translation + error[:3])
    return moved.inverse()


def error_in_world(pose: RigidTransform) -> Array:
    """X y z rx ry rz: the centre's shift, and the turn about fixed world axes."""
    return np.concatenate([pose.translation - POSE.translation, rotation_vector(pose.rotation @ POSE.rotation.T)])


@EVERY_WAY
def test_the_jacobian_is_the_derivative_of_the_world_error(perturbation: Perturbation) -> None:
    assert_jacobian(
        world_jacobian(POSE, perturbation),
        lambda error: error_in_world(perturbed(perturbation, error)),
        np.zeros(6),
        tolerance=1e-7,
    )


@EVERY_WAY
def test_the_covariance_is_that_of_drawn_errors(perturbation: Perturbation) -> None:
    """Monte Carlo, 2000 errors of millimetres and tenths of a degree that go together: within a tenth."""
    random = random_for("perturbations", perturbation.value)
    mixing = random.normal(size=(6, 6)) * np.repeat([0.003, 0.002], 3)[:, None]
    drawn = random.normal(size=(2000, 6)) @ mixing.T
    errors = np.stack([error_in_world(perturbed(perturbation, error)) for error in drawn])
    expected = np.cov(errors.T)
    covariance = world_covariance(np.linalg.inv(mixing @ mixing.T), POSE, perturbation)
    assert np.linalg.norm(covariance - expected) < 0.1 * np.linalg.norm(expected)


def test_taking_one_for_another_is_no_small_error() -> None:
    """The lever arm of a camera 3.9 m from the origin is in two of them and not in the third."""
    information = np.diag([1e6, 1e6, 1e6, 1e5, 1e5, 1e5])
    ours, left, right = (world_covariance(information, POSE, it) for it in Perturbation)
    for other in (left, right):
        assert np.trace(other[:3, :3]) > 10 * np.trace(ours[:3, :3])
    np.testing.assert_allclose(left[:3, :3], right[:3, :3], rtol=0.2, atol=3e-5)


def test_motion_jacobian() -> None:
    for x in random_for("motion").normal(size=(5, 3)):

        def moved(motion: Array, x: Array = x) -> Array:
            return np.asarray(rotation_from_vector(motion[3:]) @ x + motion[:3])

        assert_jacobian(motion_jacobian(x), moved, np.zeros(6), tolerance=1e-7)


def test_the_covariance_is_that_of_errors_in_the_world() -> None:
    """The inverse of J^T J, where J is by differences in the very coordinates that the covariance is told in."""
    pose = RigidTransform(rotation_from_vector([0.2, -0.3, 0.1]), np.array([0.4, -0.2, -4.0]))
    x_in_world = random_for("covariance").normal(size=(60, 3))

    def projections(error: Array) -> Array:
        moved = RigidTransform(rotation_from_vector(error[3:]) @ pose.rotation, pose.translation + error[:3])
        return CAMERA.project(moved.inverse().apply(x_in_world)).ravel()

    jacobian = finite_differences(projections, np.zeros(6))
    covariance = world_covariance(pose_hessian(CAMERA, pose, x_in_world) / 0.5**2, pose)
    expected = 0.5**2 * np.linalg.inv(jacobian.T @ jacobian)
    np.testing.assert_allclose(covariance, expected, atol=1e-5 * np.abs(expected).max())
    np.testing.assert_array_equal(covariance, covariance.T)
    assert np.linalg.eigvalsh(covariance).min() > 0
