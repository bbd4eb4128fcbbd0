"""Rolling shutter: planted motions are found and removed, and radii contain what is not known of them."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import multivariate_normal
from support.compare import pose_error
from support.localizing import SCENE, pipeline_of, pose_of
from support.planted import stages
from support.scenes import SyntheticScene, random_for

from mapless.geometry import Array, Camera
from mapless.lenses import RadialTangential
from mapless_server.method.bundle.estimate import PosedSupport, accuracy_from_covariance
from mapless_server.method.bundle.pose_problem import AdjustOptions
from mapless_server.method.bundle.priors import NO_PRIORS, PositionPrior, Priors
from mapless_server.method.bundle.readout import ReadoutDirection, RollingShutter, TrackedMotion
from mapless_server.method.bundle.shutter import (
    MotionPrior,
    StillView,
    row_times,
    still_view,
    with_motion,
    without_motion,
)
from mapless_server.method.features.views import Features, View, undistort_pixels
from mapless_server.method.localize import localize
from mapless_server.method.optim.optimize import perturbed
from mapless_server.method.optim.rotations import rotation_vector
from mapless_server.method.options import LocalizeOptions, Variant
from mapless_server.method.pose.with_priors import refine_pose

SHUTTER = RollingShutter(0.033)
MOTIONS = {
    "pan": (0, 0, 0, 0, -0.05, 0),
    "tilt": (0, 0, 0, 0.026, 0, 0),
    "roll": (0, 0, 0, 0, 0, 0.03),
    "walk and pan": (0, 0, -0.05, 0, 0.02, 0),
}
"""During the read-out, as left perturbations of camera_from_world."""


def read_by_rows(
    scene: SyntheticScene, motion: Array, direction: ReadoutDirection = SHUTTER.direction
) -> SyntheticScene:
    """The scene whose query is read row by row while its camera moves; keypoints without a point stay."""
    query, pixels = scene.query, scene.query.features.pixels()
    shown = scene.query_points >= 0
    x_in_world = scene.x_in_world[scene.query_points[shown]]
    camera_from_world, found = scene.world_from_query.inverse(), pixels.copy()
    noise = pixels[shown] - query.camera.project(camera_from_world.apply(x_in_world))
    size = np.array([query.camera.width_px, query.camera.height_px])
    for _ in range(8):  # the row says when, and when says the row
        times = ((found[shown] + 0.5) / size - 0.5) @ direction.value
        moved = [perturbed(camera_from_world, t * motion).apply(x) for t, x in zip(times, x_in_world, strict=True)]
        found[shown] = query.camera.project(np.array(moved)) + noise
    features = replace(query.features, keypoints=found.astype(np.float32))
    return replace(scene, query=replace(query, features=features))


def off(
    scene: SyntheticScene,
    shutter: RollingShutter | None,
    variant: Variant = Variant.BEST,
    priors: Priors = NO_PRIORS,
) -> tuple[float, float]:
    """The error of the position, metres, and its radius of 95 %."""
    options = LocalizeOptions(variant, shutter=shutter)
    found = pose_of(localize(scene.query, scene.references, pipeline_of("geometric", scene), options, priors=priors))
    assert found.covariance is not None
    metres, _ = pose_error(found.world_from_camera, scene.world_from_query)
    return metres, accuracy_from_covariance(found.covariance).position_95_m


@pytest.mark.parametrize("motion", MOTIONS.values(), ids=MOTIONS)
def test_a_planted_motion_is_removed_from_the_pose(motion: tuple[float, ...]) -> None:
    moving = read_by_rows(SCENE, np.array(motion))
    (still_m, still_95_m), (moving_m, _), (found_m, found_95_m) = (
        off(SCENE, None),
        off(moving, None),
        off(moving, SHUTTER),
    )
    assert moving_m > 2 * still_m
    assert found_m < max(0.4 * moving_m, 2 * still_m)
    assert found_m < found_95_m < 3 * still_95_m


@pytest.mark.parametrize("variant", [Variant.BEST, Variant.FULL])
@pytest.mark.parametrize("motion", ["pan", "walk and pan"])
def test_a_motion_moves_and_widens_no_position_that_is_known(motion: str, variant: Variant) -> None:
    sigma_m, moving = 1e-4, read_by_rows(SCENE, np.array(MOTIONS[motion]))
    priors = Priors(position=PositionPrior(SCENE.world_from_query.translation, sigma_m**2 * np.eye(3)))
    (still_m, still_95_m), (found_m, found_95_m) = (
        off(scene, shutter, variant, priors) for scene, shutter in ((SCENE, None), (moving, SHUTTER))
    )
    assert max(still_m, found_m) < sigma_m
    assert found_95_m < 1.05 * still_95_m


@pytest.mark.parametrize("variant", [Variant.BEST, Variant.FULL])
def test_a_still_photograph_keeps_its_radius(variant: Variant) -> None:
    (without_m, without_95_m), (with_m, with_95_m) = (off(SCENE, it, variant) for it in (None, SHUTTER))
    assert without_95_m <= with_95_m < 1.02 * without_95_m
    assert abs(with_m - without_m) < 0.1 * without_95_m


@pytest.mark.parametrize("direction", ReadoutDirection)
def test_the_side_read_first_says_when_each_row_was_read(direction: ReadoutDirection) -> None:
    moving = read_by_rows(SCENE, np.array(MOTIONS["pan"]), direction)
    right, wrong = (off(moving, replace(SHUTTER, direction=it))[0] for it in (direction, _across(direction)))
    assert right < 0.5 * wrong


def _across(direction: ReadoutDirection) -> ReadoutDirection:
    return ReadoutDirection((direction.value[1], direction.value[0]))


def test_rows_are_those_of_the_sensor_not_of_the_ideal_pinhole() -> None:
    camera = Camera(640, 480, 450.0, 450.0, 319.5, 239.5, RadialTangential(-0.2, 0.05))
    raw = np.array([[20.0, 0.0], [320.0, 239.5], [600.0, 479.0]])
    features = Features(
        undistort_pixels(raw, camera).astype(np.float32), np.zeros((3, 8), np.int8), np.ones(3, np.float32)
    )
    view = View(camera.pinhole(), features, distortion=camera.distortion)
    np.testing.assert_allclose(row_times(view, SHUTTER), (raw[:, 1] + 0.5) / 480 - 0.5, atol=1e-5)


def test_prior_parts_are_weighed_as_dense_normals() -> None:
    random = random_for("motion prior")
    root = random.standard_normal((6, 6))
    information, motion = 1e3 * (root @ root.T + np.eye(6)), np.full(6, 0.01)
    maximum = 0.02 * random.standard_normal(6)
    tracked = TrackedMotion((0.01, 0.0, 0.02, 0.0, 0.03, 0.0), 0.3, 0.2)
    for shutter in (SHUTTER, replace(SHUTTER, tracked=tracked)):
        prior = MotionPrior.of(shutter, 3.0)
        probability, steps = prior.posterior(information, information @ (motion - maximum), motion)
        noise = np.linalg.inv(information)
        covariances = [noise + np.diag(it**2) for it in prior.sigma]
        density = [multivariate_normal(m, c).pdf(maximum) for m, c in zip(prior.mean, covariances, strict=True)]
        expected = prior.share * density
        np.testing.assert_allclose(probability, expected / expected.sum(), rtol=1e-6, atol=1e-12)
        gains = [np.diag(s**2) @ np.linalg.inv(c) for s, c in zip(prior.sigma, covariances, strict=True)]
        found = [m + gain @ (maximum - m) for m, gain in zip(prior.mean, gains, strict=True)]
        np.testing.assert_allclose(motion + steps, found, atol=1e-9)


def test_unseen_motion_is_in_the_covariance_by_its_prior() -> None:
    structure, matches, estimate = stages(SCENE, SCENE.references)
    support = PosedSupport(SCENE.query, SCENE.references, structure, matches, np.zeros(3), estimate=estimate)
    time = row_times(SCENE.query, SHUTTER)
    added = without_motion(support, time, SHUTTER).covariance - estimate.covariance
    seen = matches.seen(SCENE.query, structure.x_in_world)[estimate.inliers]
    at_s, variance = time[matches.keypoint[estimate.inliers]], np.zeros((6, 6))
    spread = MotionPrior.of(SHUTTER, support.distance_m()).spread
    for axis in 0.05 * np.sqrt(np.diag(spread))[:, None] * np.eye(6):
        camera_from_world = estimate.world_from_camera.inverse()
        moved = [perturbed(camera_from_world, t * axis).apply(x) for t, x in zip(at_s, seen.x_in_world, strict=True)]
        shown = replace(seen, pixels=seen.camera.project(np.array(moved)))
        found = refine_pose(shown, estimate.world_from_camera, NO_PRIORS, 1e6)
        shift = found.translation - estimate.world_from_camera.translation
        turn = rotation_vector(found.rotation @ estimate.world_from_camera.rotation.T)
        both = np.concatenate([shift, turn]) / 0.05
        variance += np.outer(both, both)
    np.testing.assert_allclose(added, variance, atol=0.05 * np.abs(variance).max())


def test_a_wrong_match_beside_the_camera_does_not_hide_a_motion() -> None:
    motion = np.array(MOTIONS["pan"])
    moving = read_by_rows(SCENE, motion)
    structure, matches, estimate = stages(moving, moving.references)
    seen = matches.seen(moving.query, structure.x_in_world)
    beside = estimate.world_from_camera.apply(np.array([[0.5, 0.3, 1e-3]]))
    seen = replace(seen, x_in_world=np.concatenate([beside, seen.x_in_world[1:]]))
    tracked = replace(SHUTTER, tracked=TrackedMotion((0, 0, -0.05, 0, 0, 0), 0.5, 0.5))
    for shutter in (SHUTTER, tracked):
        still = still_view(moving.query, seen, matches.keypoint, estimate.world_from_camera, shutter)
        assert np.abs(still.motion - motion)[3:].max() < 0.005


def test_a_step_beyond_the_linear_widens_the_radius_alone() -> None:
    moving = read_by_rows(SCENE, 3 * np.array(MOTIONS["pan"]))
    structure, matches, estimate = stages(moving, moving.references)
    support = PosedSupport(
        moving.query,
        moving.references,
        structure,
        matches,
        np.zeros(3),
        estimate=estimate,
    )
    still = StillView(moving.query, row_times(moving.query, SHUTTER), np.full(6, 0.5), estimate.world_from_camera)
    found = with_motion(support, still, SHUTTER, AdjustOptions())
    assert found.world_from_camera is estimate.world_from_camera
    before, after = (accuracy_from_covariance(it.covariance).position_95_m for it in (estimate, found))
    assert after > 3 * before
