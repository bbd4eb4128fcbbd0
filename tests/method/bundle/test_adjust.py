"""The final adjustment: its derivatives, its elimination of the points, and its accuracy."""

from dataclasses import replace

import numpy as np
import pytest
from support.compare import assert_jacobian, assert_pose_close, pose_error
from support.planted import NOISE, disturbed, drifted, stages, true_correspondences, true_structure
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for

from mapless import Accuracy
from mapless.geometry import Array, RigidTransform
from mapless.provenance import GIVEN_POSE, Provenance
from mapless_server.method.bundle.adjust import adjust_pose
from mapless_server.method.bundle.bundle import BundleProblem
from mapless_server.method.bundle.estimate import PoseEstimate
from mapless_server.method.bundle.normal_equations import Bundle
from mapless_server.method.bundle.pose_problem import (
    AdjustInput,
    AdjustOptions,
    most_probable,
    optimum,
    pose_errors,
    pose_problem,
)
from mapless_server.method.optim.optimize import MinimizeOptions, minimize
from mapless_server.method.pose.pnp import PnpOptions, solve_pose
from mapless_server.method.structure.model import PointMatches


def problem_of(case: str, moved: float = 0.0) -> tuple[BundleProblem, Bundle]:
    """A small problem, at its start or after random motions of size `moved`."""
    scene = make_scene(random_for(case), SceneOptions(point_count=25, reference_count=3))
    structure, matches = true_structure(scene, NOISE)
    used = np.arange(len(matches))
    given = AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions())
    problem, start = pose_problem(given, used, scene.world_from_query)
    state, random = start.bundle, random_for(case, "moved")
    motion = random.normal(0, moved, (len(state.poses.rotation), 6))
    return problem, state.moved(motion, random.normal(0, moved, state.points.shape))


def from_vector(state: Bundle, vector: Array) -> Bundle:
    """The state after the motions and steps in one vector."""
    split = 6 * len(state.poses.rotation)
    return state.moved(vector[:split].reshape(-1, 6), vector[split:].reshape(-1, 3))


def cheated_estimate(
    scene: SyntheticScene, matches: PointMatches, pose: RigidTransform, error_px: float
) -> PoseEstimate:
    """An estimate at a given pose that claims these errors."""
    solved = solve_pose(scene.query, true_structure(scene)[0], true_structure(scene)[1], pose, PnpOptions())
    assert isinstance(solved, PoseEstimate)
    n = len(matches)
    return replace(solved, world_from_camera=pose, inliers=np.ones(n, bool), errors_px=np.full(n, error_px))


# The problem


@pytest.mark.parametrize(("moved", "tolerance"), [(0.0, 1e-6), (1e-3, 2e-3)])
def test_gradient_equals_finite_differences_of_the_cost(moved: float, tolerance: float) -> None:
    """Half of it, as in least squares. Away from the start the prior's error is differentiated as if it were small."""
    problem, state = problem_of("gradient", moved)
    equations = problem.linearize(problem.at(state))
    gradient = np.concatenate([equations.pose_gradient, equations.point_gradient.T.ravel()])
    assert_jacobian(
        2 * gradient,
        lambda v: problem.cost(problem.at(from_vector(state, v))),
        np.zeros(len(gradient)),
        tolerance=tolerance,
    )


def test_the_optimum_is_near_that_of_many_steps() -> None:
    """By less than a standard deviation of the residuals."""
    for case in range(3):
        problem, state = problem_of(f"near {case}", 1e-3)
        far = minimize(problem, problem.at(state), MinimizeOptions(60, 1e-14))
        near = optimum(problem, problem.at(state), AdjustOptions())
        assert problem.query_motion_sigma(far, near, problem.linearize(far)) < 1


def residuals(problem: BundleProblem, state: Bundle) -> Array:
    """(O, 2)."""
    return problem.at(state).residual.T


def test_a_point_that_is_not_determined_gives_no_step() -> None:
    problem, state = problem_of("singular")
    equations = problem.linearize(problem.at(state))
    equations.point_block[:, 3] = 0.0
    assert problem.step(problem.at(state), equations, 1e-4) is None


# The adjustment


def mean_errors(own: float, options: SceneOptions, seeds: int, drift: float = 0.0) -> tuple[Array, Array]:
    """Mean errors (metres, degrees) before and after, over seeds; references are off by so many pixels or so.

    Each on its own by `own`, and in a drift with the distance from the query by `drift`.
    """
    before, after = [], []
    for seed in range(seeds):
        scene = make_scene(random_for("pays", seed), options)
        angle = 1 / options.camera.focal_x_px
        unit = np.array([angle * options.distance_m, np.degrees(angle)])
        references = disturbed(scene.references, random_for("noisy", seed), *(own * unit))
        centre = scene.world_from_query.translation
        references = drifted(references, centre, random_for("drifting", seed), *(drift * unit))
        structure, matches, estimate = stages(scene, references)
        adjusted = adjust_pose(AdjustInput(scene.query, references, structure, matches, AdjustOptions()), estimate)
        before.append(pose_error(estimate.world_from_camera, scene.world_from_query))
        after.append(pose_error(adjusted.world_from_camera, scene.world_from_query))
    return np.mean(before, axis=0), np.mean(after, axis=0)


FEW_POINTS = SceneOptions(point_count=120, reference_count=4, distractor_count=0)
MANY_POINTS = SceneOptions(point_count=300, reference_count=8, distractor_count=0)


def test_exact_references_do_not_make_the_pose_worse() -> None:
    """Up to what the Cauchy loss costs on keypoints that are all good: a tenth at most."""
    before, after = mean_errors(0.0, FEW_POINTS, seeds=12)
    assert (after <= 1.1 * before).all()


def test_references_with_errors_of_their_own_improve_the_pose() -> None:
    """The position; the angle loses at most a twentieth, for allowing for a drift that is not there."""
    before, after = mean_errors(1.0, MANY_POINTS, seeds=24)
    assert after[0] < 0.95 * before[0]
    assert after[1] < 1.05 * before[1]


def test_references_that_drift_hold_the_pose_by_the_nearest() -> None:
    before, after = mean_errors(0.0, MANY_POINTS, seeds=16, drift=1.0)
    assert (after < 0.9 * before).all()


def test_references_in_another_room_do_not_change_the_pose() -> None:
    scene = make_scene(random_for("another room"), MANY_POINTS)
    angle = 1 / MANY_POINTS.camera.focal_x_px
    centre = scene.world_from_query.translation
    errors = angle * MANY_POINTS.distance_m, float(np.degrees(angle))
    references = drifted(scene.references, centre, random_for("another room drifts"), *errors)
    structure, matches, estimate = stages(scene, references)
    far = [replace(it, world_from_camera=it.world_from_camera.shifted([200.0, 0, 0])) for it in references[:7]]
    alone, beside = (
        adjust_pose(AdjustInput(scene.query, views, structure, matches, AdjustOptions()), estimate)
        for views in (references, (*references, *far))
    )
    assert_pose_close(beside.world_from_camera, alone.world_from_camera, metres=1e-6, degrees=1e-5)


def test_sizes_of_errors_are_known_beside_unknown_poses() -> None:
    """A reference that may be 1000 m off says as little of the others' errors as one that may be 1 m off."""
    random, count, focal_px, depth_m = random_for("unknown poses"), 3, 1000.0, 0.01
    centres, rotations = random.normal(0, depth_m, (count, 3)), np.stack([np.eye(3)] * count)
    per_unit = np.tile([focal_px / depth_m] * 3 + [focal_px] * 3, count + 1)
    jacobian = random.normal(size=(2000, len(per_unit))) * per_unit
    residuals = jacobian @ (random.normal(size=len(per_unit)) / per_unit) + random.normal(size=len(jacobian))
    sizes = []
    for off_m in (1.0, 1000.0):
        stated = Provenance(accuracy=Accuracy(off_m, off_m, 180.0, 180.0))
        errors = pose_errors(
            centres, rotations, np.zeros(3), 1.0, focal_px, depth_m, None, [stated, GIVEN_POSE, stated]
        )
        sizes.append(most_probable(errors, jacobian.T @ jacobian, jacobian.T @ residuals))
    assert sizes[0] == sizes[1]


def test_a_rough_pose_converges_to_the_planted_one() -> None:
    scene = make_scene(random_for("pulled"), replace(FEW_POINTS, noise_px=0.0))
    structure, matches = true_structure(scene, NOISE)
    rough = RigidTransform(scene.world_from_query.rotation, scene.world_from_query.translation + [0.01, -0.01, 0.02])
    estimate = cheated_estimate(scene, matches, rough, error_px=1.0)
    adjusted = adjust_pose(AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions()), estimate)
    assert_pose_close(adjusted.world_from_camera, scene.world_from_query, metres=1e-4, degrees=1e-3)
    assert np.median(adjusted.errors_px) < 0.01


# Keypoints that the query shares with references, without a point


def with_few_points(case: str, count: int, wrong_share: float = 0.0) -> tuple[PoseEstimate, PoseEstimate, Array]:
    """Estimates without and with the query's matches, where so many points are triangulated, and the true errors."""
    scene = make_scene(random_for(case), MANY_POINTS)
    structure, matches, estimate = stages(scene, scene.references)
    few = np.arange(len(structure.x_in_world)) < count
    structure = replace(structure, x_in_world=structure.x_in_world[few], tracks=structure.tracks.select(few))
    kept = few[matches.point]
    matches = PointMatches(matches.point[kept], matches.keypoint[kept], matches.guided[kept], 0.0)
    estimate = replace(estimate, inliers=estimate.inliers[kept], errors_px=estimate.errors_px[kept])
    random = random_for(case, "wrong")
    query_matches = []
    for found in true_correspondences(scene).query_matches:
        wrong = found[random.random(len(found)) < wrong_share, 1]
        found[np.isin(found[:, 1], wrong), 1] = random.permutation(wrong)
        query_matches.append(found)
    given = AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions())
    before, after = (adjust_pose(it, estimate) for it in (given, replace(given, query_matches=query_matches)))
    errors = [pose_error(it.world_from_camera, scene.world_from_query) for it in (before, after)]
    return before, after, np.array(errors)


@pytest.mark.parametrize("wrong_share", [0.0, 0.4])
def test_keypoints_without_a_point_make_a_pose_from_few_points_better(wrong_share: float) -> None:
    errors = np.mean([with_few_points(f"few {seed}", 12, wrong_share)[2] for seed in range(6)], axis=0)
    assert (errors[1] < 0.6 * errors[0]).all()


def test_keypoints_without_a_point_are_no_inliers_of_the_answer() -> None:
    before, after, _ = with_few_points("inliers", 12)
    assert len(after.inliers) == len(after.errors_px) == len(before.inliers)
    assert np.trace(after.covariance[:3, :3]) < np.trace(before.covariance[:3, :3])


def test_a_pose_that_own_points_alone_hold_is_not_used() -> None:
    """The matches with points are all off by six pixels; too few agree with the pose of the others."""
    scene = make_scene(random_for("own alone"), MANY_POINTS)
    structure, matches, _ = stages(scene, scene.references)
    few = np.arange(len(structure.x_in_world)) < 8
    kept = few[matches.point]
    structure = replace(structure, x_in_world=structure.x_in_world[few], tracks=structure.tracks.select(few))
    matches = PointMatches(matches.point[kept], matches.keypoint[kept], matches.guided[kept], 0.0)
    keypoints = scene.query.features.keypoints.copy()
    keypoints[matches.keypoint] += np.array([6.0, 0.0], np.float32)
    query = replace(scene.query, features=replace(scene.query.features, keypoints=keypoints))
    estimate = cheated_estimate(scene, matches, scene.world_from_query, error_px=1.0)
    others = [it[~np.isin(it[:, 0], matches.keypoint)] for it in true_correspondences(scene).query_matches]
    given = AdjustInput(query, scene.references, structure, matches, AdjustOptions(), query_matches=others)
    assert adjust_pose(given, estimate).inliers.all()


def test_few_keypoints_without_a_point_change_nothing() -> None:
    before, after, _ = with_few_points("most", 230)
    np.testing.assert_array_equal(after.world_from_camera.matrix(), before.world_from_camera.matrix())


def test_matches_with_large_errors_are_not_used() -> None:
    scene = make_scene(random_for("far off"), replace(FEW_POINTS, noise_px=0.0))
    structure, matches = true_structure(scene, NOISE)
    random = random_for("far off matches")
    swapped = matches.keypoint.copy()
    swapped[:20] = random.permutation(swapped[:20])
    wrong = replace(matches, keypoint=swapped)
    estimate = solve_pose(scene.query, structure, wrong, scene.world_from_query, PnpOptions())
    assert isinstance(estimate, PoseEstimate)
    adjusted = adjust_pose(AdjustInput(scene.query, scene.references, structure, wrong, AdjustOptions()), estimate)
    assert_pose_close(adjusted.world_from_camera, scene.world_from_query, metres=1e-3, degrees=0.01)


@pytest.mark.parametrize("count", [0, 1, 2, 3])
def test_fewer_matches_than_unknowns_change_nothing(count: int) -> None:
    scene = make_scene(random_for("too few"), FEW_POINTS)
    structure, matches = true_structure(scene, NOISE)
    estimate = cheated_estimate(scene, matches, scene.world_from_query, error_px=100.0)
    errors_px = estimate.errors_px.copy()
    errors_px[:count] = 0.5
    estimate = replace(estimate, errors_px=errors_px)
    adjusted = adjust_pose(AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions()), estimate)
    if count < 3:
        assert adjusted is estimate
    assert np.isfinite(adjusted.world_from_camera.matrix()).all()


def test_matches_with_one_point_raise_no_exception() -> None:
    scene = make_scene(random_for("singular"), FEW_POINTS)
    structure, matches = true_structure(scene, NOISE)
    estimate = cheated_estimate(scene, matches, scene.world_from_query, error_px=0.5)
    for points in (np.zeros_like(structure.x_in_world), np.full_like(structure.x_in_world, np.nan)):
        nowhere = replace(structure, x_in_world=points)
        adjusted = adjust_pose(AdjustInput(scene.query, scene.references, nowhere, matches, AdjustOptions()), estimate)
        assert np.isfinite(adjusted.world_from_camera.matrix()).all()
        assert np.isfinite(adjusted.covariance).all()
