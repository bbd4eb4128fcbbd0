"""Rigs: a planted pose is found from the matches of several cameras, also where none of them has enough."""

import ctypes
from dataclasses import replace
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from support.compare import assert_jacobian, assert_pose_close
from support.groups import NOTHING, caller_pose, images_of, looking
from support.scenes import CAMERA, SceneOptions, make_scene, random_for

from mapless.answers import Accuracy
from mapless.geometry import Array, Camera, RigidTransform, Similarity, rotation_from_vector
from mapless.provenance import ADOPTED, Provenance, Voucher
from mapless_server.method.bundle.estimate import PoseStage
from mapless_server.method.bundle.intrinsics import read_as
from mapless_server.method.bundle.priors import IntrinsicsSigma, PositionPrior, Priors
from mapless_server.method.bundle.readout import RollingShutter
from mapless_server.method.bundle.shutter import MotionPrior, row_times
from mapless_server.method.groups.checks import check_mounting, check_tracking, check_unit, hinted_group
from mapless_server.method.groups.images import GroupImage, rejection_without_matches
from mapless_server.method.groups.jumps import Jump
from mapless_server.method.groups.rig import RigEstimate, RigState, solve_rig
from mapless_server.method.groups.sequence import SequenceEstimate
from mapless_server.method.groups.start import CHECK_TRACKING
from mapless_server.method.judge.answer import Answer, Localization
from mapless_server.method.optim.optimize import perturbed
from mapless_server.method.optim.rotations import rotation_vector
from mapless_server.method.pose.generalized import CameraMatches, inlier_count, rig_ransac, scaled_ransac
from mapless_server.method.pose.pnp import PnpOptions
from mapless_server.method.rejection import Advice, Hint, Rejection, RejectionReason
from mapless_server.method.structure.model import MetricScale, PixelPoints, ScaleStage
from mapless_server.method.unknown_camera import scaled

WORLD_FROM_RIG = RigidTransform(rotation_from_vector([0.1, 0.2, -0.1]), np.array([0.3, 0.1, -3.8]))
CAMERAS = looking((-0.5, 0, -4), (0.2, -0.1, -4.2), (0.6, 0.2, -3.9))
RIG_FROM_CAMERA = [WORLD_FROM_RIG.inverse().compose(pose) for pose in CAMERAS]
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
    found = estimate(solve_rig(images, RIG_FROM_CAMERA))
    assert_pose_close(found.world_from_rig, caller_pose(WORLD_FROM_RIG), metres=0.006, degrees=0.1)
    assert [it.source.image for it in found.matched] == [0, 1, 2]
    assert min(int(it.inliers.sum()) for it in found.matched) > 100


def test_cameras_with_too_few_matches_alone_are_posed_together() -> None:
    """Five matches a camera, and nothing else is found near where it should be."""
    images = images_of(random_for("weak"), CAMERAS, UNGUIDED, keep=5)
    found = estimate(solve_rig(images, RIG_FROM_CAMERA))
    assert_pose_close(found.world_from_rig, caller_pose(WORLD_FROM_RIG), metres=0.03, degrees=0.5)
    for image, camera in zip(images, RIG_FROM_CAMERA, strict=True):
        assert rejection(solve_rig([image], [camera])).reason is not RejectionReason.LOW_TEXTURE


def test_one_wrong_own_pose_does_not_change_the_rigs() -> None:
    images = images_of(random_for("outvoted"), CAMERAS, alone=[True, False, False], own_noise_m=1.0)
    found = estimate(solve_rig(images, RIG_FROM_CAMERA))
    assert_pose_close(found.world_from_rig, caller_pose(WORLD_FROM_RIG), metres=0.006, degrees=0.1)


def test_a_rig_is_rejected_by_its_trust() -> None:
    images = images_of(random_for("trust"), CAMERAS, keep=30)
    found = estimate(solve_rig(images, RIG_FROM_CAMERA))
    assert 0.01 < found.trust < 1
    outcome = rejection(solve_rig(images, RIG_FROM_CAMERA, (1 - found.trust) * 0.9))
    assert outcome.reason is RejectionReason.GATE
    assert "its trust of" in outcome.message


def test_a_prior_on_one_camera_is_used_for_the_rig() -> None:
    images = images_of(random_for("prior"), CAMERAS, UNGUIDED, keep=8)
    at = caller_pose(CAMERAS[1]).translation
    prior = Priors(position=PositionPrior(at, 1e-8 * np.eye(3)))
    found = estimate(solve_rig([images[0], replace(images[1], priors=prior), images[2]], RIG_FROM_CAMERA))
    assert [(it.used, it.conflict) for it in found.prior_checks[1]] == [(True, False)]
    assert np.linalg.norm(found.world_from_rig.compose(RIG_FROM_CAMERA[1]).translation - at) < 1e-3


def test_the_covariance_contains_what_a_common_focal_length_does() -> None:
    """The focal length of all cameras is off by one standard deviation, which is theirs together or of each."""
    images, sigma = images_of(random_for("focal"), CAMERAS), IntrinsicsSigma(0.01, 1e-6, 1e-6)
    off = [_read_as(it, scaled(CAMERA, 0.01)) for it in images]
    right, moved, known = (
        estimate(solve_rig(it, RIG_FROM_CAMERA))
        for it in (images, off, [replace(it, intrinsics=sigma) for it in images])
    )
    shift = moved.world_from_rig.translation - right.world_from_rig.translation
    added = known.covariance - right.covariance
    assert np.linalg.norm(shift) > 3 * np.sqrt(np.trace(right.covariance[:3, :3]))
    np.testing.assert_allclose(added[:3, :3], np.outer(shift, shift), atol=0.3 * float(shift @ shift))
    each = [replace(it, intrinsics=replace(sigma, k1=k1)) for it, k1 in zip(images, (1e-6, 2e-6, 3e-6), strict=True)]
    apart = estimate(solve_rig(each, RIG_FROM_CAMERA)).covariance - right.covariance
    assert 0 < np.trace(apart[:3, :3]) < np.trace(added[:3, :3])


def test_the_covariance_contains_what_adopted_references_share() -> None:
    stated = 0.03**2 * np.eye(6)
    known = Provenance(ADOPTED, Accuracy(0.06, 0.2, 3, 9), 1.0, (Voucher("surveyed", 30),), stated.tolist())
    images = images_of(random_for("adopted"), CAMERAS)
    surveyed, adopted = (
        estimate(solve_rig(it, RIG_FROM_CAMERA)).covariance
        for it in (images, [_with_provenance(it, known) for it in images])
    )
    assert np.trace(surveyed[:3, :3]) < 0.1 * 3 * 0.03**2
    assert 0.9 < np.trace(adopted[:3, :3]) / (3 * 0.03**2) < 2


def _with_provenance(image: GroupImage, provenance: Provenance) -> GroupImage:
    support = image.answer.support
    assert support is not None
    references = tuple(replace(it, provenance=provenance) for it in support.references)
    return replace(image, answer=replace(image.answer, support=replace(support, references=references)))


def _read_as(image: GroupImage, camera: Camera) -> GroupImage:
    support = image.answer.support
    assert support is not None
    support = replace(support, query=read_as(support.query, camera))
    return replace(image, answer=replace(image.answer, support=support))


def test_a_blank_image_has_no_effect() -> None:
    images = images_of(random_for("blank"), CAMERAS)
    whole = estimate(solve_rig([images[0], NOTHING, images[2]], RIG_FROM_CAMERA))
    without = estimate(solve_rig([images[0], images[2]], [RIG_FROM_CAMERA[0], RIG_FROM_CAMERA[2]]))
    np.testing.assert_allclose(whole.world_from_rig.matrix(), without.world_from_rig.matrix(), atol=1e-9)
    assert [it.source.image for it in whole.matched] == [0, 2]


def test_a_rig_of_one_camera_is_posed() -> None:
    images = images_of(random_for("one"), CAMERAS[:1])
    found = estimate(solve_rig(images, RIG_FROM_CAMERA[:1]))
    assert_pose_close(found.world_from_rig, caller_pose(WORLD_FROM_RIG), metres=0.02, degrees=0.3)


def test_a_rig_of_cameras_at_one_place_is_posed() -> None:
    """A pinhole camera in two raster orientations, say: the rays meet, and gp3p has a special case."""
    poses = [
        CAMERAS[0],
        RigidTransform(CAMERAS[0].rotation @ rotation_from_vector([0, 0.2, 0]), CAMERAS[0].translation),
    ]
    fixed = [poses[0].inverse().compose(pose) for pose in poses]
    found = estimate(solve_rig(images_of(random_for("bundle"), poses), fixed))
    assert_pose_close(found.world_from_rig, caller_pose(poses[0]), metres=0.006, degrees=0.1)


def test_the_same_image_twice_is_no_second_measurement() -> None:
    images = images_of(random_for("twice"), CAMERAS[:1])
    once = estimate(solve_rig(images, RIG_FROM_CAMERA[:1]))
    twice = estimate(solve_rig(images * 2, RIG_FROM_CAMERA[:1] * 2))
    sigma_once, sigma_twice = (np.sqrt(np.diag(it.covariance)) for it in (once, twice))
    np.testing.assert_allclose(sigma_twice, sigma_once, rtol=0.1)


def test_wrong_matches_alone_are_rejected() -> None:
    images = images_of(random_for("chance"), CAMERAS, UNGUIDED, keep=60, wrong_share=1.0)
    outcome = rejection(solve_rig(images, RIG_FROM_CAMERA))
    assert outcome.reason in {RejectionReason.GATE, RejectionReason.PNP_FAILED}
    assert "images" in outcome.message or "rig" in outcome.message


def test_without_matches_the_reason_is_the_furthest_images() -> None:
    outcome = rejection(solve_rig([NOTHING, NOTHING], RIG_FROM_CAMERA[:2]))
    assert outcome.reason is RejectionReason.LOW_TEXTURE
    assert "image 0: blank" in outcome.message


def test_too_few_matches_are_rejected() -> None:
    outcome = rejection(solve_rig(images_of(random_for("few"), CAMERAS, keep=1), RIG_FROM_CAMERA))
    assert outcome.reason is RejectionReason.TOO_FEW_MATCHES
    assert "3 2D-3D matches in 3 images" in outcome.message


@pytest.mark.nightly
def test_errors_are_as_large_as_the_covariance() -> None:
    """Whitened by it, errors of many rigs have a spread of about one over `error_inflation`, 2."""
    whitened = []
    for case in range(40):
        images = images_of(random_for("covariance", case), CAMERAS, UNGUIDED, keep=60)
        found = estimate(solve_rig(images, RIG_FROM_CAMERA))
        truth = caller_pose(WORLD_FROM_RIG)
        turn = rotation_vector(found.world_from_rig.rotation @ truth.rotation.T)
        error = np.concatenate([found.world_from_rig.translation - truth.translation, turn])
        whitened.append(error @ np.linalg.solve(found.covariance, error) / 6)
    assert 0.1 < np.mean(whitened) < 1.0


def test_a_motion_that_no_photograph_shows_is_in_the_radii() -> None:
    """As much as the pose follows each axis of the motion, which moves keypoints by when their rows were read."""
    shutter, truth = RollingShutter(0.033), [WORLD_FROM_RIG.compose(it) for it in RIG_FROM_CAMERA]
    images = images_of(random_for("rig motion"), truth, keep=1000)
    found = [solve_rig([replace(it, shutter=s) for it in images], RIG_FROM_CAMERA) for s in (None, shutter)]
    still, widened = (it for it in found if isinstance(it, RigEstimate))
    state, moved = RigState(WORLD_FROM_RIG.inverse(), tuple(RIG_FROM_CAMERA)), list[Array]()
    distance_m = max(float(np.median(_depths(it, pose))) for it, pose in zip(images, truth, strict=True))
    for axis in 0.1 * np.sqrt(MotionPrior.of(shutter, distance_m).spread):
        motions = [state.jacobian(i) @ axis for i in range(len(images))]
        seen = [_moved(*it, shutter) for it in zip(images, truth, motions, strict=True)]
        after = solve_rig(seen, RIG_FROM_CAMERA)
        assert isinstance(after, RigEstimate)
        turn = rotation_vector(after.world_from_rig.rotation @ still.world_from_rig.rotation.T)
        moved.append(10 * np.append(after.world_from_rig.translation - still.world_from_rig.translation, turn))
    expected, added = np.array(moved).T @ moved, widened.covariance - still.covariance
    np.testing.assert_allclose(np.diag(added), np.diag(expected), rtol=0.4)


def _points(image: GroupImage) -> tuple[Any, Array]:
    support = image.answer.support
    assert support is not None
    return support, support.structure.x_in_world[support.matches.point]


def _depths(image: GroupImage, world_from_camera: RigidTransform) -> Array:
    return world_from_camera.inverse().apply(_points(image)[1])[:, 2]


def _moved(image: GroupImage, pose: RigidTransform, motion: Array, shutter: RollingShutter) -> GroupImage:
    """The photograph of a camera that moves while it is read."""
    support, x_in_world = _points(image)
    keypoint, query, before = support.matches.keypoint, support.query, pose.inverse()
    times = row_times(query, shutter)[keypoint]
    seen = np.array([perturbed(before, t * motion).apply(x) for t, x in zip(times, x_in_world, strict=True)])
    keypoints = query.features.keypoints.copy()
    keypoints[keypoint] += query.camera.project(seen) - query.camera.project(before.apply(x_in_world))
    query = replace(query, features=replace(query.features, keypoints=keypoints))
    return replace(image, answer=replace(image.answer, support=replace(support, query=query)))


def test_the_jacobian_is_that_of_the_cameras_motion() -> None:
    state = RigState(WORLD_FROM_RIG.inverse(), tuple(RIG_FROM_CAMERA))
    before = state.camera_from_world(1)

    def motion(step: Array) -> Array:
        after = state.moved(step).camera_from_world(1)
        turn = after.rotation @ before.rotation.T
        return np.concatenate([after.translation - turn @ before.translation, rotation_vector(turn)])

    assert_jacobian(state.jacobian(1), motion, np.zeros(6))


HERE = RigidTransform.identity()


def alone(inliers: int) -> Answer:
    return Answer(Localization(HERE, None, PoseStage.REFINED, inliers, 2 * inliers, 1.0))


def rig(*kept: int) -> RigEstimate:
    matched = [SimpleNamespace(source=SimpleNamespace(image=i), inliers=np.ones(n)) for i, n in enumerate(kept)]
    return RigEstimate(HERE, np.eye(6), cast(Any, tuple(matched)))


def walk(step_m: float, sigma_m: float = 0.01) -> SequenceEstimate:
    poses = tuple(RigidTransform(np.eye(3), np.array([i * step_m, 0, 0])) for i in range(5))
    covariances = np.tile(sigma_m**2 * np.eye(6), (5, 1, 1))
    return SequenceEstimate(cast(Any, None), 0.0, poses, covariances, ())


def test_photographs_that_lose_their_inliers_reject_the_rig() -> None:
    found = check_mounting(rig(1, 0, 688), [alone(681), alone(438), alone(690)])
    assert isinstance(found, Rejection)
    assert found.reason is RejectionReason.GATE
    assert "1 of 681 in images[0], 0 of 438 in images[1]" in found.message
    assert found.hint is not None
    assert found.hint.advice is Advice.CHECK_CALIBRATION


@pytest.mark.parametrize("lost", [alone(29), Answer(Rejection(RejectionReason.GATE, "chance"))])
def test_photographs_with_few_inliers_alone_reject_nothing(lost: Answer) -> None:
    estimate = rig(600, 3)
    assert check_mounting(estimate, [alone(640), lost]) is estimate


@pytest.mark.parametrize("unit_m", [0.01, 0.5, 2.0])
def test_a_walk_of_another_length_is_rejected_with_its_unit(unit_m: float) -> None:
    found = check_unit(walk(0.5), walk(0.5 / unit_m).world_from_camera)
    assert isinstance(found, Rejection)
    assert found.reason is RejectionReason.SCALE_UNRELIABLE
    assert f"its unit is {unit_m:.2f} m" in found.message


@pytest.mark.parametrize(("drift", "sigma_m"), [(1.0, 0.001), (1.1, 0.001), (0.85, 0.001), (2.0, 0.3)])
def test_drift_and_uncertain_lengths_are_accepted(drift: float, sigma_m: float) -> None:
    estimate = walk(0.5, sigma_m)
    assert check_unit(estimate, walk(0.5 * drift).world_from_camera) is estimate


@pytest.mark.parametrize("count", [0, 1, 3, 4])
def test_tracking_that_jumps_between_all_photographs_is_wrong(count: int) -> None:
    estimate = replace(walk(0.5), jumps=tuple(Jump(i, i + 1, 50.0, 1.0) for i in range(count)))
    found = check_tracking(estimate, walk(50.0).world_from_camera, "units")
    if count < 4:
        assert found is estimate
        return
    assert isinstance(found, Rejection)
    assert "session's path is 200.00 long, that of the photographs 2.00 units" in found.message
    assert found.hint is CHECK_TRACKING


def test_the_tracking_is_checked_where_photographs_are_localized_alone() -> None:
    alone = Localization(RigidTransform.identity(), np.eye(6), PoseStage.REFINED, 50, 60, 0.7)
    images = [(Answer(alone, reference_match_counts=(400, 9)), SCENE.references)] * 2
    found = hinted_group(Rejection(RejectionReason.GATE, "planted"), images, is_sequence=True)
    assert str(found.hint) == str(replace(CHECK_TRACKING, best_reference=NAMES[0]))
    of_rig = hinted_group(Rejection(RejectionReason.GATE, "planted"), images).hint
    assert of_rig is not None
    assert "poses of the cameras" in of_rig.message


SCENE = make_scene(random_for("group hints"))
NAMES = [reference.name for reference in SCENE.references]


def hint_of(reason: RejectionReason, *matches: tuple[int, ...]) -> Hint:
    """The result of a group whose photographs share so many features with the references."""
    images = [
        (Answer(Rejection(reason, "alone"), reference_match_counts=counts), SCENE.references) for counts in matches
    ]
    outcome = hinted_group(Rejection(reason, "planted"), images)
    assert (outcome.reason, outcome.message) == (reason, "planted")
    assert isinstance(outcome.hint, Hint)
    return outcome.hint


@pytest.mark.parametrize("reason", RejectionReason)
@pytest.mark.parametrize("matches", [(), (0, 0), (20, 5), (60, 50), (400, 9)])
def test_every_reason_has_a_hint_of_one_sentence(reason: RejectionReason, matches: tuple[int, ...]) -> None:
    hint = hint_of(reason, matches, ())
    assert hint.stage == "join"
    assert hint.message[0].isupper()
    assert hint.message.endswith(".")


def test_the_best_reference_shares_most_with_any_photograph() -> None:
    assert hint_of(RejectionReason.GATE, (40, 60, 50), (31, 33, 70), ()).best_reference == NAMES[2]
    assert hint_of(RejectionReason.GATE, (0, 0), ()).best_reference is None


@pytest.mark.parametrize(
    ("reason", "best", "advice"),
    [
        (RejectionReason.TOO_FEW_MATCHES, 8, Advice.CHOOSE_OTHER_REFERENCES),
        (RejectionReason.TOO_FEW_MATCHES, 50, Advice.LOOK_AT_REFERENCE),
        (RejectionReason.PNP_FAILED, 400, Advice.CHECK_CALIBRATION),
        (RejectionReason.GATE, 50, Advice.LOOK_AT_REFERENCE),
        (RejectionReason.SCALE_UNRELIABLE, 400, Advice.RETAKE_PHOTOGRAPH),
    ],
)
def test_the_advice_follows_from_the_shared_features(reason: RejectionReason, best: int, advice: Advice) -> None:
    hint = hint_of(reason, (best, 3))
    assert hint.advice is advice
    if reason is not RejectionReason.SCALE_UNRELIABLE:
        assert str(best) in hint.message


def test_depths_of_a_network_do_not_pose_a_group() -> None:
    pose = RigidTransform.identity()
    scale = MetricScale(1.0, ScaleStage.NETWORK, 0.0, 0, Similarity(1.0, np.eye(3), np.zeros(3)), pose)
    answer = Answer(Localization(pose, np.eye(6), PoseStage.REFINED, 50, 60, 0.7), scale)
    outcome = rejection_without_matches([replace(NOTHING, answer=answer)])
    assert outcome.reason is RejectionReason.TOO_FEW_MATCHES
    assert "with a single reference" in outcome.message


def test_without_matches_the_hint_is_the_furthest_photographs() -> None:
    own = Hint("coarse", Advice.SPREAD_REFERENCES, "Spread them.", NAMES[0])
    furthest = Rejection(RejectionReason.LOW_OVERLAP, "another place", own)
    images = [NOTHING, replace(NOTHING, answer=Answer(furthest))]
    outcome = hinted_group(rejection_without_matches(images), [])
    assert (outcome.reason, outcome.hint) == (RejectionReason.LOW_OVERLAP, own)


# The adapter of PoseLib's generalized solvers


PNP = PnpOptions()
QUICK = replace(PNP, max_iterations=100, max_matches=600)
TURNED_RIG = RigidTransform(rotation_from_vector([0.3, -0.2, 0.5]), np.array([1.0, -2.0, 3.0]))


def planted(
    random: np.random.Generator, counts: tuple[int, ...], wrong_share: float = 0.0, unit: float = 1.0
) -> list[CameraMatches]:
    """Cameras that look all ways, with so many matches each; `unit` of the rig's frame in metres."""
    cameras = []
    for count in counts:
        rig_from_camera = RigidTransform(rotation_from_vector(random.normal(0, 1, 3)), random.normal(0, 0.3, 3))
        pixels = random.uniform([0, 0], [CAMERA.width_px, CAMERA.height_px], (count, 2))
        x_in_camera = CAMERA.rays(pixels) * random.uniform(3, 8, (count, 1))
        x_in_world = TURNED_RIG.compose(rig_from_camera).apply(x_in_camera)
        pixels = pixels + random.normal(0, 0.3, pixels.shape)
        wrong = random.permutation(count)[: round(wrong_share * count)]
        pixels[wrong] = random.uniform([0, 0], [CAMERA.width_px, CAMERA.height_px], (len(wrong), 2))
        fixed = RigidTransform(rig_from_camera.rotation, rig_from_camera.translation / unit)
        cameras.append(CameraMatches(PixelPoints(CAMERA, x_in_world, pixels), fixed))
    return cameras


@pytest.mark.parametrize("wrong_share", [0.0, 0.5])
def test_rig_ransac_finds_the_planted_pose(wrong_share: float) -> None:
    cameras = planted(random_for("rig", wrong_share), (60, 40, 80), wrong_share)
    found = rig_ransac(cameras, PNP)
    assert found is not None
    assert_pose_close(found, TURNED_RIG, metres=0.005, degrees=0.05)
    assert inlier_count(cameras, found, PNP.inlier_px) >= round(180 * (1 - wrong_share))


@pytest.mark.parametrize("unit", [0.37, 1.0, 25.0])
def test_scaled_ransac_finds_the_planted_pose_and_scale(unit: float) -> None:
    """Metres per unit, not units per metre."""
    cameras = planted(random_for("scaled", unit), (60, 60, 60), 0.5, unit)
    found = scaled_ransac(cameras, replace(PNP, max_iterations=2000, max_matches=600))
    assert found is not None
    assert found.scale == pytest.approx(unit, rel=0.03)
    assert_pose_close(RigidTransform(found.rotation, found.translation), TURNED_RIG, metres=0.05, degrees=0.5)


@pytest.mark.parametrize("counts", [(), (2,), (1, 1)])
def test_too_few_matches_have_no_pose(counts: tuple[int, ...]) -> None:
    cameras = planted(random_for("few"), counts)
    assert rig_ransac(cameras, PNP) is None
    assert not cameras or scaled_ransac(cameras, QUICK) is None


def test_one_camera_alone_has_no_scale() -> None:
    assert scaled_ransac(planted(random_for("one"), (50,)), QUICK) is None


def test_the_same_matches_give_the_same_bits_for_any_rng_state() -> None:
    """PoseLib draws from the C library, as any other library may."""
    libc = ctypes.CDLL(None)
    cameras = planted(random_for("bits"), (60, 40, 80), 0.3)

    def poses(drawn: int) -> list[bytes]:
        for _ in range(drawn):
            libc.rand()
        rigid, scaled = rig_ransac(cameras, PNP), scaled_ransac(cameras, QUICK)
        assert rigid is not None
        assert scaled is not None
        return [it.tobytes() for it in (rigid.matrix(), scaled.rotation, scaled.translation, np.float64(scaled.scale))]

    assert poses(0) == poses(1) == poses(7)
