"""Dispersion of a pose without parts of its data: against the dense equations, and in undetermined cases."""

import numpy as np
import pytest
import scipy.linalg
from support.planted import NO_INTRINSICS, NOISE, true_structure
from support.scenes import SceneOptions, make_scene, random_for

from mapless.geometry import Array
from mapless_server.method.bundle.bundle import BundleProblem
from mapless_server.method.bundle.dispersion import LEAST_LEFT, Dispersion, disperse
from mapless_server.method.bundle.normal_equations import Bundle
from mapless_server.method.bundle.pose_problem import AdjustInput, AdjustOptions, pose_problem


def planted(case: str, references: int = 4, points: int = 40) -> tuple[BundleProblem, Bundle]:
    """A problem off its optimum, the references off their given poses."""
    scene = make_scene(random_for(case), SceneOptions(point_count=points, reference_count=references))
    structure, matches = true_structure(scene, NOISE)
    used = np.arange(len(matches))
    pose = scene.world_from_query
    problem, start = pose_problem(
        AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions()), used, pose
    )
    motion = random_for(case, "moved").normal(0, 1e-3, (references + 1, 6))
    return problem, start.bundle.moved(motion, np.zeros_like(start.bundle.points))


def dense(problem: BundleProblem, state: Bundle, left_out: int | None = None) -> tuple[Array, Array]:
    """Matrix and gradient of the cameras, from the whole system without the observations of one reference."""
    seen = problem.by_view
    there = seen.at(state)
    residual, by_point, by_pose = there.residual, there.by_point, there.by_pose
    weight = 1 / (1 + (residual**2).sum(axis=0) / problem.loss_scale_sigma**2)
    cameras = 6 * len(state.poses.rotation)
    jacobian = np.zeros((2, len(weight), cameras + 3 * len(state.points)))
    for o, (view, point) in enumerate(zip(seen.view, seen.point, strict=True)):
        if view != left_out:
            jacobian[:, o, 6 * view : 6 * view + 6] = by_pose[:, :, o]
            jacobian[:, o, cameras + 3 * point : cameras + 3 * point + 3] = by_point[:, :, o]
    rows = jacobian.reshape(-1, jacobian.shape[2])
    weights = np.tile(weight, 2)
    curvature = weights**2  # on average over the directions of a residual
    matrix, gradient = rows.T @ (curvature[:, None] * rows), rows.T @ (weights * residual.ravel())
    matrix[cameras:, cameras:] += 1e-7 * np.diag(np.diag(matrix)[cameras:])
    crossed = scipy.linalg.solve(matrix[cameras:, cameras:], matrix[cameras:, :cameras], assume_a="pos").T
    matrix, gradient = (
        matrix[:cameras, :cameras] - crossed @ matrix[cameras:, :cameras],
        gradient[:cameras] - (crossed @ gradient[cameras:]),
    )
    return matrix, gradient


def held(problem: BundleProblem, state: Bundle, matrix: Array, gradient: Array) -> tuple[Array, Array]:
    """With the prior on the references."""
    free = np.zeros((6, 6))
    pull = problem.information @ problem.reference_motion(state).ravel()
    return matrix + scipy.linalg.block_diag(problem.information, free), gradient + np.append(pull, np.zeros(6))


@pytest.mark.parametrize("references", [3, 5])
def test_steps_equal_those_of_the_dense_equations(references: int) -> None:
    problem, state = planted("dense", references)
    found = disperse(problem, state, 1000)
    assert found
    whole, gradient = held(problem, state, *dense(problem, state))
    offset = -np.linalg.solve(whole, gradient)[-6:]
    np.testing.assert_allclose(found.offset, offset, atol=1e-4 * np.abs(offset).max())
    covariance = np.linalg.inv(whole)[-6:, -6:]
    for i in range(references):
        matrix, pull = held(problem, state, *dense(problem, state, i))
        matrix[-6:, -6:] += LEAST_LEFT * np.linalg.inv(covariance)
        expected = -np.linalg.solve(matrix, pull)[-6:] - offset
        np.testing.assert_allclose(found.references[i], expected, atol=1e-3 * np.abs(found.references).max())
    np.testing.assert_allclose(found.modelled, covariance, atol=1e-3 * np.abs(covariance).max())
    assert found.observing_count == references


def test_the_gap_is_that_to_the_nearest_reference() -> None:
    problem, state = planted("gap")
    found = disperse(problem, state, 1000)
    assert found
    query = state.world_from_query
    apart = np.linalg.norm(state.poses.centres[:-1] - query.translation, axis=1).min()
    assert found.gap == pytest.approx(apart / np.median(query.inverse().apply(state.points)[:, 2]))


def test_the_regions_together_are_the_whole_gradient() -> None:
    problem, state = planted("regions")
    start = Bundle(problem.given.and_last(state.world_from_query.inverse()), state.points)
    found = disperse(problem, start, 1000)
    assert found
    np.testing.assert_allclose(found.regions.sum(axis=0), found.offset, atol=1e-9)


def test_covariance_of_three_poses_equals_the_jackknife() -> None:
    references, regions = np.zeros((3, 6)), np.zeros((4, 6))
    references[:, 0], references[:, 4] = [1, 2, 6], [0, 3, 0]
    regions[:, 0] = [1, -1, 2, -2]
    covariance = Dispersion(references, regions, np.zeros(6), np.eye(6), 3, 0.1, NO_INTRINSICS).covariance(3.0)
    assert covariance[0, 0] == pytest.approx(2 / 3 * (4 + 1 + 9) + 9 * 10)
    assert covariance[4, 4] == pytest.approx(2 / 3 * (1 + 4 + 1))
    assert covariance[0, 4] == pytest.approx(2 / 3 * (2 - 2 - 3))


def test_undetermined_equations_have_no_dispersion() -> None:
    problem, state = planted("nothing")
    nowhere = Bundle(state.poses, np.zeros_like(state.points))
    assert disperse(problem, nowhere, 1000) is None
    behind = Bundle(state.poses, state.points.copy())
    behind.points[0] = np.nan
    assert disperse(problem, behind, 1000) is None


@pytest.mark.parametrize("points", [8, 12])
def test_few_matches_have_a_dispersion(points: int) -> None:
    found = disperse(*planted("few", 4, points), 1000)
    assert found
    assert np.isfinite(found.covariance(1.0)).all()
