"""Dispersion by leaving out references: against the dense equations, and in undetermined cases."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import random_for

from mapless.geometry import Array
from mapless_server.method.uncertainty.dispersion import Dispersion, JackknifeInput, LinearizedObservations, disperse


def random_input(case: str, points: int = 30, references: int = 4, unknowns: int = 6) -> JackknifeInput:
    """Random derivatives; every point is seen once by the query and by two references or more."""
    random = random_for("grounds", case)

    def observations(point: NDArray[np.intp]) -> LinearizedObservations:
        n = len(point)
        return LinearizedObservations(
            point, random.normal(size=(n, 2, 3)), random.normal(size=(n, 2)), random.uniform(0.3, 1, n)
        )

    seen = random.random((points, references)) < 0.6
    seen[:, 0] = seen[:, 1] = True
    point, reference = np.nonzero(seen)
    query = observations(random.permutation(points))
    return JackknifeInput(query, random.normal(size=(points, 2, unknowns)), observations(point), reference, references)


def whole(jackknife: JackknifeInput, left_out: int | None = None) -> tuple[Array, Array, Array]:
    """Jacobian (2 R, U + 3 P), residuals (2 R,) and weights (2 R,) of all rows, the query's first."""
    unknowns = jackknife.by_pose.shape[2]
    rows, errors, weights = [], [], []
    size = unknowns + 3 * (1 + int(jackknife.query.point.max()))
    for observations, by_pose, reference in (
        (jackknife.query, jackknife.by_pose, None),
        (jackknife.references, None, jackknife.reference),
    ):
        for i, point in enumerate(observations.point):
            if reference is not None and reference[i] == left_out:
                continue
            row = np.zeros((2, size))
            row[:, unknowns + 3 * point : unknowns + 3 * point + 3] = observations.by_point[i]
            if by_pose is not None:
                row[:, :unknowns] = by_pose[i]
            rows.append(row)
            errors.append(observations.residual[i])
            weights += [observations.weight[i]] * 2
    return np.concatenate(rows), np.concatenate(errors), np.array(weights)


def dense(jackknife: JackknifeInput, left_out: int | None = None) -> tuple[Array, Array]:
    """Information (U, U) and gradient (U,) of the pose, by eliminating all points from the whole system."""
    unknowns = jackknife.by_pose.shape[2]
    jacobian, errors, weight = whole(jackknife, left_out)
    matrix, gradient = jacobian.T @ (weight[:, None] * jacobian), jacobian.T @ (weight * errors)
    coupling = np.linalg.solve(matrix[unknowns:, unknowns:], matrix[unknowns:, :unknowns]).T
    information = matrix[:unknowns, :unknowns] - coupling @ matrix[unknowns:, :unknowns]
    return information, gradient[:unknowns] - coupling @ gradient[unknowns:]


@pytest.mark.parametrize("unknowns", [6, 8])
def test_left_out_poses_equal_one_dense_gauss_newton_step(unknowns: int) -> None:
    """With 8 unknowns, as a rig or a sequence may have them."""
    jackknife = random_input("dense", unknowns=unknowns)
    found = disperse(jackknife)
    assert isinstance(found, Dispersion)
    information, gradient = dense(jackknife)
    np.testing.assert_allclose(found.information, information, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.offset, -np.linalg.solve(information, gradient), rtol=1e-7, atol=1e-9)
    for i in range(4):
        without, pull = dense(jackknife, i)
        expected = -np.linalg.solve(without + 0.01 * information, pull) - found.offset
        np.testing.assert_allclose(found.motions[i], expected, rtol=1e-6, atol=1e-9)


def test_the_order_of_rows_does_not_matter() -> None:
    jackknife = random_input("order")
    order = random_for("order").permutation(len(jackknife.reference))
    r = jackknife.references
    shuffled = LinearizedObservations(r.point[order], r.by_point[order], r.residual[order], r.weight[order])
    found = disperse(jackknife)
    other = disperse(replace(jackknife, references=shuffled, reference=jackknife.reference[order]))
    assert found
    assert other
    np.testing.assert_allclose(other.motions, found.motions, rtol=1e-9, atol=1e-12)


def test_a_reference_without_observations_adds_no_dispersion() -> None:
    jackknife = replace(random_input("idle"), reference_count=6)
    found = disperse(jackknife)
    assert found
    np.testing.assert_allclose(found.motions[4:], 0, atol=1e-9 + 0.02 * np.abs(found.offset).max())


def test_the_photos_part_is_the_covariance_of_its_noise() -> None:
    """Residuals at the optimum of noise of 0.7 everywhere; the pose's answer to the query's noise alone is linear."""
    jackknife = random_input("photograph", points=150)
    random, n = random_for("drawn residuals"), 150
    unit = replace(jackknife.query, weight=np.ones(n))
    references = replace(jackknife.references, weight=np.ones(len(jackknife.reference)))
    plain = replace(jackknife, query=unit, references=references)
    jacobian, _, _ = whole(plain)
    answer = -np.linalg.pinv(jacobian)[:6, : 2 * n]
    expected = 0.7**2 * answer @ answer.T
    noise = random.normal(0, 0.7, len(jacobian))
    left = (noise - jacobian @ (np.linalg.pinv(jacobian) @ noise))[: 2 * n].reshape(n, 2)
    found = disperse(replace(plain, query=replace(unit, residual=left)))
    assert found
    size = np.trace(found.photograph) / np.trace(expected)
    assert size == pytest.approx(1, abs=0.35)  # the median of 150 squared lengths
    np.testing.assert_allclose(found.photograph, size * expected, atol=1e-9 + 1e-6 * np.abs(expected).max())


def test_covariance_of_three_poses_equals_the_jackknife() -> None:
    motions = np.zeros((3, 6))
    motions[:, 0] = [0.1, -0.1, 0.3]
    found = Dispersion(np.eye(6), np.zeros(6), motions, np.zeros((6, 6)))
    expected = 2 / 3 * (2 / 4) ** 2 * (0.0**2 + 0.2**2 + 0.2**2)
    assert found.covariance[0, 0] == pytest.approx(expected)
    assert found.inflation**2 == pytest.approx(expected / 6)


def test_undetermined_equations_have_no_dispersion() -> None:
    jackknife = random_input("nothing")
    nowhere = replace(jackknife.query, by_point=np.full_like(jackknife.query.by_point, np.nan))
    assert disperse(replace(jackknife, query=nowhere)) is None
    assert disperse(replace(jackknife, by_pose=np.zeros_like(jackknife.by_pose))) is None


@pytest.mark.parametrize("points", [1, 2, 3])
def test_few_matches_raise_no_exception(points: int) -> None:
    found = disperse(random_input("few", points=points))
    assert found is None or np.isfinite(found.covariance).all()


def test_thinning_divides_the_photographs_part_only() -> None:
    jackknife = random_input("thinned")
    every, thinned = disperse(jackknife), disperse(replace(jackknife, thinning=3))
    assert every
    assert thinned
    np.testing.assert_allclose(thinned.photograph, every.photograph / 3)
    np.testing.assert_array_equal(thinned.motions, every.motions)
