"""Sequences: planted poses are found from photographs and a device's drifting tracking."""

import itertools
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from support.compare import assert_jacobian, assert_pose_close, pose_error
from support.groups import NOTHING, caller_pose, drifting, error_m, images_of, looking, rescaled, walk
from support.scenes import SceneOptions, look_at, random_for

from mapless.axes import Axes, pose_to
from mapless.geometry import Array, RigidTransform, rotation_angle_deg, rotation_from_vector
from mapless_server.method.bundle.priors import PositionPrior, Priors
from mapless_server.method.groups.checks import check_tracking
from mapless_server.method.groups.drift import SequenceState, step_sigma
from mapless_server.method.groups.jumps import find_jumps
from mapless_server.method.groups.rig import solve_rig
from mapless_server.method.groups.sequence import SequenceEstimate, solve_sequence
from mapless_server.method.judge.answer import Localization
from mapless_server.method.rejection import Rejection, RejectionReason

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
    found = estimate(solve_sequence(images, session, is_free))
    for pose, true_pose in zip(found.world_from_camera, truth, strict=True):
        assert_pose_close(pose, caller_pose(true_pose), metres=0.008, degrees=0.15)
    assert found.world_from_session.scale == pytest.approx(scale, rel=0.05)
    assert (found.scale_sigma > 0) == is_free
    last = found.world_from_session.transform_pose(session[-1])
    np.testing.assert_allclose(last.matrix(), found.world_from_camera[-1].matrix(), atol=1e-6)


@pytest.mark.parametrize(
    ("share", "deg"),
    [
        pytest.param(0.02, 0.2, marks=pytest.mark.nightly),
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
        found = estimate(solve_sequence(images, session, False))
        single = solve_rig([images[-1]], [RigidTransform.identity()])
        assert not isinstance(single, Rejection)
        together.append(error_m(found.world_from_camera[-1], truth[-1]))
        alone.append(error_m(single.world_from_rig, truth[-1]))
    assert np.median(together) <= 1.1 * np.median(alone)


def test_frames_without_matches_are_posed_by_tracking() -> None:
    random = random_for("blind")
    truth = walk(random, 6)
    images = images_of(random, truth, alone=[True] * 4 + [False] * 2)
    images[4] = images[5] = NOTHING
    found = estimate(solve_sequence(images, drifting(random, truth, 0.01), False))
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.02
    sigma_m = np.sqrt(np.trace(found.covariances[:, :3, :3], axis1=1, axis2=2))
    assert sigma_m[5] > sigma_m[4] > sigma_m[3]
    assert [it.source.image for it in found.matched] == [0, 1, 2, 3]


JUMP = RigidTransform(rotation_from_vector([0, 0.2, 0]), np.array([0.5, -0.2, 0.3]))


def jumping(session: list[RigidTransform], at: int, jump: RigidTransform) -> list[RigidTransform]:
    """The session, moved by a jump, about its camera there, from the frame `at` on."""
    here = RigidTransform(np.eye(3), session[at].translation)
    return session[:at] + [here.compose(jump).compose(here.inverse()).compose(it) for it in session[at:]]


@pytest.mark.parametrize("at", [1, 3, 5])
@pytest.mark.parametrize(("scale", "is_free"), [(1.0, False), (0.37, True)])
def test_a_jump_is_found_with_its_size_and_cut(at: int, scale: float, is_free: bool) -> None:
    random = random_for("jump", at, scale)
    truth = walk(random, 6)
    session = rescaled(jumping(drifting(random, truth, 0.01), at, JUMP), 1 / scale)
    images = images_of(random, truth, alone=True, own_noise_m=0.005)
    found = estimate(solve_sequence(images, session, is_free))
    assert max(error_m(*it) for it in zip(found.world_from_camera, truth, strict=True)) < 0.008
    (jump,) = found.jumps
    assert (jump.before, jump.after) == (at - 1, at)
    assert jump.shift_m == pytest.approx(np.linalg.norm(JUMP.translation), abs=0.05)
    assert jump.rotation_deg == pytest.approx(np.degrees(0.2), abs=1.0)


@pytest.mark.parametrize("apart_m", [0.3, 1e6])
def test_of_two_frames_the_last_is_where_its_photograph_says(apart_m: float) -> None:
    """Also the same photograph twice, 1,000 km apart in the session."""
    random = random_for("two", apart_m)
    truth = walk(random, 2) if apart_m < 1e6 else [walk(random, 2)[0]] * 2
    jump = RigidTransform(np.eye(3), np.array([0, apart_m, 0]))
    session = jumping(drifting(random, truth, 0.01), 1, jump)
    images = images_of(random, truth, alone=True, own_noise_m=0.005)
    found = estimate(solve_sequence(images, session, False))
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.008
    assert [(it.before, it.after) for it in found.jumps] == [(0, 1)]
    assert found.jumps[0].shift_m == pytest.approx(apart_m, abs=0.05)
    last = found.world_from_session.transform_pose(session[-1])
    np.testing.assert_allclose(last.translation, found.world_from_camera[-1].translation, atol=1e-6)


def test_a_jump_before_frames_without_matches_is_found() -> None:
    random = random_for("gap")
    truth = walk(random, 6)
    images = images_of(random, truth, alone=True, own_noise_m=0.005)
    images[2] = images[3] = NOTHING
    found = estimate(solve_sequence(images, jumping(drifting(random, truth, 0.01), 3, JUMP), False))
    assert [(it.before, it.after) for it in found.jumps] == [(1, 4)]
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.008


def test_a_jump_is_found_at_a_frame_with_too_few_matches_alone() -> None:
    """The frame is on the side of the jump that its few matches agree with."""
    random = random_for("few")
    truth = walk(random, 6)
    posed = [True, True, False, True, True, True]
    images = images_of(random, truth, keep=[200, 200, 12, 200, 200, 200], alone=posed, own_noise_m=0.005)
    for at in (2, 3):
        session = jumping(drifting(random, truth, 0.01), at, JUMP)
        found = estimate(solve_sequence(images, session, False))
        assert [(it.before, it.after) for it in found.jumps] == [(at - 1, at)]
        assert error_m(found.world_from_camera[2], truth[2]) < 0.02


@pytest.mark.parametrize("turn_deg", [11.5, 170.0])
def test_a_last_frame_that_contradicts_tracking_is_rejected(turn_deg: float) -> None:
    """It has too few matches for a pose, and none is where the tracking says, which may be behind the camera."""
    random = random_for("lost")
    truth = walk(random, 4)
    images = images_of(random, truth, UNGUIDED, keep=[60, 60, 60, 40], alone=[True] * 3 + [False], own_noise_m=0.005)
    wrong = images_of(random_for("lost"), truth, UNGUIDED, keep=40, wrong_share=1.0)[3]
    right = drifting(random, truth, 0.01)
    assert not estimate(solve_sequence(images, right, False)).jumps
    jump = RigidTransform(rotation_from_vector([0, np.radians(turn_deg), 0]), JUMP.translation)
    outcome = rejection(solve_sequence([*images[:3], wrong], jumping(right, 3, jump), False))
    assert outcome.reason is RejectionReason.GATE
    assert "contradicts its tracked pose" in outcome.message


def test_a_last_frame_not_localized_alone_is_cut_by_its_matches() -> None:
    random = random_for("itself")
    truth = walk(random, 4)
    images = images_of(random, truth, alone=[True] * 3 + [False], own_noise_m=0.005)
    session = jumping(drifting(random, truth, 0.01), 3, JUMP)
    found = estimate(solve_sequence(images, session, False))
    assert [(it.before, it.after) for it in found.jumps] == [(2, 3)]
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.01


@pytest.mark.parametrize("unit_m", [0.001, 0.01, 0.3048, 1000.0])
def test_a_session_in_another_unit_is_no_series_of_jumps(unit_m: float) -> None:
    """Steps to and fro, whose stated noise in a unit that is far too small covers what they are together."""
    random = random_for("other unit", unit_m)
    truth = [walk(random, 6)[i] for i in (0, 3, 1, 4, 2, 5)]
    images = images_of(random, truth, alone=True, own_noise_m=0.002)
    session = rescaled(drifting(random, truth, 0.01), 1 / unit_m)
    outcome = solve_sequence(images, session, False)
    if not isinstance(outcome, Rejection):
        outcome = check_tracking(outcome, session)
    assert "contradict the photographs between all 6" in rejection(outcome).message


def turned(rotation: Array, pose: RigidTransform) -> RigidTransform:
    return RigidTransform(pose.rotation @ rotation.T, pose.translation)


SENT: dict[str, tuple[Callable[[RigidTransform], RigidTransform], str]] = {
    "OpenGL": (partial(pose_to, Axes.ARCORE), "the camera axes are OpenGL's"),
    "inverse": (RigidTransform.inverse, "camera_from_session, not session_from_camera"),
    "view matrix": (lambda pose: pose_to(Axes.ARCORE, pose).inverse(), "camera_from_session with OpenGL's"),
    "ROS": (partial(pose_to, Axes.ROS), "a robot's body axes (REP 103"),
    "Unity": (partial(pose_to, Axes.UNITY), "left-handed (y up, as in Unity)"),
    "transposed": (lambda pose: RigidTransform(pose.rotation.T, pose.translation), "the rotations are transposed"),
    "view matrix's translation": (
        lambda pose: RigidTransform(pose.rotation, pose.inverse().translation),
        "the positions are the translations of camera_from_session",
    ),
    "portrait": (partial(turned, np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])), "turned by 90"),
    "y and z exchanged": (
        lambda pose: RigidTransform(pose.rotation, pose.translation[[0, 2, 1]] * [1, 1, -1]),
        "(x, -z, y) of the given",
    ),
}


def climb(count: int) -> list[RigidTransform]:
    """A walk with steps along all axes, and turns."""
    steps = np.arange(count)
    return looking(*np.stack([0.3 * steps - 0.6, 0.25 * steps - 0.5, 0.2 * (steps % 3) - 4.2], axis=1))


@pytest.mark.parametrize("sent", SENT)
@pytest.mark.parametrize("count", [3, 6])
def test_wrong_axes_of_a_session_are_named(sent: str, count: int) -> None:
    """From three photographs on; at most one other that fits as well is named beside them."""
    random = random_for("axes", count)
    truth = climb(count)
    images = images_of(random, truth, alone=True, own_noise_m=0.002)
    as_sent, words = SENT[sent]
    session = [as_sent(it) for it in drifting(random, truth, 0.01)]
    outcome = rejection(check_tracking(estimate(solve_sequence(images, session, False)), session))
    assert words in outcome.message
    assert outcome.message.count("; or ") <= (count == 3)


def test_a_single_step_names_no_axes() -> None:
    """A jump of the device may resemble other axes by chance."""
    random = random_for("one step")
    truth = climb(2)
    session = [pose_to(Axes.ARCORE, it) for it in truth]
    found = estimate(solve_sequence(images_of(random, truth, alone=True, own_noise_m=0.002), session, False))
    assert len(found.jumps) == 1
    assert check_tracking(found, session) is found


def test_axes_that_contradict_one_photograph_are_not_named() -> None:
    random = random_for("one contradicts")
    truth = climb(6)
    session = [pose_to(Axes.ARCORE, it) for it in drifting(random, truth, 0.01)]
    found = estimate(solve_sequence(images_of(random, truth, alone=True, own_noise_m=0.002), session, False))
    assert "OpenGL" in rejection(check_tracking(found, session)).message
    *others, last = found.world_from_camera
    others[2] = others[2].shifted(np.array([0.5, 0.0, 0.0]))
    message = rejection(check_tracking(replace(found, world_from_camera=(*others, last)), session)).message
    assert "likely" not in message


def test_jumps_that_no_other_axes_explain_name_none() -> None:
    random = random_for("no axes")
    truth = walk(random, 3)
    images = images_of(random, truth, alone=True, own_noise_m=0.002)
    session = jumping(jumping(drifting(random, truth, 0.01), 1, JUMP), 2, JUMP)
    found = estimate(solve_sequence(images, session, False))
    assert len(found.jumps) == 2
    assert check_tracking(found, session) is found


def test_a_single_step_that_fits_no_unit_is_rejected() -> None:
    random = random_for("no unit")
    truth = walk(random, 2)
    session = rescaled(jumping(drifting(random, truth, 0.01), 1, JUMP), 2.0)
    images = images_of(random, truth, alone=True, own_noise_m=0.002)
    outcome = rejection(solve_sequence(images, session, True, unit="units"))
    assert outcome.reason is RejectionReason.SCALE_UNRELIABLE
    assert "in any unit" in outcome.message
    assert " units and" in outcome.message


@pytest.mark.parametrize(("returns", "at"), [(False, 1), (False, 2), (True, 2)])
def test_one_step_without_a_jump_shows_the_unit(returns: bool, at: int) -> None:
    """Also where all long ways contain the jump."""
    random = random_for("one step", returns, at)
    truth = walk(random, 3)
    if returns:
        truth += truth[-2::-1] * 4
    far = RigidTransform(JUMP.rotation, 20 * JUMP.translation)
    session = rescaled(jumping(drifting(random, truth, 0.01), at, far), 2.0)
    images = images_of(random, truth, alone=True, own_noise_m=0.002)
    found = estimate(solve_sequence(images, session, True))
    assert [(it.before, it.after) for it in found.jumps] == [(at - 1, at)]
    assert found.jumps[0].shift_m == pytest.approx(20 * np.linalg.norm(JUMP.translation), rel=0.1)
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.008


@pytest.mark.parametrize("count", [2, 8])
def test_radii_are_at_least_those_of_two_photographs(count: int) -> None:
    """Those of one place share references, so that many are not as good as so many independent ones."""
    random = random_for("radii", count)
    truth = walk(random, count)
    images = images_of(random, truth, alone=True, own_noise_m=0.005)
    found = estimate(solve_sequence(images, drifting(random, truth, 0.01), False))
    alone = images[-1].answer.outcome
    assert isinstance(alone, Localization)
    assert alone.covariance is not None
    assert np.linalg.eigvalsh(2 * found.covariances[-1] - alone.covariance).min() > -1e-12


@pytest.mark.parametrize("seed", range(5))
def test_drift_within_the_stated_noise_is_not_cut(seed: int) -> None:
    """Steps with exactly the noise that is stated."""
    random = random_for("stated", seed)
    truth = walk(random, 8)
    session = [truth[0]]
    for first, second in itertools.pairwise(truth):
        step = first.inverse().compose(second)
        turn_deg = rotation_angle_deg(step.rotation)
        sigma = step_sigma(np.array([np.linalg.norm(step.translation)]), np.array([turn_deg]))
        error = random.normal(0, np.repeat(np.concatenate(sigma), 3))
        turned = rotation_from_vector(error[3:]) @ step.rotation
        session.append(session[-1].compose(RigidTransform(turned, step.translation + error[:3])))
    own = {i: (pose, np.diag([1e-5] * 3 + [1e-6] * 3)) for i, pose in enumerate(truth)}
    chain = find_jumps(own, session, 1.0)
    assert chain is not None
    assert (chain.frames, chain.jumps) == (tuple(range(8)), ())


def test_a_prior_on_a_frame_is_used_where_it_agrees() -> None:
    random = random_for("prior")
    truth = walk(random, 3)
    images = images_of(random, truth, UNGUIDED, keep=20, alone=True, own_noise_m=0.005)
    session = drifting(random, truth, 0.01)

    def with_prior(off_m: float) -> SequenceEstimate:
        at = caller_pose(truth[-1]).translation + np.array([off_m, 0, 0])
        prior = Priors(position=PositionPrior(at, 1e-8 * np.eye(3)))
        return estimate(solve_sequence([*images[:2], replace(images[2], priors=prior)], session, False))

    right, wrong, none = with_prior(0.0), with_prior(1.0), estimate(solve_sequence(images, session, False))
    assert error_m(right.world_from_camera[-1], truth[-1]) < 1e-3
    assert np.trace(right.covariances[-1][:3, :3]) < 0.1 * np.trace(none.covariances[-1][:3, :3])
    assert [(it.used, it.conflict) for it in right.prior_checks[2]] == [(True, False)]
    assert [(it.used, it.conflict) for it in wrong.prior_checks[2]] == [(False, True)]
    np.testing.assert_array_equal(wrong.world_from_camera[-1].matrix(), none.world_from_camera[-1].matrix())


def test_one_wrong_own_pose_does_not_change_the_sequence() -> None:
    random = random_for("outvoted")
    truth = walk(random, 5)
    images = images_of(random, truth, alone=True, own_noise_m=0.005)
    wrong = images_of(random_for("outvoted"), truth, alone=True, own_noise_m=3.0)[4]
    found = estimate(solve_sequence([*images[:4], wrong], drifting(random, truth, 0.01), False))
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.02
    assert not found.jumps


def test_a_session_without_motion_has_no_scale() -> None:
    random = random_for("still")
    pose = walk(random, 3)[1]
    images = images_of(random, [pose] * 3, alone=True)
    session = [RigidTransform(np.eye(3), np.array([4.0, 5.0, 6.0]))] * 3
    outcome = rejection(solve_sequence(images, session, True))
    assert outcome.reason is RejectionReason.SCALE_UNRELIABLE
    assert "does not move" in outcome.message
    assert_pose_close(
        estimate(solve_sequence(images, session, False)).world_from_camera[-1],
        caller_pose(pose),
        metres=0.02,
        degrees=0.3,
    )


def test_a_session_with_little_motion_has_no_scale() -> None:
    """A millimetre each, which the tracking's own noise exceeds; it turns, as a person who looks around does."""
    random = random_for("turning")
    truth = [look_at([0.001 * i, 0, -4.0], [0.2 * i - 0.3, 0.1, 0]) for i in range(4)]
    images = images_of(random, truth, alone=True, own_noise_m=0.003)
    outcome = rejection(solve_sequence(images, drifting(random, truth, 0.01), True))
    assert outcome.reason is RejectionReason.SCALE_UNRELIABLE


def test_a_straight_walk_is_posed() -> None:
    """Camera centres on one line, all looking the same way."""
    random = random_for("straight")
    truth = [RigidTransform(np.eye(3), np.array([0.2 * i - 0.5, 0, -4.0])) for i in range(5)]
    session = rescaled(drifting(random, truth, 0.01), 2.0)
    found = estimate(solve_sequence(images_of(random, truth, keep=40), session, True))
    assert found.world_from_session.scale == pytest.approx(0.5, rel=0.05)
    assert error_m(found.world_from_camera[-1], truth[-1]) < 0.008


def test_repeated_frames_add_no_information() -> None:
    random = random_for("same")
    truth = walk(random, 3)
    images = images_of(random, truth, alone=True)
    session = drifting(random, truth, 0.0)
    found = estimate(solve_sequence([images[2]] * 4, [session[2]] * 4, False))
    single = solve_rig([images[2]], [RigidTransform.identity()])
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
        reason = rejection(solve_sequence(images, session, is_free)).reason
        assert reason in {RejectionReason.GATE, RejectionReason.PNP_FAILED, RejectionReason.SCALE_UNRELIABLE}
    nothing = rejection(solve_sequence([NOTHING] * 4, session, False))
    assert nothing.reason is RejectionReason.LOW_TEXTURE


# Drift


def moved_state(scale_is_free: bool, moved: float) -> SequenceState:
    random = random_for("freedom", scale_is_free)
    truth = walk(random, 3)
    state = SequenceState.of(truth, rescaled(truth, 2.0), 0.5, scale_is_free)
    return state.moved(random.normal(0, moved, state.size))


@pytest.mark.parametrize("scale_is_free", [False, True])
def test_the_gradient_is_half_that_of_the_cost(scale_is_free: bool) -> None:
    state = moved_state(scale_is_free, 1e-3)
    _, gradient = state.equations()

    def cost(step: Array) -> float:
        return state.moved(step).cost()

    assert_jacobian(2 * gradient, cost, np.zeros(state.size), tolerance=5e-3)
