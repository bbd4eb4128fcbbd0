"""Sequences: planted poses are found from photographs and a device's drifting tracking."""

from __future__ import annotations

import numpy as np
import pytest
from support.compare import assert_pose_close, pose_error
from support.groups import NOTHING, caller_pose, drifting, error_m, images_of, rescaled, walk
from support.jacobians import assert_jacobian
from support.scenes import SceneOptions, look_at, random_for

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.groups.drift import DriftOptions, SequenceState, world_from_session_at
from mapless_server.method.groups.rig import RigOptions, solve_rig
from mapless_server.method.groups.sequence import SequenceEstimate, SequenceOptions, solve_sequence
from mapless_server.method.rejection import Rejection, RejectionReason

OPTIONS = SequenceOptions()
UNGUIDED = SceneOptions(point_count=80, noise_px=0.5, descriptor_noise=3.0)


def estimate(outcome: SequenceEstimate | Rejection) -> SequenceEstimate:
    assert isinstance(outcome, SequenceEstimate), outcome
    return outcome


def rejection(outcome: SequenceEstimate | Rejection) -> Rejection:
    assert isinstance(outcome, Rejection)
    return outcome


@pytest.mark.parametrize("alone", [True, False], ids=["posed alone", "not posed alone"])
@pytest.mark.parametrize(("scale", "is_free"), [(1.0, False), (0.37, True)])
def test_every_planted_frame_is_found_in_the_callers_world(alone: bool, scale: float, is_free: bool) -> None:
    """Half of the matches are wrong, the tracking drifts by 2 %, and the unit may be unknown."""
    random = random_for("frames", alone, scale)
    truth = walk(random, 6)
    session = rescaled(drifting(random, truth, 0.02), 1 / scale)
    images = images_of(random, truth, keep=60, wrong_share=0.5, alone=alone, own_noise_m=0.01)
    found = estimate(solve_sequence(images, session, is_free, OPTIONS))
    for pose, true_pose in zip(found.world_from_camera, truth, strict=True):
        assert_pose_close(pose, caller_pose(true_pose), metres=0.008, degrees=0.15)
    assert found.world_from_session.scale == pytest.approx(scale, rel=0.05)
    assert (found.scale_sigma > 0) == is_free
    last = found.world_from_session.transform_pose(session[-1])
    np.testing.assert_allclose(last.matrix(), found.world_from_camera[-1].matrix(), atol=1e-6)


@pytest.mark.parametrize(
    ("share", "deg"),
    [
        (0.02, 0.2),
        pytest.param(0.02, 0.0, marks=pytest.mark.nightly),
        pytest.param(0.10, 0.5, marks=pytest.mark.nightly),
        (0.30, 1.0),
    ],
)
def test_drift_makes_the_last_pose_no_worse_than_alone(share: float, deg: float) -> None:
    """Over several sequences, for small and large drift."""
    together, alone = [], []
    for case in range(5):
        random = random_for("drift", share, deg, case)
        truth = walk(random, 5)
        session = drifting(random, truth, share, deg)
        images = images_of(random, truth, UNGUIDED, keep=40, alone=True, own_noise_m=0.005)
        found = estimate(solve_sequence(images, session, False, OPTIONS))
        single = solve_rig([images[-1]], [RigidTransform.identity()], RigOptions())
        assert not isinstance(single, Rejection)
        together.append(error_m(found.world_from_camera[-1], truth[-1]))
        alone.append(error_m(single.world_from_rig, truth[-1]))
    assert np.median(together) <= 1.1 * np.median(alone)


def test_frames_without_matches_are_posed_by_tracking() -> None:
    random = random_for("blind")
    truth = walk(random, 6)
    images = images_of(random, truth, alone=[True] * 4 + [False] * 2)
    images[4] = images[5] = NOTHING
    found = estimate(solve_sequence(images, drifting(random, truth, 0.01), False, OPTIONS))
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.02
    sigma_m = np.sqrt(np.trace(found.covariances[:, :3, :3], axis1=1, axis2=2))
    assert sigma_m[5] > sigma_m[4] > sigma_m[3]
    assert [it.source.image for it in found.matched] == [0, 1, 2, 3]


def test_a_jump_of_the_tracking_gets_little_weight() -> None:
    random = random_for("jump")
    truth = walk(random, 6)
    session = drifting(random, truth, 0.01)
    jump = RigidTransform(rotation_from_vector([0, 0.2, 0]), np.array([0.5, -0.2, 0.3]))
    session = session[:3] + [jump.compose(pose) for pose in session[3:]]
    images = images_of(random, truth, alone=True, own_noise_m=0.005)
    found = estimate(solve_sequence(images, session, False, OPTIONS))
    assert max(error_m(*it) for it in zip(found.world_from_camera, truth, strict=True)) < 0.008
    weights = SequenceState.of(found.world_from_camera, session, 1.0, False, OPTIONS.drift).weights()
    assert weights.argmin() == 2
    assert weights[2] < 0.1 < np.delete(weights, 2).min()


def test_one_wrong_own_pose_does_not_change_the_sequence() -> None:
    random = random_for("outvoted")
    truth = walk(random, 5)
    images = images_of(random, truth, alone=True, own_noise_m=0.005)
    wrong = images_of(random_for("outvoted"), truth, alone=True, own_noise_m=3.0)[4]
    found = estimate(solve_sequence([*images[:4], wrong], drifting(random, truth, 0.01), False, OPTIONS))
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.02


def test_a_session_without_motion_has_no_scale() -> None:
    random = random_for("still")
    pose = walk(random, 3)[1]
    images = images_of(random, [pose] * 3, alone=True)
    session = [RigidTransform(np.eye(3), np.array([4.0, 5.0, 6.0]))] * 3
    outcome = rejection(solve_sequence(images, session, True, OPTIONS))
    assert outcome.reason is RejectionReason.SCALE_UNRELIABLE
    assert "does not move" in outcome.message
    assert_pose_close(
        estimate(solve_sequence(images, session, False, OPTIONS)).world_from_camera[-1],
        caller_pose(pose),
        metres=0.02,
        degrees=0.3,
    )


def test_a_session_with_little_motion_has_no_scale() -> None:
    """A millimetre each, which the tracking's own noise exceeds; it turns, as a person who looks around does."""
    random = random_for("turning")
    truth = [look_at([0.001 * i, 0, -4.0], [0.2 * i - 0.3, 0.1, 0]) for i in range(4)]
    images = images_of(random, truth, alone=True, own_noise_m=0.003)
    outcome = rejection(solve_sequence(images, drifting(random, truth, 0.01), True, OPTIONS))
    assert outcome.reason is RejectionReason.SCALE_UNRELIABLE


def test_a_straight_walk_is_posed() -> None:
    """Camera centres on one line, all looking the same way."""
    random = random_for("straight")
    truth = [RigidTransform(np.eye(3), np.array([0.2 * i - 0.5, 0, -4.0])) for i in range(5)]
    session = rescaled(drifting(random, truth, 0.01), 2.0)
    found = estimate(solve_sequence(images_of(random, truth, keep=40), session, True, OPTIONS))
    assert found.world_from_session.scale == pytest.approx(0.5, rel=0.05)
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.008


def test_repeated_frames_add_no_information() -> None:
    random = random_for("same")
    truth = walk(random, 3)
    images = images_of(random, truth, alone=True)
    session = drifting(random, truth, 0.0)
    found = estimate(solve_sequence([images[2]] * 4, [session[2]] * 4, False, OPTIONS))
    single = solve_rig([images[2]], [RigidTransform.identity()], RigOptions())
    assert not isinstance(single, Rejection)
    assert pose_error(found.world_from_camera[-1], single.world_from_rig)[0] < 0.002
    sigma_m = np.sqrt(np.diag(found.covariances[-1]))
    assert (sigma_m > 0.8 * np.sqrt(np.diag(single.covariance))).all()


def test_wrong_matches_alone_are_rejected() -> None:
    random = random_for("chance")
    truth = walk(random, 4)
    images = images_of(random, truth, UNGUIDED, keep=50, wrong_share=1.0)
    session = drifting(random, truth, 0.01)
    for is_free in (False, True):
        reason = rejection(solve_sequence(images, session, is_free, OPTIONS)).reason
        assert reason in {RejectionReason.GATE, RejectionReason.PNP_FAILED, RejectionReason.SCALE_UNRELIABLE}
    nothing = rejection(solve_sequence([NOTHING] * 4, session, False, OPTIONS))
    assert nothing.reason is RejectionReason.LOW_TEXTURE


def test_the_same_frames_give_the_same_answer() -> None:
    random = random_for("again")
    truth = walk(random, 4)
    images, session = images_of(random, truth, keep=40, wrong_share=0.3), drifting(random, truth, 0.02)
    first, second = (estimate(solve_sequence(images, session, True, OPTIONS)) for _ in range(2))
    pose, again = (it.world_from_camera[-1].matrix() for it in (first, second))
    np.testing.assert_allclose(pose, again, atol=1e-6, err_msg="the solvers round as arrays lie in memory")
    assert first.world_from_session.scale == pytest.approx(second.world_from_session.scale, rel=1e-6)


# Drift


def moved_state(scale_is_free: bool, moved: float) -> SequenceState:
    random = random_for("freedom", scale_is_free)
    truth = walk(random, 3)
    state = SequenceState.of(truth, rescaled(truth, 2.0), 0.5, scale_is_free, DriftOptions())
    return state.moved(random.normal(0, moved, state.size))


@pytest.mark.parametrize("scale_is_free", [False, True])
def test_jacobian_of_residuals_equals_finite_differences(scale_is_free: bool) -> None:
    state = moved_state(scale_is_free, 1e-4)
    for i in range(2):

        def error(step: Array, i: int = i) -> Array:
            return state.moved(step)._error(i)

        assert_jacobian(state._jacobian_of_error(i), error, np.zeros(state.size), tolerance=1e-3)


@pytest.mark.parametrize("scale_is_free", [False, True])
def test_the_gradient_is_half_that_of_the_cost(scale_is_free: bool) -> None:
    state = moved_state(scale_is_free, 1e-3)
    _, gradient = state.equations()

    def cost(step: Array) -> float:
        return state.moved(step).cost()

    assert_jacobian(2 * gradient, cost, np.zeros(state.size), tolerance=5e-3)


def test_a_session_without_drift_has_cost_zero() -> None:
    random = random_for("right")
    truth = walk(random, 4)
    session = rescaled(drifting(random, truth, 0.0), 4.0)
    state = SequenceState.of(truth, session, 0.25, True, DriftOptions())
    assert state.cost() == pytest.approx(0, abs=1e-12)
    np.testing.assert_allclose(state.weights(), 1)


def test_drift_grows_with_distance_and_angle() -> None:
    options = DriftOptions(share=0.01, floor_m=0.002, deg_per_m=0.3, turn_share=0.01, floor_deg=0.05)
    step = RigidTransform(rotation_from_vector([0, np.radians(20), 0]), np.array([0, 3.0, 4.0]))
    sigma = options.sigma(step)
    np.testing.assert_allclose(sigma[:3], 0.002 + 0.05)
    np.testing.assert_allclose(np.degrees(sigma[3:]), 0.05 + 1.5 + 0.2)


def test_a_sessions_pose_maps_its_frame_to_the_frames_pose() -> None:
    random = random_for("session")
    pose, frame = walk(random, 2)
    there = world_from_session_at(pose, frame, 0.37)
    np.testing.assert_allclose(there.transform_pose(frame).matrix(), pose.matrix(), atol=1e-12)
    assert there.scale == 0.37


@pytest.mark.parametrize("change", [{"share": 0.0}, {"floor_m": -1.0}, {"loss_scale": 0.0}, {"deg_per_m": -0.1}])
def test_drift_options_outside_their_bounds_are_refused(change: dict[str, float]) -> None:
    with pytest.raises(ValueError, match="must be"):
        DriftOptions(**change)
