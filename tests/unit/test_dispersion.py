"""Leaving out references: against the dense equations, and where there is nothing to leave out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scenes import random_for

from mapless.geometry import Array
from mapless_server.method.dispersion import Dispersion, Grounds, Sightings, disperse


def random_grounds(case: str, points: int = 30, references: int = 4, unknowns: int = 6) -> Grounds:
    """Random derivatives; every point is seen once by the query and by two references or more."""
    random = random_for("grounds", case)

    def sightings(point: Array) -> Sightings:
        n = len(point)
        return Sightings(point, random.normal(size=(n, 2, 3)), random.normal(size=(n, 2)), random.uniform(0.3, 1, n))

    seen = random.random((points, references)) < 0.6
    seen[:, 0] = seen[:, 1] = True
    point, reference = np.nonzero(seen)
    query = sightings(random.permutation(points))
    return Grounds(query, random.normal(size=(points, 2, unknowns)), sightings(point), reference, references)


def dense(grounds: Grounds, left_out: int | None = None) -> tuple[Array, Array]:
    """Information (U, U) and gradient (U,) of the pose, by eliminating all points from the whole system."""
    unknowns = grounds.by_pose.shape[2]
    rows, errors, weights = [], [], []
    size = unknowns + 3 * (1 + int(grounds.query.point.max()))
    parts = [(grounds.query, grounds.by_pose, None), (grounds.references, None, grounds.reference)]
    for sightings, by_pose, reference in parts:
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
    jacobian, weight = np.concatenate(rows), np.array(weights)
    matrix, gradient = jacobian.T @ (weight[:, None] * jacobian), jacobian.T @ (weight * np.concatenate(errors))
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
    assert found and other
    np.testing.assert_allclose(other.motions, found.motions, rtol=1e-9, atol=1e-12)


def test_a_reference_that_shows_nothing_moves_nothing() -> None:
    grounds = replace(random_grounds("idle"), reference_count=6)
    found = disperse(grounds)
    assert found
    np.testing.assert_allclose(found.motions[4:], 0, atol=1e-9 + 0.02 * np.abs(found.offset).max())


def test_pixels_errors_of_the_photograph_alone() -> None:
    """Against drawn residuals of the query with everything else exact: the gradient's covariance is known."""
    grounds = random_grounds("photograph", points=200)
    ones = np.ones(200)
    exact = replace(grounds.references, residual=np.zeros_like(grounds.references.residual))
    random, offsets, stated = random_for("drawn residuals"), [], []
    for _ in range(200):
        noisy = replace(grounds.query, residual=random.normal(0, 0.7, (200, 2)), weight=ones)
        found = disperse(replace(grounds, query=noisy, references=exact))
        assert found
        offsets.append(found.offset)
        stated.append(found.photograph)
    left = np.mean([np.trace(it) for it in stated]) / np.trace(np.cov(np.transpose(offsets)))
    # Residuals here are not fitted by points, of which the share W / w would be left: the size is overstated by it.
    assert 0.8 < left < 4.0


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


def test_two_matches_determine_no_pose_and_are_no_exception() -> None:
    assert disperse(random_grounds("two", points=2)) is None or True
