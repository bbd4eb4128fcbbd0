"""Leaving out references: against the dense equations, and where there is nothing to leave out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.scenes import random_for

from mapless.geometry import Array
from mapless_server.method.uncertainty.dispersion import Dispersion, Grounds, Sightings, disperse


def random_grounds(case: str, points: int = 30, references: int = 4, unknowns: int = 6) -> Grounds:
    """Random derivatives; every point is seen once by the query and by two references or more."""
    random = random_for("grounds", case)

    def sightings(point: NDArray[np.intp]) -> Sightings:
        n = len(point)
        return Sightings(point, random.normal(size=(n, 2, 3)), random.normal(size=(n, 2)), random.uniform(0.3, 1, n))

    seen = random.random((points, references)) < 0.6
    seen[:, 0] = seen[:, 1] = True
    point, reference = np.nonzero(seen)
    query = sightings(random.permutation(points))
    return Grounds(query, random.normal(size=(points, 2, unknowns)), sightings(point), reference, references)


def whole(grounds: Grounds, left_out: int | None = None) -> tuple[Array, Array, Array]:
    """Jacobian (2 R, U + 3 P), residuals (2 R,) and weights (2 R,) of all rows, the query's first."""
    unknowns = grounds.by_pose.shape[2]
    rows, errors, weights = [], [], []
    size = unknowns + 3 * (1 + int(grounds.query.point.max()))
    for sightings, by_pose, reference in (
        (grounds.query, grounds.by_pose, None),
        (grounds.references, None, grounds.reference),
    ):
        for i, point in enumerate(sightings.point):
            if reference is not None and reference[i] == left_out:
                continue
            row = np.zeros((2, size))
            row[:, unknowns + 3 * point : unknowns + 3 * point + 3] = sightings.by_point[i]
            if by_pose is not None:
                row[:, :unknowns] = by_pose[i]
            rows.append(row)
            errors.append(sightings.residual[i])
            weights += [sightings.weight[i]] * 2
    return np.concatenate(rows), np.concatenate(errors), np.array(weights)


def dense(grounds: Grounds, left_out: int | None = None) -> tuple[Array, Array]:
    """Information (U, U) and gradient (U,) of the pose, by eliminating all points from the whole system."""
    unknowns = grounds.by_pose.shape[2]
    jacobian, errors, weight = whole(grounds, left_out)
    matrix, gradient = jacobian.T @ (weight[:, None] * jacobian), jacobian.T @ (weight * errors)
    coupling = np.linalg.solve(matrix[unknowns:, unknowns:], matrix[unknowns:, :unknowns]).T
    information = matrix[:unknowns, :unknowns] - coupling @ matrix[unknowns:, :unknowns]
    return information, gradient[:unknowns] - coupling @ gradient[unknowns:]


@pytest.mark.parametrize("unknowns", [6, 8])
def test_each_pose_is_one_step_of_the_dense_equations_away(unknowns: int) -> None:
    """With 8 unknowns, as a rig or a sequence may have them."""
    grounds = random_grounds("dense", unknowns=unknowns)
    found = disperse(grounds)
    assert isinstance(found, Dispersion)
    information, gradient = dense(grounds)
    np.testing.assert_allclose(found.information, information, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.offset, -np.linalg.solve(information, gradient), rtol=1e-7, atol=1e-9)
    for i in range(4):
        without, pull = dense(grounds, i)
        expected = -np.linalg.solve(without + 0.01 * information, pull) - found.offset
        np.testing.assert_allclose(found.motions[i], expected, rtol=1e-6, atol=1e-9)


def test_rows_may_stand_in_any_order() -> None:
    grounds = random_grounds("order")
    order = random_for("order").permutation(len(grounds.reference))
    r = grounds.references
    shuffled = Sightings(r.point[order], r.by_point[order], r.residual[order], r.weight[order])
    found = disperse(grounds)
    other = disperse(replace(grounds, references=shuffled, reference=grounds.reference[order]))
    assert found
    assert other
    np.testing.assert_allclose(other.motions, found.motions, rtol=1e-9, atol=1e-12)


def test_a_reference_that_shows_nothing_moves_nothing() -> None:
    grounds = replace(random_grounds("idle"), reference_count=6)
    found = disperse(grounds)
    assert found
    np.testing.assert_allclose(found.motions[4:], 0, atol=1e-9 + 0.02 * np.abs(found.offset).max())


def test_the_photographs_part_is_the_covariance_by_its_noise() -> None:
    """Residuals at the optimum of noise of 0.7 everywhere; the pose's answer to the query's noise alone is linear."""
    grounds = random_grounds("photograph", points=150)
    random, n = random_for("drawn residuals"), 150
    unit = replace(grounds.query, weight=np.ones(n))
    references = replace(grounds.references, weight=np.ones(len(grounds.reference)))
    plain = replace(grounds, query=unit, references=references)
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


def test_of_three_poses_the_covariance_is_the_jackknifes() -> None:
    motions = np.zeros((3, 6))
    motions[:, 0] = [0.1, -0.1, 0.3]
    found = Dispersion(np.eye(6), np.zeros(6), motions, np.zeros((6, 6)))
    expected = 2 / 3 * (2 / 4) ** 2 * (0.0**2 + 0.2**2 + 0.2**2)
    assert found.covariance[0, 0] == pytest.approx(expected)
    assert found.inflation**2 == pytest.approx(expected / 6)


def test_nothing_to_stand_on_is_no_dispersion() -> None:
    grounds = random_grounds("nothing")
    nowhere = replace(grounds.query, by_point=np.full_like(grounds.query.by_point, np.nan))
    assert disperse(replace(grounds, query=nowhere)) is None
    assert disperse(replace(grounds, by_pose=np.zeros_like(grounds.by_pose))) is None


@pytest.mark.parametrize("points", [1, 2, 3])
def test_few_matches_are_no_exception(points: int) -> None:
    found = disperse(random_grounds("few", points=points))
    assert found is None or np.isfinite(found.covariance).all()


def test_thinning_keeps_reference_errors_and_averages_the_photo() -> None:
    grounds = random_grounds("thinned")
    every, thinned = disperse(grounds), disperse(replace(grounds, thinning=3))
    assert every
    assert thinned
    np.testing.assert_allclose(thinned.photograph, every.photograph / 3)
    np.testing.assert_array_equal(thinned.motions, every.motions)
