"""Radii contain the truth as often as they say."""

from __future__ import annotations

import math

import numpy as np
import pytest

from mapless_server.method.uncertainty.accuracy import TAIL_95, accuracy_from_covariance, error_radius


@pytest.mark.parametrize(
    "eigenvalues", [(1, 1, 1), (1, 0, 0), (1, 1, 0), (1, 0.1, 0.1), (1, 0.5, 0.01), (1, 1e-3, 1e-6), (4, 4, 0.1)]
)
@pytest.mark.parametrize("probability", [0.68, 0.95])
def test_radius_against_sampling(eigenvalues: tuple[float, ...], probability: float) -> None:
    rng = np.random.default_rng(7)
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    errors = np.sqrt((rng.normal(size=(200_000, 3)) ** 2 * eigenvalues).sum(axis=1))
    covariance = axes @ np.diag(eigenvalues) @ axes.T
    assert error_radius(covariance, probability) == pytest.approx(np.quantile(errors, probability), rel=0.04)


def test_position_and_rotation_keep_apart() -> None:
    covariance = np.diag([0.04, 0.04, 0.04, 1e-6, 1e-6, 1e-6])
    radii = accuracy_from_covariance(covariance)
    assert radii.position_95_m == pytest.approx(TAIL_95 * 0.2 * 2.7955, rel=1e-3)
    assert radii.rotation_95_deg == pytest.approx(TAIL_95 * math.degrees(1e-3 * 2.7955), rel=1e-3)
    assert radii.position_68_m == pytest.approx(0.2 * 1.8724, rel=1e-3)  # the tail is heavier, the middle is not


def test_no_uncertainty_is_no_radius() -> None:
    assert error_radius(np.zeros((3, 3)), 0.95) == 0.0
