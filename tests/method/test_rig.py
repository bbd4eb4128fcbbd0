"""Rigs: a planted pose is found from the matches of several cameras, also where none of them has enough."""

from dataclasses import replace

import numpy as np
import pytest
from support.compare import assert_jacobian, assert_pose_close
from support.groups import NOTHING, caller_pose, images_of, looking
from support.scenes import SceneOptions, random_for

from mapless.geometry import Array, RigidTransform, rotation_from_vector
from mapless_server.method.groups.rig import RigEstimate, RigOptions, RigState, solve_rig
from mapless_server.method.perturbation import rotation_vector
from mapless_server.method.priors.known import PositionPrior, Priors
from mapless_server.method.rejection import Rejection, RejectionReason

WORLD_FROM_RIG = RigidTransform(rotation_from_vector([0.1, 0.2, -0.1]), np.array([0.3, 0.1, -3.8]))
CAMERAS = looking((-0.5, 0, -4), (0.2, -0.1, -4.2), (0.6, 0.2, -3.9))
RIG_FROM_CAMERA = [WORLD_FROM_RIG.inverse().compose(pose) for pose in CAMERAS]
OPTIONS = RigOptions()
UNGUIDED = SceneOptions(point_count=60, noise_px=0.5, descriptor_noise=3.0)
"""Descriptors that say nothing: no match is found near where it should be."""


def estimate(outcome: RigEstimate | Rejection) -> RigEstimate:
    assert isinstance(outcome, RigEstimate), outcome
    return outcome


def rejection(outcome: RigEstimate | Rejection) -> Rejection:
    assert isinstance(outcome, Rejection)
    return outcome


@pytest.mark.parametrize("wrong_share", [0.0, 0.5])
def test_the_planted_rig_pose_is_found_in_the_callers_world(wrong_share: float) -> None:
    images = images_of(random_for("rig", wrong_share), CAMERAS, wrong_share=wrong_share)
    found = estimate(solve_rig(images, RIG_FROM_CAMERA, OPTIONS))
    assert_pose_close(found.world_from_rig, caller_pose(WORLD_FROM_RIG), metres=0.006, degrees=0.1)
    assert [it.source.image for it in found.matched] == [0, 1, 2]
    assert min(int(it.inliers.sum()) for it in found.matched) > 100


def test_cameras_with_too_few_matches_alone_are_posed_together() -> None:
    """Five matches a camera, and nothing else is found near where it should be."""
    images = images_of(random_for("weak"), CAMERAS, UNGUIDED, keep=5)
    found = estimate(solve_rig(images, RIG_FROM_CAMERA, OPTIONS))
    assert_pose_close(found.world_from_rig, caller_pose(WORLD_FROM_RIG), metres=0.03, degrees=0.5)
    for image, camera in zip(images, RIG_FROM_CAMERA, strict=True):
        assert rejection(solve_rig([image], [camera], OPTIONS)).reason is not RejectionReason.LOW_TEXTURE


def test_the_guided_search_adds_matches() -> None:
    images = images_of(random_for("guided"), CAMERAS, keep=8)
    found = estimate(solve_rig(images, RIG_FROM_CAMERA, OPTIONS))
    assert min(int(it.inliers.sum()) for it in found.matched) > 50
    assert all(it.matches.guided.sum() > 50 for it in found.matched)


def test_one_wrong_own_pose_does_not_change_the_rigs() -> None:
    images = images_of(random_for("outvoted"), CAMERAS, alone=[True, False, False], own_noise_m=1.0)
    found = estimate(solve_rig(images, RIG_FROM_CAMERA, OPTIONS))
    assert_pose_close(found.world_from_rig, caller_pose(WORLD_FROM_RIG), metres=0.006, degrees=0.1)


def test_a_rig_is_rejected_by_its_trust() -> None:
    images = images_of(random_for("trust"), CAMERAS, keep=30)
    found = estimate(solve_rig(images, RIG_FROM_CAMERA, OPTIONS))
    assert 0.01 < found.trust < 1
    outcome = rejection(solve_rig(images, RIG_FROM_CAMERA, RigOptions(coverage=(1 - found.trust) * 0.9)))
    assert outcome.reason is RejectionReason.GATE
    assert "its trust of" in outcome.message


def test_a_prior_on_one_camera_is_used_for_the_rig() -> None:
    images = images_of(random_for("prior"), CAMERAS, UNGUIDED, keep=8)
    at = caller_pose(CAMERAS[1]).translation
    prior = Priors(position=PositionPrior(at, 1e-8 * np.eye(3)))
    found = estimate(solve_rig([images[0], replace(images[1], priors=prior), images[2]], RIG_FROM_CAMERA, OPTIONS))
    assert [(it.used, it.conflict) for it in found.prior_checks[1]] == [(True, False)]
    assert np.linalg.norm(found.world_from_rig.compose(RIG_FROM_CAMERA[1]).translation - at) < 1e-3


def test_a_blank_image_has_no_effect() -> None:
    images = images_of(random_for("blank"), CAMERAS)
    whole = estimate(solve_rig([images[0], NOTHING, images[2]], RIG_FROM_CAMERA, OPTIONS))
    without = estimate(solve_rig([images[0], images[2]], [RIG_FROM_CAMERA[0], RIG_FROM_CAMERA[2]], OPTIONS))
    np.testing.assert_allclose(whole.world_from_rig.matrix(), without.world_from_rig.matrix(), atol=1e-9)
    assert [it.source.image for it in whole.matched] == [0, 2]


def test_a_rig_of_one_camera_is_posed() -> None:
    images = images_of(random_for("one"), CAMERAS[:1])
    found = estimate(solve_rig(images, RIG_FROM_CAMERA[:1], OPTIONS))
    assert_pose_close(found.world_from_rig, caller_pose(WORLD_FROM_RIG), metres=0.02, degrees=0.3)


def test_a_rig_of_cameras_at_one_place_is_posed() -> None:
    """A pinhole camera in two raster orientations, say: the rays meet, and gp3p has a special case."""
    poses = [
        CAMERAS[0],
        RigidTransform(CAMERAS[0].rotation @ rotation_from_vector([0, 0.2, 0]), CAMERAS[0].translation),
    ]
    fixed = [poses[0].inverse().compose(pose) for pose in poses]
    found = estimate(solve_rig(images_of(random_for("bundle"), poses), fixed, OPTIONS))
    assert_pose_close(found.world_from_rig, caller_pose(poses[0]), metres=0.006, degrees=0.1)


def test_the_same_image_twice_is_no_second_measurement() -> None:
    images = images_of(random_for("twice"), CAMERAS[:1])
    once = estimate(solve_rig(images, RIG_FROM_CAMERA[:1], OPTIONS))
    twice = estimate(solve_rig(images * 2, RIG_FROM_CAMERA[:1] * 2, OPTIONS))
    sigma_once, sigma_twice = (np.sqrt(np.diag(it.covariance)) for it in (once, twice))
    np.testing.assert_allclose(sigma_twice, sigma_once, rtol=0.1)


def test_with_wrong_mounting_other_cameras_lose_their_inliers() -> None:
    """All cameras have the mounting of the first."""
    images = images_of(random_for("wrong"), CAMERAS)
    outcome = solve_rig(images, [RIG_FROM_CAMERA[0]] * 3, OPTIONS)
    found = estimate(outcome)
    shares = sorted(it.inliers.sum() / len(it.matches) for it in found.matched)
    assert shares[-1] > 0.9
    assert shares[0] < 0.3


def test_wrong_matches_alone_are_rejected() -> None:
    images = images_of(random_for("chance"), CAMERAS, UNGUIDED, keep=60, wrong_share=1.0)
    outcome = rejection(solve_rig(images, RIG_FROM_CAMERA, OPTIONS))
    assert outcome.reason in {RejectionReason.GATE, RejectionReason.PNP_FAILED}
    assert "images" in outcome.message or "rig" in outcome.message


def test_without_matches_the_reason_is_the_furthest_images() -> None:
    outcome = rejection(solve_rig([NOTHING, NOTHING], RIG_FROM_CAMERA[:2], OPTIONS))
    assert outcome.reason is RejectionReason.LOW_TEXTURE
    assert "image 0: blank" in outcome.message


def test_too_few_matches_are_rejected() -> None:
    outcome = rejection(solve_rig(images_of(random_for("few"), CAMERAS, keep=1), RIG_FROM_CAMERA, OPTIONS))
    assert outcome.reason is RejectionReason.TOO_FEW_MATCHES
    assert "3 2D-3D matches in 3 images" in outcome.message


@pytest.mark.nightly
def test_errors_are_as_large_as_the_covariance() -> None:
    """Whitened by it, errors of many rigs have a spread of about one over `error_inflation`, 2."""
    whitened = []
    for case in range(40):
        images = images_of(random_for("covariance", case), CAMERAS, UNGUIDED, keep=60)
        found = estimate(solve_rig(images, RIG_FROM_CAMERA, OPTIONS))
        truth = caller_pose(WORLD_FROM_RIG)
        turn = rotation_vector(found.world_from_rig.rotation @ truth.rotation.T)
        error = np.concatenate([found.world_from_rig.translation - truth.translation, turn])
        whitened.append(error @ np.linalg.solve(found.covariance, error) / 6)
    assert 0.1 < np.mean(whitened) < 1.0


def test_the_jacobian_is_that_of_the_cameras_motion() -> None:
    state = RigState(WORLD_FROM_RIG.inverse(), tuple(RIG_FROM_CAMERA))
    before = state.camera_from_world(1)

    def motion(step: Array) -> Array:
        after = state.moved(step).camera_from_world(1)
        turn = after.rotation @ before.rotation.T
        return np.concatenate([after.translation - turn @ before.translation, rotation_vector(turn)])

    assert_jacobian(state.jacobian(1), motion, np.zeros(6))
