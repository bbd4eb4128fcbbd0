"""Data read otherwise: planted poses satisfy their matches, and each usual mistake is noticed and named."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from support.posed_views import matched, planted
from support.scenes import CAMERA, SceneOptions, make_scene, random_for

from mapless.geometry import Quaternion, RigidTransform, rotation_from_vector
from mapless_server.method.readings import (
    MatchedPair,
    Verdict,
    consistent_matches,
    judge,
    pair_error_px,
    sampson_px,
    suspects_of,
)
from mapless_server.method.views import PosedView

OPENGL = np.diag([1.0, -1.0, -1.0])
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

Fault = Callable[[RigidTransform], RigidTransform]


def verdict_of(views: Sequence[PosedView], pairs: Sequence[MatchedPair]) -> Verdict:
    return judge(dict(enumerate(views)), pairs)


def test_good_poses_are_good() -> None:
    views = planted()
    verdict = verdict_of(views, matched())
    assert verdict.median_px < 1
    assert (verdict.is_wrong, verdict.suspects, verdict.bad_share) == (False, (), 0.0)


def quaternion_reordered(order: tuple[int, int, int, int]) -> Fault:
    """Parts of x y z w as another order puts them."""

    def fault(pose: RigidTransform) -> RigidTransform:
        q = pose.quaternion()
        parts = np.array([q.x, q.y, q.z, q.w])[list(order)].tolist()
        return RigidTransform(Quaternion(*parts).matrix(), pose.translation)

    return fault


def turned(rotation: NDArray[np.float64]) -> Fault:
    return lambda pose: RigidTransform(pose.rotation @ rotation, pose.translation)


def mirrored(pose: RigidTransform) -> RigidTransform:
    mirror = np.diag([1.0, -1.0, 1.0])
    return RigidTransform(mirror @ pose.rotation @ mirror, mirror @ pose.translation)


def test_each_usual_mistake_is_noticed_and_named() -> None:
    views = planted(5)
    pairs = matched(5)
    w_first, w_last = quaternion_reordered((3, 0, 1, 2)), quaternion_reordered((1, 2, 3, 0))
    faults: dict[str, Fault] = {
        "OpenGL": turned(OPENGL),
        "camera_from_world, not": RigidTransform.inverse,
        "camera_from_world with OpenGL": lambda pose: turned(OPENGL)(pose).inverse(),
        "the quaternions are w x y z": w_first,
        "the quaternions are x y z w": w_last,
        "quaternions of camera_from_world are w x y z": lambda pose: w_first(pose.inverse()).inverse(),
        "quaternions of camera_from_world are x y z w": lambda pose: w_last(pose.inverse()).inverse(),
        "turned by 90": turned(QUARTER.T),
        "turned by 180": turned(QUARTER @ QUARTER),
        "turned by 270": turned(QUARTER),
        "left-handed": mirrored,
    }
    for name, fault in faults.items():
        wrong = [replace(view, world_from_camera=fault(view.world_from_camera)) for view in views]
        verdict = verdict_of(wrong, pairs)
        assert verdict.is_wrong, name
        assert name in verdict.explanation, (name, verdict.explanation)
        assert verdict.explained_px < 1


@pytest.mark.parametrize("quarters", [1, 2, 3])
def test_photographs_turned_without_their_intrinsics_are_named(quarters: int) -> None:
    """By a gallery or a library that applies EXIF's orientation: pose and intrinsics stay those of the sensor."""
    views = planted()
    pairs, wrong = matched(), []
    for posed in views:
        view, camera = posed.view, posed.view.camera
        keypoints, size = view.features.keypoints, (camera.width_px, camera.height_px)
        for _ in range(quarters):  # to the left
            keypoints, size = np.stack([keypoints[:, 1], size[0] - 1 - keypoints[:, 0]], axis=1), size[::-1]
        given = replace(camera, width_px=size[0], height_px=size[1])
        features = replace(view.features, keypoints=keypoints.astype(np.float32))
        wrong.append(replace(posed, view=replace(view, camera=given, features=features)))
    verdict = verdict_of(wrong, pairs)
    assert verdict.is_wrong
    assert f"turned by {90 * quarters} degrees" in verdict.explanation
    assert verdict.explained_px < 1


def test_intrinsics_of_a_photograph_before_it_was_reduced_are_named() -> None:
    views = planted()
    pairs = matched()
    camera = CAMERA.resized(2 * CAMERA.width_px, 2 * CAMERA.height_px)
    given = replace(camera, width_px=CAMERA.width_px, height_px=CAMERA.height_px)
    verdict = verdict_of([replace(view, view=replace(view.view, camera=given)) for view in views], pairs)
    assert "focal lengths and principal points are 0.50 times" in verdict.explanation


@pytest.mark.parametrize("scale", [0.5, 2.0])
def test_intrinsics_of_another_size_are_named_with_their_factor(scale: float) -> None:
    views = planted()
    pairs = matched()
    camera = replace(CAMERA, focal_x_px=scale * CAMERA.focal_x_px, focal_y_px=scale * CAMERA.focal_y_px)
    verdict = verdict_of([replace(view, view=replace(view.view, camera=camera)) for view in views], pairs)
    assert verdict.is_wrong
    assert f"{1 / scale:.2f} times" in verdict.explanation
    assert verdict.explained_px < 1


def test_axes_that_are_mixed_are_named_with_the_photographs() -> None:
    views = planted(9)
    pairs = matched(9)
    mixed = {1, 4, 6, 7}
    fault = turned(OPENGL)
    wrong = [replace(v, world_from_camera=fault(v.world_from_camera)) if i in mixed else v for i, v in enumerate(views)]
    verdict = verdict_of(wrong, pairs)
    assert verdict.is_wrong
    assert verdict.explanation.startswith("with some photographs, not all, the camera axes are OpenGL's")
    assert set(verdict.suspects) == mixed


def test_poses_of_nothing_are_wrong_without_an_explanation() -> None:
    views = planted()
    pairs = matched()
    random = random_for("nonsense poses")
    poses = [RigidTransform(rotation_from_vector(random.normal(0, 1.5, 3)), random.normal(0, 2, 3)) for _ in views]
    wrong = [replace(view, world_from_camera=pose) for view, pose in zip(views, poses, strict=True)]
    verdict = verdict_of(wrong, pairs)
    assert (verdict.is_wrong, verdict.explanation) == (True, "")


def test_a_single_wrong_pose_is_named_and_the_others_are_not() -> None:
    views = planted(12)
    pairs = matched(12)
    wrong = RigidTransform(rotation_from_vector([0.2, 0.0, 0.1]), np.array([0.0, 0.3, 0.0])).compose(
        views[5].world_from_camera
    )
    verdict = verdict_of([replace(v, world_from_camera=wrong) if i == 5 else v for i, v in enumerate(views)], pairs)
    assert (verdict.is_wrong, verdict.suspects) == (False, (5,))


def test_without_pairs_nothing_is_known() -> None:
    verdict = judge({}, [], 7)
    assert (verdict.is_known, verdict.is_wrong, verdict.unmatched_count) == (False, False, 7)
    assert suspects_of([]) == ()


def test_a_moved_keypoints_error_is_its_displacement() -> None:
    """Sampson's distance is to first order how far both keypoints must move: one alone, moved, at most as far."""
    options = SceneOptions(noise_px=0.0, reference_count=2, distractor_count=0, seen_share=1.0)
    first, second = make_scene(random_for("sampson"), options).references
    matches = consistent_matches(first.view, second.view)
    assert len(matches) > 300
    assert sampson_px(first, second, matches).max() < 1e-3
    features = second.view.features
    keypoints = features.keypoints + np.array([0.0, 2.0], np.float32)  # across the lines, which are almost level
    moved = replace(second, view=replace(second.view, features=replace(features, keypoints=keypoints)))
    np.testing.assert_allclose(np.median(sampson_px(first, moved, matches)), 2 / np.sqrt(2), rtol=0.05)


def test_two_photographs_at_one_place_have_no_epipolar_error() -> None:
    first, second = make_scene(random_for("one place"), SceneOptions(reference_count=2)).references
    matches = consistent_matches(first.view, second.view)
    assert np.isnan(pair_error_px(first, replace(second, world_from_camera=first.world_from_camera), matches))
    assert np.isnan(pair_error_px(first, second, matches[:0]))
