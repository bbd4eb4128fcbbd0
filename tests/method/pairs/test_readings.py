"""Data read otherwise: planted poses satisfy their matches, and each usual mistake is noticed and named."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest
from numpy.typing import NDArray
from support.posed_views import matched, planted
from support.scenes import CAMERA, SceneOptions, make_scene, random_for

from mapless.geometry import Quaternion, RigidTransform, Similarity, rotation_from_vector
from mapless_server.method.features.views import Features, PosedView, View
from mapless_server.method.pairs.epipolar import sampson_px
from mapless_server.method.pairs.readings.alignment import align
from mapless_server.method.pairs.readings.errors import MatchedPair, PairError, consistent, distinct_matches, errors_of
from mapless_server.method.pairs.readings.rounding import steps_of
from mapless_server.method.pairs.readings.verdict import Verdict, judge, suspects_of

BODY = np.array([[0.0, -1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])
"""Optical axes from those of REP 103."""
UNREAL, MIRROR = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]), np.diag([1.0, -1.0, 1.0])
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
        "left-handed (y up": mirrored,
        "REP 103: x forward": turned(BODY),
        "camera_from_world with a robot's": lambda pose: turned(BODY)(pose).inverse(),
        "vehicle's body": turned(BODY @ OPENGL),
        "as if they were a robot's": turned(BODY.T),
        "left-handed (x forward": lambda pose: turned(UNREAL)(mirrored(turned(MIRROR)(pose))),
        "x down, y right, z back": turned(np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])),
        "transposed": lambda pose: RigidTransform(pose.rotation.T, pose.translation),
        "translations of camera_from_world": lambda p: RigidTransform(p.rotation, p.inverse().translation),
        "(x, -z, y)": lambda p: RigidTransform(p.rotation, p.translation[[0, 2, 1]] * [1, 1, -1]),
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


def test_intrinsics_that_were_read_otherwise_are_named() -> None:
    given = {
        "K is given by columns": replace(CAMERA, principal_x_px=0.0, principal_y_px=0.0),
        "cx and cy are exchanged": replace(
            CAMERA, principal_x_px=CAMERA.principal_y_px, principal_y_px=CAMERA.principal_x_px
        ),
        "K was not set": replace(CAMERA, focal_x_px=1.0, focal_y_px=1.0, principal_x_px=0.0, principal_y_px=0.0),
        "K was not set (a camera that is not calibrated), or is not in pixels": replace(
            CAMERA, focal_x_px=0.85, focal_y_px=0.85, principal_x_px=0.5, principal_y_px=0.5
        ),
    }
    for name, wrong in given.items():
        views = [replace(it, view=replace(it.view, camera=wrong)) for it in planted()]
        verdict = verdict_of(views, matched())
        assert verdict.is_wrong, name
        assert name in verdict.explanation, (name, verdict.explanation)
        assert "; or" not in verdict.explanation


def test_cx_and_cy_that_hardly_differ_are_not_said_exchanged() -> None:
    views = [replace(it, view=replace(it.view, camera=replace(CAMERA, principal_y_px=478.0))) for it in planted()]
    assert "exchanged" not in verdict_of(views, matched()).explanation


@pytest.mark.parametrize("step", [0.5, 1.0])
def test_positions_of_few_digits_are_named_as_rounded(step: float) -> None:
    """As coordinates of a map projection with six digits: multiples of a metre, or of half a metre."""
    far = np.array([453_218.3, 5_412_345.6, 120.4])
    wrong = []
    for it in planted():
        pose = it.world_from_camera
        position = np.round((pose.translation + far) / step) * step
        wrong.append(replace(it, world_from_camera=RigidTransform(pose.rotation, position)))
    verdict = verdict_of(wrong, matched())
    assert verdict.is_wrong
    assert "the positions are rounded" in verdict.explanation


def test_points_behind_the_cameras_contradict_the_poses() -> None:
    """Parallel cameras that move the other way satisfy every epipolar constraint."""
    random = random_for("the other way")
    x_in_world = np.column_stack([random.uniform(-2, 2, (200, 2)), random.uniform(4, 8, 200)])
    views, pairs = {}, []
    for i in range(4):
        position = np.array([0.3 * i, 0.05 * i * i, 0.0])
        features = Features(
            CAMERA.project(x_in_world - position).astype(np.float32),
            np.zeros((200, 4), np.float32),
            np.ones(200, np.float32),
        )
        views[i] = PosedView(str(i), str(i), View(CAMERA, features), RigidTransform(np.eye(3), position))
        pairs += [MatchedPair((j, i), np.repeat(np.arange(200, dtype=np.int32)[:, None], 2, axis=1)) for j in range(i)]
    assert not judge(views, pairs).is_wrong
    moved = {i: replace(it, world_from_camera=it.world_from_camera.inverse()) for i, it in views.items()}
    verdict = judge(moved, pairs)
    assert verdict.is_wrong
    assert verdict.median_px < 0.01
    assert all(it.is_behind for it in verdict.pairs)


def test_two_sessions_are_named_with_the_similarity_that_aligns() -> None:
    views, pairs = planted(10), matched(10)
    other_from_world = Similarity(0.4, rotation_from_vector([0.1, 0.7, -0.2]), np.array([3.0, -2.0, 11.0]))
    second = {1, 3, 5, 7}
    wrong = [
        replace(it, world_from_camera=other_from_world.transform_pose(it.world_from_camera)) if i in second else it
        for i, it in enumerate(views)
    ]
    verdict = verdict_of(wrong, pairs)
    assert verdict.is_wrong
    assert "two sessions, 6 and 4 photographs" in verdict.explanation
    assert "scale 2.5, rotation by 42.1 degrees" in verdict.explanation
    assert set(verdict.suspects) == second
    between = [it if it.pair[1] in second else MatchedPair(it.pair[::-1], it.matches[:, ::-1]) for it in pairs]
    between = [it for it in between if (it.pair[0] in second, it.pair[1] in second) == (False, True)]
    found = align(dict(enumerate(wrong)), between)
    assert found is not None
    assert found.is_unique
    np.testing.assert_allclose(found.world_from_other.scale, 2.5, rtol=0.01)
    for i in second:
        aligned = found.world_from_other.transform_pose(wrong[i].world_from_camera)
        np.testing.assert_allclose(aligned.translation, views[i].world_from_camera.translation, atol=0.02)


def test_one_pose_of_different_photographs_is_named() -> None:
    """As of a tracker that has not begun; a camera that stands still is right."""
    views = planted(10)
    one = RigidTransform.identity()
    wrong = [replace(it, world_from_camera=one) if i < 3 else it for i, it in enumerate(views)]
    verdict = verdict_of(wrong, matched(10))
    assert verdict.same_pose == ((0, 1, 2),)
    assert (verdict.is_wrong, verdict.suspects) == (False, ())
    still = [replace(views[0], world_from_camera=one)] * 3
    same = np.repeat(np.arange(len(views[0].view.features), dtype=np.int32)[:, None], 2, axis=1)
    assert verdict_of(still, [MatchedPair((0, 1), same), MatchedPair((1, 2), same)]).same_pose == ()


def test_one_photograph_with_two_poses_is_named() -> None:
    views = planted(8)
    twice = [*views, replace(views[2], world_from_camera=views[6].world_from_camera)]
    same = np.repeat(np.arange(len(views[2].view.features), dtype=np.int32)[:, None], 2, axis=1)
    verdict = verdict_of(twice, [*matched(8), MatchedPair((2, 8), same)])
    assert verdict.same_photograph == ((2, 8),)
    assert verdict_of(views, matched(8)).same_photograph == ()


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


@pytest.mark.parametrize(("right", "bad", "is_named"), [(8, 1, 0), (8, 2, 0), (12, 2, 0), (8, 3, 1), (8, 8, 1)])
def test_few_bad_pairs_accuse_no_photograph(right: int, bad: int, is_named: bool) -> None:
    """All pairs of the last photograph are bad, all others good: chance makes one or two, but not three."""
    errors = [PairError(pair, 0.5, 3.0, 100) for pair in combinations(range(right), 2)]
    errors += [PairError((i, right), 30.0, 3.0, 100) for i in range(bad)]
    assert suspects_of(errors) == ((right,) if is_named else ())


def test_pairs_that_are_bad_everywhere_accuse_no_photograph() -> None:
    """Where a third of the others' pairs are bad, too, four bad ones are no surprise."""
    others = list(combinations(range(8), 2))
    errors = [PairError(pair, 30.0 if i % 3 == 0 else 0.5, 3.0, 100) for i, pair in enumerate(others)]
    errors += [PairError((i, 8), 30.0, 3.0, 100) for i in range(4)]
    assert 8 not in suspects_of(errors)


def test_without_pairs_nothing_is_known() -> None:
    verdict = judge({}, [], 7)
    assert (verdict.is_known, verdict.is_wrong, verdict.unmatched_count) == (False, False, 7)
    assert suspects_of([]) == ()


def test_a_moved_keypoints_error_is_its_displacement() -> None:
    """Sampson's distance is to first order how far both keypoints must move: one alone, moved, at most as far."""
    options = SceneOptions(noise_px=0.0, reference_count=2, distractor_count=0, seen_share=1.0)
    first, second = make_scene(random_for("sampson"), options).references
    matches = consistent(first.view, second.view, distinct_matches(first.view, second.view))
    assert len(matches) > 300
    assert sampson_px(first, second, matches).max() < 1e-3
    features = second.view.features
    keypoints = features.keypoints + np.array([0.0, 2.0], np.float32)  # across the lines, which are almost level
    moved = replace(second, view=replace(second.view, features=replace(features, keypoints=keypoints)))
    np.testing.assert_allclose(np.median(sampson_px(first, moved, matches)), 2 / np.sqrt(2), rtol=0.05)


def test_photographs_at_one_place_are_compared_by_rotation() -> None:
    first, second = make_scene(random_for("one place"), SceneOptions(reference_count=2)).references
    matches = consistent(first.view, second.view, distinct_matches(first.view, second.view))
    one_place = replace(second, world_from_camera=first.world_from_camera)
    assert np.median(sampson_px(first, one_place, matches)) > 10
    turned_pose = RigidTransform(first.world_from_camera.rotation @ rotation_from_vector([0.0, 0.2, 0.1]), np.zeros(3))
    camera = first.view.camera
    rays = camera.rays(first.view.features.keypoints) @ first.world_from_camera.rotation.T @ turned_pose.rotation
    features = replace(first.view.features, keypoints=camera.project(rays).astype(np.float32))
    here = replace(first, world_from_camera=RigidTransform(first.world_from_camera.rotation, np.zeros(3)))
    there = replace(first, view=replace(first.view, features=features), world_from_camera=turned_pose)
    same = np.repeat(np.arange(len(features), dtype=np.int32)[:, None], 2, axis=1)
    assert np.median(sampson_px(here, there, same)) < 1e-3
    assert errors_of({0: first, 1: second}, [MatchedPair((0, 1), matches[:0])]) == []


def test_a_pose_that_is_given_several_times_shows_no_rounding() -> None:
    different = [view.world_from_camera for view in planted(5)]
    start = [RigidTransform.identity()] * 5
    assert steps_of([*start, *different])[1] == 0
    rounded = [
        RigidTransform(rotation_from_vector([0.1 * i, 0.2, 0]), np.round(it.translation, 1))
        for i, it in enumerate(different)
    ]
    np.testing.assert_allclose(steps_of([*start, *rounded])[0], 0.1)
