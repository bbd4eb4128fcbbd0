"""The final adjustment with priors: derivatives; right priors improve weak poses, others change nothing."""

from dataclasses import replace

import numpy as np
import pytest
from support.compare import assert_jacobian, pose_error
from support.planted import NOISE, true_structure
from support.scenes import SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.adjust import adjust_pose
from mapless_server.method.perturbation import moved
from mapless_server.method.pnp import PnpOptions, solve_pose
from mapless_server.method.pose_problem import AdjustOptions, pose_problem
from mapless_server.method.priors.known import NO_PRIORS, GravityPrior, HeadingPrior, PosePrior, PositionPrior, Priors
from mapless_server.method.results import PointMatches, PoseEstimate, Structure

DOWN = np.array([0.0, 1.0, 0.0])


def scene_of(case: object) -> tuple[SyntheticScene, Structure, PointMatches]:
    scene = make_scene(random_for("adjust priors", case), SceneOptions(point_count=60, reference_count=3))
    return scene, *true_structure(scene, NOISE)


def gravity_at(pose: RigidTransform, sigma_deg: float, tilt_deg: float = 0.0) -> GravityPrior:
    down = rotation_from_vector([np.radians(tilt_deg), 0, 0]) @ pose.rotation.T @ DOWN
    return GravityPrior(down / np.linalg.norm(down), DOWN, sigma_deg)


def all_priors(pose: RigidTransform, off: float) -> Priors:
    """Of all kinds, a little off."""
    there = moved(pose, off * np.array([1.0, -1, 2, 0.5, 0.3, -0.4]))
    return Priors(
        PositionPrior(there.translation, np.diag([0.02, 0.03, 0.04]) ** 2),
        HeadingPrior.looking(there.rotation[:, 2], 1.0),
        gravity_at(there, 0.5),
        PosePrior(there, np.diag([0.03] * 3 + [0.02] * 3) ** 2),
    )


def adjusted(
    scene: SyntheticScene, structure: Structure, matches: PointMatches, priors: Priors = NO_PRIORS
) -> PoseEstimate:
    """Solved without priors, adjusted with them."""
    solved = solve_pose(scene.query, structure, matches, scene.world_from_query, PnpOptions())
    assert isinstance(solved, PoseEstimate)
    return adjust_pose(scene.query, scene.references, structure, matches, solved, AdjustOptions(), priors)


def test_gradient_with_priors_equals_finite_differences() -> None:
    scene, structure, matches = scene_of("gradient")
    used = np.arange(len(matches))
    problem, state = pose_problem(
        scene.query, scene.references, structure, matches, used, scene.world_from_query, AdjustOptions()
    )
    problem = replace(problem, priors=all_priors(scene.world_from_query, 0.01), prior_weight=4.0)
    gradient = problem.linearize(state).pose_gradient[-6:]

    def cost(motion: Array) -> float:
        motions = np.zeros((len(state.poses.rotation), 6))
        motions[-1] = motion
        return problem.cost(state.moved(motions, np.zeros_like(state.points)))

    assert_jacobian(2 * gradient, cost, np.zeros(6), tolerance=1e-5)


def test_right_priors_improve_a_weak_pose_and_its_covariance() -> None:
    """Seven matches among the points and a position to a millimetre."""
    alone, helped = [], []
    for seed in range(8):
        scene, structure, matches = scene_of(seed)
        rows = np.linspace(0, len(matches) - 1, 7).astype(int)
        few = PointMatches(matches.point[rows], matches.keypoint[rows], matches.guided[rows], 0.0)
        rng = random_for("weak", seed)
        position = PositionPrior(scene.world_from_query.translation + rng.normal(0, 0.001, 3), 0.001**2 * np.eye(3))
        without, estimate = adjusted(scene, structure, few), adjusted(scene, structure, few, Priors(position))
        assert [check.used for check in estimate.prior_checks] == [True]
        assert np.trace(estimate.covariance[:3, :3]) < np.trace(without.covariance[:3, :3])
        alone.append(pose_error(without.world_from_camera, scene.world_from_query))
        helped.append(pose_error(estimate.world_from_camera, scene.world_from_query))
    assert np.median(helped, axis=0)[0] < 0.5 * np.median(alone, axis=0)[0]


@pytest.mark.parametrize("kind", ["position", "heading", "gravity", "pose"])
def test_a_wrong_prior_is_reported_and_changes_no_bit(kind: str) -> None:
    scene, structure, matches = scene_of("wrong")
    wrong = getattr(all_priors(scene.world_from_query, 1.0), kind)
    without = adjusted(scene, structure, matches)
    estimate = adjusted(scene, structure, matches, Priors(**{kind: wrong}))
    (check,) = estimate.prior_checks
    assert (check.kind.value, check.conflict, check.used) == (kind, True, False)
    assert estimate.world_from_camera.matrix().tobytes() == without.world_from_camera.matrix().tobytes()
    assert estimate.covariance.tobytes() == without.covariance.tobytes()


def test_unused_priors_do_not_change_the_answer() -> None:
    """The pose solver, for which points are fixed, used a prior that the adjustment does not use."""
    scene, structure, matches = scene_of("undone")
    solved = solve_pose(scene.query, structure, matches, scene.world_from_query, PnpOptions())
    assert isinstance(solved, PoseEstimate)
    pulled_to = moved(solved.world_from_camera, np.array([0.01, 0, 0, 0.002, 0, 0]))
    pulled = replace(solved, world_from_camera=pulled_to, errors_px=solved.errors_px + 1, without_priors=solved)
    priors = Priors(gravity=gravity_at(scene.world_from_query, 3.0))
    given = scene.query, scene.references, structure, matches
    answer, alone = adjust_pose(*given, pulled, AdjustOptions(), priors), adjust_pose(*given, solved, AdjustOptions())
    assert [check.used for check in answer.prior_checks] == [False]
    assert answer.world_from_camera.matrix().tobytes() == alone.world_from_camera.matrix().tobytes()
