"""The check of poses: planted poses satisfy their matches, and each usual mistake is noticed and named."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.images import encode
from support.scenes import CAMERA, SceneOptions, look_at, make_scene, observe, random_for, unit_rows

from mapless.geometry import Camera, Quaternion, RigidTransform, rotation_from_vector
from mapless_server.method.views import PosedView, View
from mapless_tools.dataset import Frame
from mapless_tools.ingest.check import check_frames
from mapless_tools.ingest.check.errors import (
    MatchedPair,
    consistent_matches,
    more_pairs,
    pair_error_px,
    pairs_by_order,
    pairs_by_pose,
    sampson_px,
)
from mapless_tools.ingest.check.verdict import Verdict, judge, suspects_of

OPENGL = np.diag([1.0, -1.0, -1.0])
QUARTER = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])

Fault = Callable[[RigidTransform], RigidTransform]


@cache
def planted(count: int = 8) -> list[PosedView]:
    """Views of a box of points, lifted and rolled so that no mistake is a symmetry; some matches are wrong."""
    random = random_for("epipolar")
    options = SceneOptions(point_count=250, outlier_share=0.05, distractor_count=50)
    x_in_world = (random.random((options.point_count, 3)) - 0.5) * options.box_m
    descriptors = unit_rows(random.standard_normal((options.point_count, options.descriptor_size)))
    world_from_scene = RigidTransform(rotation_from_vector([0.9, -0.4, 1.3]), np.array([3.0, -5.0, 2.0]))
    views = []
    for i, across in enumerate(np.linspace(-2, 2, count)):
        upright = look_at(np.array([across, random.uniform(-1, 1), -4.0]), random.uniform(-0.4, 0.4, 3))
        roll = rotation_from_vector([0.0, 0.0, random.uniform(-0.5, 0.5)])
        pose = RigidTransform(upright.rotation @ roll, upright.translation)
        view, _ = observe(random, options, x_in_world, descriptors, pose)
        views.append(PosedView(f"key-{i}", f"r{i}", view, world_from_scene.compose(pose)))
    return views


@cache
def matched(count: int = 8) -> list[MatchedPair]:
    """Of the planted views: matches do not depend on poses."""
    views, found = planted(count), []
    for i, j in combinations(range(len(views)), 2):
        matches = consistent_matches(views[i].view, views[j].view)
        if j - i <= 3 and len(matches):
            found.append(MatchedPair((i, j), matches))
    return found


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


def walk(count: int) -> list[RigidTransform]:
    """A straight walk with the camera ahead, 1 cm a step."""
    return [RigidTransform(np.eye(3), np.array([0.01 * i, 0.0, 0.0])) for i in range(count)]


def test_pairs_are_spread_apart_enough_and_look_the_same_way() -> None:
    poses = walk(400)
    poses[100:120] = [RigidTransform(rotation_from_vector([0, np.pi, 0]), p.translation) for p in poses[100:120]]
    pairs = pairs_by_pose(poses)
    assert len(pairs) == len(set(pairs)) == 24
    for i, j in pairs:
        assert i < j
        assert poses[i].rotation[2, 2] == pytest.approx(poses[j].rotation[2, 2])
    baselines = [np.linalg.norm(poses[i].translation - poses[j].translation) for i, j in pairs]
    assert np.median(baselines) > 0.05  # not the next frame of the video
    assert {i * 4 // 400 for i, _ in pairs} == {0, 1, 2, 3}


def test_few_photographs_are_all_compared_more_than_once() -> None:
    pairs = pairs_by_pose(walk(6))
    assert min(sum(i in pair for pair in pairs) for i in range(6)) >= 2
    assert not set(more_pairs(walk(6), 2, pairs, 3)) & set(pairs)
    assert pairs_by_pose([RigidTransform.identity()] * 5) == []


def test_pairs_by_order_are_near_in_it_and_spread() -> None:
    pairs = pairs_by_order(500)
    assert len(pairs) == 24
    assert {j - i for i, j in pairs} == {1, 3, 10, 30}
    assert (min(i for i, _ in pairs), max(j for _, j in pairs)) == (0, 499)
    assert pairs_by_order(2) == [(0, 1)]


class NumberedViews:
    """Stands for an extractor: the photograph's colour says which of the planted views it is."""

    name = "numbered"

    def __init__(self, views: Sequence[PosedView]) -> None:
        self._views = views

    def extract(self, image: NDArray[np.uint8], camera: Camera) -> View:
        view = self._views[int(image[0, 0, 0])].view
        return replace(view, camera=replace(camera, distortion=None))


def frames_of(folder: Path, views: Sequence[PosedView], fault: Fault) -> list[Frame]:
    frames = []
    for i, view in enumerate(views):
        file = folder / f"{i}.png"
        file.write_bytes(encode(".png", np.full((CAMERA.height_px, CAMERA.width_px, 3), i, np.uint8)))
        frames.append(Frame(f"r{i}", file, CAMERA, fault(view.world_from_camera)))
    return frames


@pytest.mark.parametrize("fault", [RigidTransform.inverse, turned(OPENGL)])
def test_wrong_poses_that_separate_neighbours_are_explained(tmp_path: Path, fault: Fault) -> None:
    """Photographs that are near in the folder's order are compared as well."""
    views = planted(10)
    steps: list[str] = []
    verdict = check_frames(frames_of(tmp_path, views, fault), lambda step, *_: steps.append(step), NumberedViews(views))
    assert verdict.is_wrong
    assert ("OpenGL" if fault is not RigidTransform.inverse else "camera_from_world") in verdict.explanation
    assert set(steps) == {"checking poses"}


def test_photographs_that_cannot_be_read_are_left_to_the_upload(tmp_path: Path) -> None:
    views = planted()
    frames = frames_of(tmp_path, views, lambda pose: pose)
    (tmp_path / "0.png").write_bytes(b"no image")
    (tmp_path / "1.png").unlink()
    progress: list[tuple[int, int]] = []
    verdict = check_frames(frames, lambda step, *counts: progress.append(counts), NumberedViews(views))
    assert (verdict.is_known, verdict.is_wrong) == (True, False)
    assert not {0, 1} & {i for error in verdict.pairs for i in error.pair}
    assert verdict.unmatched_count == 0
    assert progress[-1] == (8, 8)
    assert not check_frames(frames[:1], lambda *_: None, NumberedViews(views)).is_known


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
