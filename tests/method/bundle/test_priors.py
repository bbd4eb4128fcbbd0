"""Priors: derivatives against finite differences, distances against their chi-square, conflicts."""

import math

import numpy as np
import pytest
from scipy.special import chdtrc, chdtri
from support.compare import assert_jacobian
from support.scenes import random_for

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.bundle.priors import (
    NO_PRIORS,
    GravityPrior,
    HeadingPrior,
    PosePrior,
    PositionPrior,
    Prior,
    PriorKind,
    Priors,
    conflict_threshold,
)
from mapless_server.method.optim.optimize import moved
from mapless_server.method.optim.rotations import rotation_vector

POSE = RigidTransform(rotation_from_vector([0.2, -0.3, 0.1]), np.array([0.4, -0.2, -4.0]))
DOWN = np.array([0.0, 0.0, -1.0])


def unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def random_covariance(rng: np.random.Generator, *deviations: float) -> Array:
    """A covariance with these standard deviations and random correlations."""
    root = rng.normal(size=(len(deviations), len(deviations)))
    covariance = root @ root.T
    scale = np.array(deviations) / np.sqrt(np.diag(covariance))
    return np.asarray(covariance * np.outer(scale, scale))


def drawn(rng: np.random.Generator, covariance: Array) -> Array:
    """A normal vector of this covariance."""
    return np.asarray(np.linalg.cholesky(covariance) @ rng.normal(size=len(covariance)))


def turned_by_chance(rng: np.random.Generator, direction: Array, sigma: float) -> Array:
    """A direction of unit length, turned by noise about the two axes across it."""
    across = rng.normal(0, sigma, 3)
    across -= direction * (direction @ across)
    return np.asarray(rotation_from_vector(across) @ direction)


def gravity_at(pose: RigidTransform, sigma_deg: float = 1.0) -> GravityPrior:
    return GravityPrior(unit(pose.rotation.T @ DOWN), DOWN, sigma_deg)


def planted(kind: str, pose: RigidTransform, rng: np.random.Generator) -> Prior:
    """A prior whose error is drawn from its covariance."""
    if kind == "position":
        covariance = random_covariance(rng, 0.1, 0.3, 1.0)
        return PositionPrior(pose.translation + drawn(rng, covariance), covariance)
    if kind == "gravity":
        return GravityPrior(turned_by_chance(rng, unit(pose.rotation.T @ DOWN), math.radians(2)), DOWN, 2.0)
    if kind == "heading":
        return HeadingPrior.looking(turned_by_chance(rng, pose.rotation[:, 2], math.radians(5)), 5.0)
    covariance = random_covariance(rng, 0.1, 0.3, 1.0, 0.02, 0.05, 0.03)
    return PosePrior(moved(pose, drawn(rng, covariance)), covariance)


KINDS = ("position", "gravity", "heading", "pose")


# Equations


@pytest.mark.parametrize("kind", KINDS)
def test_the_jacobian_is_the_derivative_about_fixed_world_axes(kind: str) -> None:
    rng = random_for("jacobian", kind)
    for _ in range(5):
        prior = planted(kind, POSE, rng)
        at = moved(POSE, rng.normal(0, 0.3, 6))
        jacobian = prior.term(at).jacobian

        def residual(error: Array, prior: Prior = prior, at: RigidTransform = at) -> Array:
            return prior.term(moved(at, error)).residual

        assert_jacobian(jacobian, residual, np.zeros(6), tolerance=1e-7)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.0, math.pi])
def test_the_rotation_vector_is_the_inverse_of_rodrigues(angle: float) -> None:
    axis = unit(np.array([0.3, -0.5, 0.8]))
    found = rotation_vector(rotation_from_vector(angle * axis))
    np.testing.assert_allclose(rotation_from_vector(found), rotation_from_vector(angle * axis), atol=1e-12)
    assert np.linalg.norm(found) == pytest.approx(angle, abs=1e-12)


# Distances


@pytest.mark.parametrize("kind", KINDS)
def test_squared_distances_of_consistent_priors_are_chi_square(kind: str) -> None:
    """Monte Carlo over both uncertainties: errors of the pose and the prior are drawn from their covariances."""
    rng = random_for("chi square", kind)
    covariance = random_covariance(rng, 0.05, 0.1, 0.2, 0.02, 0.01, 0.03)
    squares = []
    for _ in range(1500):
        prior = planted(kind, POSE, rng)
        found = moved(POSE, drawn(rng, covariance))
        (check,) = Priors(**{kind: prior}).check(found, covariance)  # type: ignore[arg-type]
        squares.append(check.mahalanobis**2)
    freedom = check.degrees_of_freedom
    assert np.mean(squares) == pytest.approx(freedom, rel=0.08)
    assert np.quantile(squares, 0.95) == pytest.approx(chdtri(freedom, 0.05), rel=0.08)


@pytest.mark.parametrize("freedom", [2, 3, 6])
def test_one_consistent_prior_of_10_000_is_called_a_conflict(freedom: int) -> None:
    assert chdtrc(freedom, conflict_threshold(freedom)) == pytest.approx(1e-4, rel=1e-6)


@pytest.mark.parametrize("sigma_deg", [0.5, 1.0, 5.0, 20.0])
def test_gravity_of_the_wrong_sign_is_always_a_conflict(sigma_deg: float) -> None:
    prior = gravity_at(POSE, sigma_deg)
    flipped = GravityPrior(-prior.in_camera, DOWN, sigma_deg)
    (check,) = Priors(gravity=flipped).check(POSE, np.diag([1.0, 1.0, 1.0, 2.0, 2.0, 2.0]) ** 2)
    assert check.conflict
    assert not check.used


def test_a_prior_with_negligible_information_is_not_used() -> None:
    covariance = np.diag([0.01] * 3 + [math.radians(0.2)] * 3) ** 2
    for sigma_deg, used in ((1.0, False), (0.5, True)):
        (check,) = Priors(gravity=gravity_at(POSE, sigma_deg)).check(POSE, covariance)
        assert (check.conflict, check.used) == (False, used)


def test_the_covariance_is_the_inverse_of_summed_informations() -> None:
    rng = random_for("sharpened")
    covariance = random_covariance(rng, 0.1, 0.2, 0.3, 0.02, 0.03, 0.01)
    priors = Priors(planted("position", POSE, rng), gravity=gravity_at(POSE))  # type: ignore[arg-type]
    _, information = priors.gradient_and_information(POSE)
    expected = np.linalg.inv(np.linalg.inv(covariance) + information)
    np.testing.assert_allclose(priors.sharpened(covariance, POSE), expected, rtol=1e-6, atol=1e-12)
    np.testing.assert_array_equal(NO_PRIORS.sharpened(covariance, POSE), covariance)


def test_a_prior_weighs_no_more_than_a_conflict() -> None:
    near, far = gravity_at(moved(POSE, np.array([0, 0, 0, 0.01, 0, 0]))), gravity_at(moved(POSE, np.full(6, 1.0)))
    assert Priors(gravity=near).penalty(POSE) == pytest.approx(Priors(gravity=near).cost(POSE))
    assert Priors(gravity=far).penalty(POSE) == conflict_threshold(2)


def test_chance_is_the_share_of_directions_within_the_angle() -> None:
    """Counted over random directions of the camera's down."""
    priors = Priors(gravity=gravity_at(POSE, 10.0))
    turns = random_for("chance").normal(size=(2000, 3))
    agreeing = 0
    for direction in turns / np.linalg.norm(turns, axis=1, keepdims=True):
        pose = RigidTransform(_turning(unit(POSE.rotation.T @ DOWN), direction), np.zeros(3))
        agreeing += priors.log10_chance(pose) < 0
    assert agreeing / len(turns) == pytest.approx(10 ** priors.log10_chance(POSE), rel=0.1)
    assert Priors(pose=PosePrior(POSE, 1e-6 * np.eye(6))).log10_chance(POSE) == 0.0


def _turning(source: Array, target: Array) -> Array:
    """A rotation that turns one direction onto another."""
    axis = np.cross(source, target)
    angle = math.atan2(float(np.linalg.norm(axis)), float(source @ target))
    return rotation_from_vector(angle * unit(axis))


# Values


def test_priors_shift_with_the_world() -> None:
    rng, offset = random_for("shift"), np.array([1e6, -2e5, 300.0])
    priors = Priors(**{kind: planted(kind, POSE, rng) for kind in KINDS})  # type: ignore[arg-type]
    there = priors.shifted(offset)
    assert there.cost(POSE.shifted(offset)) == pytest.approx(priors.cost(POSE), rel=1e-6)
    assert [prior.kind for prior in there] == [PriorKind.POSITION, PriorKind.HEADING, PriorKind.GRAVITY, PriorKind.POSE]


UNSYMMETRIC = np.eye(3)
UNSYMMETRIC = UNSYMMETRIC + np.array([[0, 0.5, 0], [0, 0, 0], [0, 0, 0]])


def test_a_covariance_may_mix_centimetres_and_unknown_height() -> None:
    covariance = np.diag([0.01, 0.01, 1000.0]) ** 2
    assert PositionPrior(np.zeros(3), covariance).term(POSE).cost == pytest.approx(40**2 + 20**2, rel=1e-3)


def test_a_prior_farther_off_than_usual_has_less_weight() -> None:
    """Its covariance is inflated until its distance is the average one."""
    pose_covariance = np.diag([1.0, 1.0, 1.0, 0.1, 0.1, 0.1]) ** 2
    at = moved(POSE, np.array([0.3, 0, 0, 0, 0, 0]))
    for sigma_m, factor in ((1.0, 1.0), (0.05, 1.0), (0.01, 1.0)):
        priors = Priors(PositionPrior(POSE.translation, sigma_m**2 * np.eye(3)))
        (kept,) = priors.consistent(priors.check(at, pose_covariance))
        np.testing.assert_allclose(kept.term(at).covariance, factor * sigma_m**2 * np.eye(3))
    certain = 1e-2**2 * np.eye(6)
    priors = Priors(PositionPrior(POSE.translation, 0.1**2 * np.eye(3)), gravity=gravity_at(POSE, 0.1))
    checks = priors.check(at, 1e2 * certain)
    (position, _) = priors.consistent(checks)
    squared = checks[0].mahalanobis ** 2
    np.testing.assert_allclose(position.term(at).covariance, max(1.0, squared / 3) * 0.1**2 * np.eye(3))
