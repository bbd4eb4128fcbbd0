"""The pose solver: planted poses among wrong matches, its rejections, its covariance, and PoseLib's conventions."""

import numpy as np
import poselib
import pytest
from support.compare import assert_pose_close
from support.pnp_problems import POSE, Problem, planted, problem_of
from support.scenes import CAMERA, random_for

from mapless.geometry import RigidTransform
from mapless_server.method.bundle.estimate import PoseEstimate, PoseStage
from mapless_server.method.pose import pnp
from mapless_server.method.pose.pnp import PnpOptions, ransac, solve_pose
from mapless_server.method.rejection import Rejection, RejectionReason
from mapless_server.method.structure.model import PixelPoints


def solve(problem: Problem, initial: RigidTransform = POSE, options: PnpOptions | None = None) -> PoseEstimate:
    estimate = solve_pose(*problem, initial, options or PnpOptions())
    assert isinstance(estimate, PoseEstimate), estimate
    return estimate


def rejection_of(problem: Problem, initial: RigidTransform = POSE, options: PnpOptions | None = None) -> Rejection:
    outcome = solve_pose(*problem, initial, options or PnpOptions())
    assert isinstance(outcome, Rejection), outcome
    return outcome


# Planted poses


@pytest.mark.parametrize("initial_off_m", [0.0, 0.3, 50.0])
@pytest.mark.parametrize("outlier_share", [0.0, 0.3, 0.6])
def test_the_planted_pose_is_found(outlier_share: float, initial_off_m: float) -> None:
    for seed in range(5):
        problem = planted(random_for("planted", outlier_share, seed), 200, 0.5, outlier_share)
        estimate = solve(problem, POSE.shifted(np.array([initial_off_m, 0.0, 0.0])))
        assert_pose_close(estimate.world_from_camera, POSE, metres=0.01, degrees=0.15)
        assert estimate.stage is PoseStage.REFINED
        right = np.arange(200) >= outlier_share * 200
        assert estimate.inliers[right].all()
        assert estimate.inliers[~right].sum() <= 1
        assert estimate.errors_px.shape == (200,)


def test_many_matches_are_thinned_not_cut() -> None:
    """All right ones are at the end, beyond the first 2000."""
    problem = planted(random_for("many"), 6000, 0.5, outlier_share=0.6)
    assert_pose_close(solve(problem).world_from_camera, POSE, metres=0.005, degrees=0.05)


@pytest.mark.parametrize("outlier_share", [0.1, 0.5, 0.8])
def test_a_sample_gives_the_pose_of_all_matches(outlier_share: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where too few of the sample agree, RANSAC sees all matches: the same bits."""
    _, structure, _ = problem = planted(random_for("sample", outlier_share), 400, 0.5, outlier_share)
    seen = PixelPoints(CAMERA, structure.x_in_world, problem[0].features.pixels())
    fast = ransac(seen, None, PnpOptions())
    monkeypatch.setattr(pnp, "SAMPLE", 10**9)
    plain = ransac(seen, None, PnpOptions())
    assert fast is not None
    assert plain is not None
    assert_pose_close(fast, plain, metres=1e-3, degrees=0.01)
    assert (fast.matrix() == plain.matrix()).all() == (outlier_share == 0.8)


# Refined or initial


def with_solver(monkeypatch: pytest.MonkeyPatch, answer: RigidTransform | None) -> None:
    monkeypatch.setattr(pnp, "ransac", lambda *_: answer)


@pytest.mark.parametrize(
    ("refined_off_m", "initial_off_m", "stage"),
    [
        (0.0, 0.1, PoseStage.REFINED),
        (0.1, 0.0, PoseStage.INITIAL),
        (0.0, 0.0, PoseStage.REFINED),
        (None, 0.0, PoseStage.INITIAL),
    ],
    ids=["refined is better", "initial is better", "tie", "no refined"],
)
def test_the_pose_with_more_inliers_is_kept(
    monkeypatch: pytest.MonkeyPatch, refined_off_m: float | None, initial_off_m: float, stage: PoseStage
) -> None:
    shift = np.array([1.0, 0.0, 0.0])
    with_solver(monkeypatch, None if refined_off_m is None else POSE.shifted(refined_off_m * shift))
    estimate = solve(planted(random_for("stage"), 100), POSE.shifted(initial_off_m * shift))
    assert estimate.stage is stage
    assert_pose_close(estimate.world_from_camera, POSE, metres=0, degrees=1e-6)
    assert estimate.inliers.sum() == 100


# What is refused


@pytest.mark.parametrize("count", [0, 1, 3, 5])
def test_too_few_matches_are_rejected(count: int) -> None:
    rejection = rejection_of(planted(random_for("few", count), count, 0.0))
    assert rejection.reason is RejectionReason.TOO_FEW_MATCHES
    assert f"{count} 2D-3D matches" in rejection.message


def at_one_point(count: int) -> Problem:
    x_in_world = np.zeros((count, 3))
    return problem_of(x_in_world, CAMERA.project(POSE.inverse().apply(x_in_world)))


def test_without_a_pose_the_reason_is_pnp_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    problem = planted(random_for("failed"), 50)
    behind = RigidTransform(POSE.rotation @ np.diag([-1.0, 1.0, -1.0]), POSE.translation)
    with_solver(monkeypatch, None)
    assert rejection_of(problem, behind).reason is RejectionReason.PNP_FAILED
    with_solver(monkeypatch, behind)
    assert rejection_of(problem, behind).reason is RejectionReason.PNP_FAILED


# Covariance


# The adapter


def test_poselib_has_the_options_that_are_passed(monkeypatch: pytest.MonkeyPatch) -> None:
    """It silently accepts misspelt ones."""
    given: list[dict[str, object]] = []

    def spy(*arguments: object) -> tuple[poselib.CameraPose, dict[str, object]]:
        given.extend(a for a in arguments[3:5] if isinstance(a, dict))
        return poselib.CameraPose(), {}

    monkeypatch.setattr(poselib, "estimate_absolute_pose", spy)
    ransac(PixelPoints(CAMERA, np.zeros((6, 3)), np.zeros((6, 2))), None, PnpOptions())
    assert len(given) == 2
    assert given[0].keys() <= poselib.RansacOptions({}).keys()
    assert given[1].keys() <= poselib.BundleOptions({}).keys()


def test_ransac_starts_from_the_initial_pose() -> None:
    """So few iterations find a pose among 90 % wrong matches only when they begin at it."""
    view, structure, _ = planted(random_for("start"), 200, 0.5, outlier_share=0.9)
    options = PnpOptions(min_iterations=1, max_iterations=1)
    begun = ransac(PixelPoints(CAMERA, structure.x_in_world, view.features.pixels()), POSE, options)
    assert begun is not None
    assert_pose_close(begun, POSE, metres=0.05, degrees=0.5)


def test_a_pose_that_is_not_finite_is_none() -> None:
    _, structure, _ = at_one_point(20)
    assert ransac(PixelPoints(CAMERA, structure.x_in_world, np.full((20, 2), 300.0)), None, PnpOptions()) is None


def test_reprojection_errors_are_nan_behind_the_camera() -> None:
    x_in_world = POSE.apply(np.array([[0.0, 0.0, 2.0], [0.1, 0.0, 2.0], [0.0, 0.0, -2.0]]))
    seen = PixelPoints(CAMERA, x_in_world, np.array([[479.5, 359.5], [479.5, 359.5], [0, 0]]))
    errors_px = seen.errors_px(POSE)
    np.testing.assert_allclose(errors_px, [0.0, 0.1 / 2 * 816.0, np.nan], atol=1e-9)
