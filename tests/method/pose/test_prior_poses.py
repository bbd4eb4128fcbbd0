"""Poses from two matches and gravity: the library's conventions by planted poses, and what priors do to an answer.

A weak query must be pulled right, a wrong prior must change nothing, to the last bit.
"""

from dataclasses import replace

import numpy as np
import pytest
from support.compare import assert_jacobian, assert_pose_close, pose_error
from support.planted import NOISE, true_structure
from support.pnp_problems import problem_of
from support.scenes import CAMERA, SceneOptions, SyntheticScene, make_scene, random_for

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.bundle.adjust import adjust_pose
from mapless_server.method.bundle.estimate import PoseEstimate, PoseStage
from mapless_server.method.bundle.pose_problem import AdjustInput, AdjustOptions, pose_problem
from mapless_server.method.bundle.priors import NO_PRIORS, GravityPrior, HeadingPrior, PosePrior, PositionPrior, Priors
from mapless_server.method.optim.optimize import MinimizeOptions, moved
from mapless_server.method.pose import with_priors as informed
from mapless_server.method.pose.pnp import PnpOptions, solve_pose
from mapless_server.method.pose.with_priors import ransac_with_gravity, refine_pose, solve_pairs
from mapless_server.method.structure.model import PixelPoints, PointMatches, Structure

POSE = RigidTransform(rotation_from_vector([0.2, -0.3, 0.1]), np.array([0.4, -0.2, -4.0]))
DOWNS = {"y down": [0, 1, 0], "y up": [0, -1, 0], "z up": [0, 0, -1], "x up": [-1, 0, 0], "askew": [0.6, 0.0, 0.8]}


def gravity(
    down: Array | None = None, noise_deg: float = 0.0, sigma_deg: float = 1.0, pose: RigidTransform = POSE
) -> GravityPrior:
    """The reading of an accelerometer in the camera at the pose, tilted about one axis."""
    down = np.array([0.0, 0.0, -1.0]) if down is None else np.asarray(down, float)
    tilted = rotation_from_vector([np.radians(noise_deg), 0, 0]) @ pose.rotation.T @ down
    return GravityPrior(tilted / np.linalg.norm(tilted), down, sigma_deg)


def seen(rng: np.random.Generator, count: int, noise_px: float = 0.5, wrong: int = 0) -> tuple[Array, Array]:
    """Points all over the image of a camera at POSE and their pixels; the first ones are seen elsewhere."""
    pixels = rng.uniform([0, 0], [959, 719], (count, 2))
    x_in_world = POSE.apply(CAMERA.rays(pixels) * rng.uniform(3, 6, (count, 1)))
    pixels = pixels + rng.normal(0, noise_px, pixels.shape)
    pixels[:wrong] = rng.uniform([0, 0], [959, 719], (wrong, 2))
    return x_in_world, pixels


def solved(
    x_in_world: Array, pixels: Array, priors: Priors = NO_PRIORS, initial: RigidTransform = POSE
) -> PoseEstimate:
    estimate = solve_pose(*problem_of(x_in_world, pixels), initial, PnpOptions(), priors)
    assert isinstance(estimate, PoseEstimate), estimate
    return estimate


# The solver and its conventions


@pytest.mark.parametrize("down", DOWNS.values(), ids=DOWNS)
def test_two_matches_and_gravity_give_the_planted_pose(down: list[float]) -> None:
    for seed in range(5):
        x_in_world, pixels = seen(random_for("pairs", seed), 2, noise_px=0)
        rays = CAMERA.rays(pixels)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        prior = gravity(np.array(down, float))
        rotations, translations = solve_pairs(prior, rays, x_in_world, np.array([[0, 1]]))
        poses = [RigidTransform(r, t).inverse() for r, t in zip(rotations, translations, strict=True)]
        assert 1 <= len(poses) <= 2
        for pose in poses:
            np.testing.assert_allclose(pose.rotation @ prior.in_camera, prior.in_world, atol=1e-9)
        best = min(poses, key=lambda it: sum(pose_error(it, POSE)))
        assert_pose_close(best, POSE, metres=1e-6, degrees=1e-5)


def test_two_matches_of_one_point_have_no_pose() -> None:
    point = np.array([[0.0, 0, 1], [0, 0, 1]])
    rotations, translations = solve_pairs(gravity(), point, np.ones((2, 3)), np.array([[0, 1]]))
    assert np.isfinite(rotations).all()
    assert np.isfinite(translations).all()


@pytest.mark.parametrize("wrong", [0, 40, 80])
def test_the_planted_pose_is_found_with_gravity_a_degree_off(wrong: int) -> None:
    for seed in range(4):
        x_in_world, pixels = seen(random_for("ransac", wrong, seed), 100, wrong=wrong)
        down = gravity(noise_deg=1)
        poses = ransac_with_gravity(PixelPoints(CAMERA, x_in_world, pixels), down, Priors(gravity=down), 4.0)
        assert_pose_close(poses[0], POSE, metres=0.05, degrees=0.6)


# Refinement


def test_the_refinement_is_at_a_minimum_of_matches_and_priors(monkeypatch: pytest.MonkeyPatch) -> None:
    """No small motion lowers the cost, written down here a second time."""
    rng = random_for("minimum")
    x_in_world, pixels = seen(rng, 12)
    priors = Priors(
        PositionPrior(POSE.translation + 0.05, 0.02**2 * np.eye(3)),
        HeadingPrior.looking(POSE.rotation[:, 2], 2.0),
        gravity(noise_deg=2),
        PosePrior(moved(POSE, np.full(6, 0.03)), 0.05**2 * np.eye(6)),
    )

    def cost(pose: RigidTransform) -> float:
        errors = CAMERA.project(pose.inverse().apply(x_in_world)) - pixels
        squared = (errors**2).sum(axis=1)
        scale = informed.LOSS_SCALE_PX**2
        return float((scale * np.log1p(squared / scale)).sum()) + informed.PRIOR_WEIGHT * priors.cost(pose)

    monkeypatch.setattr(informed, "STEPS", MinimizeOptions(40, 1e-12))
    found = refine_pose(PixelPoints(CAMERA, x_in_world, pixels), POSE, priors)
    for axis in np.eye(6):
        for step in (-1e-4, 1e-4):
            assert cost(moved(found, step * axis)) > cost(found)


# Answers


def hardly_seen(rng: np.random.Generator) -> tuple[Array, Array]:
    """Six points far away in a small corner of the image: their pose is known along one line and in one tilt only."""
    pixels = rng.uniform([440, 320], [520, 400], (6, 2))
    x_in_world = POSE.apply(CAMERA.rays(pixels) * rng.uniform(8, 9, (6, 1)))
    return x_in_world, pixels + rng.normal(0, 0.5, pixels.shape)


def test_priors_improve_a_weak_query() -> None:
    """Six points in a corner leave degrees of freedom that gravity to half a degree and a position to 2 cm fix."""
    alone, helped = [], []
    for seed in range(12):
        rng = random_for("weak", seed)
        x_in_world, pixels = hardly_seen(rng)
        priors = Priors(
            PositionPrior(POSE.translation + rng.normal(0, 0.02, 3), 0.02**2 * np.eye(3)),
            gravity=gravity(noise_deg=0.5),
        )
        alone.append(pose_error(solved(x_in_world, pixels).world_from_camera, POSE))
        estimate = solved(x_in_world, pixels, priors)
        assert all(check.used and not check.conflict for check in estimate.prior_checks)
        helped.append(pose_error(estimate.world_from_camera, POSE))
    assert np.median(helped, axis=0)[0] < 0.5 * np.median(alone, axis=0)[0]
    assert np.median(helped, axis=0)[0] < 0.1


def wrong_priors() -> dict[str, Priors]:
    flipped = GravityPrior(-gravity().in_camera, gravity().in_world, 1.0)
    return {
        "gravity upside down": Priors(gravity=flipped),
        "gravity tilted": Priors(gravity=gravity(noise_deg=20)),
        "heading": Priors(heading=HeadingPrior.looking(-POSE.rotation[:, 2], 5.0)),
        "position": Priors(PositionPrior(POSE.translation + 3.0, 0.1**2 * np.eye(3))),
        "pose": Priors(pose=PosePrior(moved(POSE, np.full(6, 0.5)), 0.05**2 * np.eye(6))),
    }


@pytest.mark.parametrize("name", wrong_priors())
@pytest.mark.parametrize("count", [20, 200], ids=["few matches", "many"])
def test_a_wrong_prior_is_a_conflict_and_changes_no_bit(name: str, count: int) -> None:
    x_in_world, pixels = seen(random_for("wrong", name), count, wrong=count // 4)
    without = solved(x_in_world, pixels)
    estimate = solved(x_in_world, pixels, wrong_priors()[name])
    (check,) = estimate.prior_checks
    assert (check.conflict, check.used) == (True, False)
    assert estimate.world_from_camera.matrix().tobytes() == without.world_from_camera.matrix().tobytes()
    assert estimate.covariance.tobytes() == without.covariance.tobytes()


def test_one_wrong_prior_does_not_exclude_the_right_one() -> None:
    x_in_world, pixels = hardly_seen(random_for("one of two"))
    position = PositionPrior(POSE.translation, 0.02**2 * np.eye(3))
    flipped = GravityPrior(-gravity().in_camera, gravity().in_world, 1.0)
    estimate = solved(x_in_world, pixels, Priors(position, gravity=flipped))
    assert [(check.kind.value, check.conflict, check.used) for check in estimate.prior_checks] == [
        ("position", False, True),
        ("gravity", True, False),
    ]


def test_gravity_finds_a_pose_that_plain_pnp_does_not() -> None:
    """Nine right ones of 240: three are drawn in one of 20 000 samples, PoseLib's most; two in one of 700."""
    found_alone = found_with = 0
    options = PnpOptions(max_iterations=512)
    for seed in range(6):
        x_in_world, pixels = seen(random_for("needle", seed), 240, wrong=222)
        nowhere = POSE.shifted(np.array([50.0, 0, 0]))
        problem = problem_of(x_in_world, pixels)
        for priors in (Priors(), Priors(gravity=gravity(noise_deg=0.3, sigma_deg=0.5))):
            estimate = solve_pose(*problem, nowhere, options, priors)
            right = isinstance(estimate, PoseEstimate) and pose_error(estimate.world_from_camera, POSE)[0] < 0.1
            found_alone, found_with = found_alone + (right and not priors), found_with + (right and bool(priors))
    assert found_with > found_alone
    assert found_with >= 4


def test_a_pose_prior_replaces_a_lost_initial_pose() -> None:
    """Among so many wrong matches only a search near the right pose finds the right ones."""
    x_in_world, pixels = seen(random_for("lost"), 300, wrong=292)
    prior = PosePrior(moved(POSE, np.full(6, 0.002)), np.diag([0.01] * 3 + [0.005] * 3) ** 2)
    estimate = solved(x_in_world, pixels, Priors(pose=prior), POSE.shifted(np.array([50.0, 0, 0])))
    assert_pose_close(estimate.world_from_camera, POSE, metres=0.02, degrees=0.3)
    assert estimate.stage is PoseStage.REFINED
    assert estimate.prior_checks[0].used


# The final adjustment


DOWN = np.array([0.0, 1.0, 0.0])


def scene_of(case: object) -> tuple[SyntheticScene, Structure, PointMatches]:
    scene = make_scene(random_for("adjust priors", case), SceneOptions(point_count=60, reference_count=3))
    return scene, *true_structure(scene, NOISE)


def gravity_at(pose: RigidTransform, sigma_deg: float, tilt_deg: float = 0.0) -> GravityPrior:
    down = rotation_from_vector([np.radians(tilt_deg), 0, 0]) @ pose.rotation.T @ DOWN
    return GravityPrior(down / np.linalg.norm(down), DOWN, sigma_deg)


def all_priors(pose: RigidTransform, off: float) -> Priors:
    """Priors of all kinds, a little off."""
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
    return adjust_pose(AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions()), solved, priors)


def test_gradient_with_priors_equals_finite_differences() -> None:
    scene, structure, matches = scene_of("gradient")
    used = np.arange(len(matches))
    given = AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions())
    problem, start = pose_problem(given, used, scene.world_from_query)
    problem = replace(problem, priors=all_priors(scene.world_from_query, 0.01), prior_weight=4.0)
    gradient = problem.linearize(start).pose_gradient[-6:]

    def cost(motion: Array) -> float:
        motions = np.zeros((len(start.bundle.poses.rotation), 6))
        motions[-1] = motion
        return problem.cost(problem.at(start.bundle.moved(motions, np.zeros_like(start.bundle.points))))

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
    given = AdjustInput(scene.query, scene.references, structure, matches, AdjustOptions())
    answer, alone = adjust_pose(given, pulled, priors), adjust_pose(given, solved)
    assert [check.used for check in answer.prior_checks] == [False]
    assert answer.world_from_camera.matrix().tobytes() == alone.world_from_camera.matrix().tobytes()
