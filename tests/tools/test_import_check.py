"""The check of poses before an import: which photographs are compared, and what is read."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from support.images import encode
from support.posed_views import planted
from support.scenes import CAMERA

from mapless.geometry import Camera, RigidTransform, rotation_from_vector
from mapless_server.method.features.views import Ignored, PosedView, View
from mapless_tools.dataset import Frame
from mapless_tools.ingest.check import check_frames
from mapless_tools.ingest.check.pairs import more_pairs, pairs_by_order, pairs_by_pose

Fault = Callable[[RigidTransform], RigidTransform]


def opengl(pose: RigidTransform) -> RigidTransform:
    return RigidTransform(pose.rotation @ np.diag([1.0, -1.0, -1.0]), pose.translation)


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

    def extract(self, image: NDArray[np.uint8], camera: Camera, ignored: Ignored | None = None) -> View:
        view = self._views[int(image[0, 0, 0])].view
        return replace(view, camera=replace(camera, distortion=None))


def frames_of(folder: Path, views: Sequence[PosedView], fault: Fault) -> list[Frame]:
    frames = []
    for i, view in enumerate(views):
        file = folder / f"{i}.png"
        file.write_bytes(encode(".png", np.full((CAMERA.height_px, CAMERA.width_px, 3), i, np.uint8)))
        frames.append(Frame(f"r{i}", file, CAMERA, fault(view.world_from_camera)))
    return frames


@pytest.mark.parametrize("fault", [RigidTransform.inverse, opengl])
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
