"""Pairs of references that agree with their poses or not, by matches that the poses took no part in."""

from dataclasses import replace

import numpy as np
import pytest
from support.scenes import SceneOptions, make_scene, random_for

from mapless.answers import Accuracy
from mapless.geometry import RigidTransform, rotation_from_vector
from mapless.provenance import Provenance
from mapless_server.method.features.views import PosedView
from mapless_server.method.judge.references import (
    Supporters,
    disagreeing_references,
    stated_px,
    with_contradiction,
    without_agreement,
)
from mapless_server.method.pairs.agreement import LARGEST_ERROR_PX, MAX_ERROR_PX, pair_error_px
from mapless_server.method.pairs.correspond import Matcher
from mapless_server.method.rejection import Advice, Rejection, RejectionReason

SCENE = make_scene(random_for("agreement"), SceneOptions(reference_count=4, point_count=150, outlier_share=0.1))
OPENGL = np.diag([1.0, -1.0, -1.0])


def error_px(first: PosedView, second: PosedView) -> float | None:
    matcher = Matcher()
    matcher.pairs.match(first, second)
    return matcher.pairs.error_px(first, second)


def moved(view: PosedView, pose: RigidTransform) -> PosedView:
    return replace(view, world_from_camera=pose)


def test_right_poses_agree_in_any_unit_and_world() -> None:
    first, second = SCENE.references[:2]
    found = error_px(first, second)
    assert found is not None
    assert found <= MAX_ERROR_PX
    for scale in (0.001, 1000.0):
        scaled = [
            moved(it, RigidTransform(it.world_from_camera.rotation, scale * it.world_from_camera.translation))
            for it in (first, second)
        ]
        assert error_px(*scaled) == pytest.approx(found, abs=1e-6)


@pytest.mark.parametrize("reading", ["OpenGL", "inverse"])
def test_poses_read_otherwise_do_not_agree(reading: str) -> None:
    def read(view: PosedView) -> PosedView:
        pose = view.world_from_camera
        return moved(
            view, pose.inverse() if reading == "inverse" else RigidTransform(pose.rotation @ OPENGL, pose.translation)
        )

    for second in SCENE.references[1:]:
        found = error_px(read(SCENE.references[0]), read(second))
        assert found is None or found > MAX_ERROR_PX
    assert error_px(read(SCENE.references[0]), read(SCENE.references[3])) is not None


def test_points_behind_both_cameras_are_no_agreement() -> None:
    # Ahead and back have the same epipolar lines.
    one, other = SCENE.references[:2]
    ahead = RigidTransform(np.eye(3), np.zeros(3)), RigidTransform(np.eye(3), np.array([0.0, 0.0, 0.5]))
    points = random_for("behind").uniform([-1, -1, 2], [1, 1, 4], (80, 3))
    seen = []
    for view, pose in zip((one, other), ahead, strict=True):
        pixels = view.view.camera.project(pose.inverse().apply(points)).astype(np.float32)
        features = replace(
            view.view.features.every(1),
            keypoints=pixels,
            descriptors=np.eye(80, 128, dtype=np.float32),
            sizes_px=np.ones(80, np.float32),
        )
        seen.append(replace(moved(view, pose), view=replace(view.view, features=features)))
    matches = np.stack([np.arange(80)] * 2, axis=1).astype(np.int32)
    right = pair_error_px(seen[0], seen[1], matches)
    assert right is not None
    assert right < 0.01
    back = moved(seen[1], RigidTransform(np.eye(3), np.array([0.0, 0.0, -0.5])))
    assert pair_error_px(seen[0], back, matches) == LARGEST_ERROR_PX


def test_one_place_with_another_rotation_is_no_agreement() -> None:
    first, second = SCENE.references[0], SCENE.references[3]
    turned = first.world_from_camera.rotation @ rotation_from_vector([0.0, 0.3, 0.0])
    found = error_px(first, moved(second, RigidTransform(turned, first.world_from_camera.translation)))
    assert found is not None
    assert found > MAX_ERROR_PX


def test_a_pair_that_shows_nothing_in_common_says_nothing() -> None:
    other = make_scene(random_for("elsewhere"), SceneOptions(reference_count=2, point_count=150)).references[1]
    assert error_px(SCENE.references[0], replace(other, key="another", name="scenes/s/references/another")) is None


def test_a_pose_on_references_that_disagree_is_rejected() -> None:
    names, counts = ["a", "b", "c", "d"], [90, 80, 70, 2]
    wrong = {(0, 1): 40.0, (0, 2): 30.0, (1, 2): 0.4}
    found = disagreeing_references([Supporters(names, counts, lambda i, j: wrong.get((i, j)))])
    assert found is not None
    assert found.reason is RejectionReason.GATE
    assert found.hint is not None
    assert (found.hint.advice, found.hint.best_reference) == (Advice.CHECK_REFERENCE_POSES, "a")
    # Half of them, or a pair with a reference that supports nothing, is no contradiction.
    assert (
        disagreeing_references([Supporters(names, counts, lambda i, j: {(0, 1): 9.0, (0, 2): 0.1}.get((i, j)))]) is None
    )
    assert disagreeing_references([Supporters(names, counts, lambda i, j: 99.0 if j == 3 else None)]) is None
    assert disagreeing_references([Supporters(names, counts, None)]) is None


def test_errors_that_poses_state_are_tolerated() -> None:
    """Two standard deviations of 1 cm, of references that look at what is 4 m away."""
    names, counts, covariance = ["a", "b"], [90, 80], np.diag([1e-4, 0.0, 0.0, 0.0, 0.0, 0.0])
    known = Provenance(accuracy=Accuracy(0.01, 0.02, 0.0, 0.0), covariance=covariance.tolist())
    stated = stated_px([replace(SCENE.references[0], provenance=known), SCENE.references[1]], 4.0)
    camera = SCENE.references[0].view.camera
    assert stated == [pytest.approx(camera.focal_x_px * 1024 / camera.width_px * 0.02 / 4.0), 0.0]
    assert stated_px(SCENE.references, 4.0) == []
    for error, is_tolerated in ((1.01 * MAX_ERROR_PX, True), (3 * (MAX_ERROR_PX + stated[0]), False)):
        found = disagreeing_references([Supporters(names, counts, lambda i, j, it=error: it, stated)])  # type: ignore[misc]
        assert (found is None) == is_tolerated
    assert disagreeing_references([Supporters(names, counts, lambda i, j: 1.01 * MAX_ERROR_PX)]) is not None


def test_in_a_contradicting_scene_two_references_must_agree() -> None:
    names, counts = ["a", "b", "c"], [90, 80, 2]
    assert without_agreement([Supporters(names, counts, lambda i, j: 0.5 if j == 1 else None)]) is None
    for errors in (lambda i, j: None, lambda i, j: 0.5 if j == 2 else 9.0, None):
        found = without_agreement([Supporters(names, counts, errors)])
        assert found is not None
        assert found.hint is not None
        assert (found.hint.advice, found.hint.best_reference) == (Advice.CHECK_REFERENCE_POSES, "a")


def test_rejections_of_a_contradicting_scene_accuse_nothing_else() -> None:
    rejected = Rejection(RejectionReason.LOW_OVERLAP, "7 of 90 matches agree")
    found = with_contradiction(rejected, "the scene contradicts itself")
    assert found.message == "7 of 90 matches agree; the scene contradicts itself"
    assert found.hint is not None
    assert found.hint.advice is Advice.CHECK_REFERENCE_POSES
    assert found.intrinsics_checks == ()
    assert with_contradiction(found, "the scene contradicts itself").message == found.message
    assert with_contradiction(rejected, "") is rejected
