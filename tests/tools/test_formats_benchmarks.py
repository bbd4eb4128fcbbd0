"""7-Scenes, 12-Scenes and Cambridge as users have them: planted poses come back, wrong frames are named."""

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.images import textured
from support.layouts import (
    assert_reads,
    assert_same_camera,
    assert_same_pose,
    by_name,
    reasons,
    truth,
    write_cambridge,
    write_image,
    write_seven_scenes,
    write_twelve_scenes,
)

from mapless.geometry import Camera, RigidTransform
from mapless.lenses import RadialTangential
from mapless_tools.ingest.formats import Intrinsics, ReadOptions, read_dataset

TRUTH = truth(4, Camera(96, 64, 525.0, 525.0, 320.0, 240.0))
TWELVE_CAMERA = Camera(96, 64, 572.0, 573.0, 47.25, 30.75)


SHOTS = [(textured(96, 64, seed=i), pose) for i, pose in enumerate(TRUTH.poses)]
NVM_K = 0.08


def write_chess(folder: Path) -> Path:
    return write_seven_scenes(folder / "chess", SHOTS[:2], SHOTS[2:])


def write_kitchen(folder: Path) -> Path:
    return write_twelve_scenes(folder / "apt1" / "kitchen", TWELVE_CAMERA, SHOTS[:1], SHOTS[1:])


def write_shop(folder: Path) -> Path:
    return write_cambridge(folder / "ShopFacade", SHOTS[:2], SHOTS[2:], [70, 71, 72, 73], NVM_K)


def pgt_line(image: str, pose: RigidTransform, focal_px: float) -> str:
    camera_from_world = pose.inverse()
    q = camera_from_world.quaternion()
    numbers = [q.w, q.x, q.y, q.z, *camera_from_world.translation.tolist()]
    return " ".join([image, *(f"{number:.9f}" for number in numbers), f"{focal_px}"]) + "\n"


def test_seven_scenes_has_poses_intrinsics_and_official_split(tmp_path: Path) -> None:
    dataset = read_dataset(write_chess(tmp_path))
    assert_reads(dataset, TRUTH)
    assert [frame.name for frame in dataset.frames] == [
        "seq-01_frame-000000",
        "seq-01_frame-000001",
        "seq-02_frame-000000",
        "seq-02_frame-000001",
    ]
    assert [frame.split for frame in dataset.frames] == ["train", "train", "test", "test"]
    assert (dataset.format, dataset.metric, dataset.name) == ("7scenes", True, "chess")
    assert "KinectFusion" in dataset.ground_truth
    assert "525" in dataset.notes[0]


def test_seven_scenes_takes_intrinsics_that_are_given(tmp_path: Path) -> None:
    given = Intrinsics(500.0, 501.0, 40.0, 30.0)
    dataset = read_dataset(write_chess(tmp_path), options=ReadOptions(intrinsics=given))
    assert_same_camera(dataset.frames[0].camera, given.camera(96, 64))


def test_frames_without_a_pose_are_refused_and_the_rest_is_read(tmp_path: Path) -> None:
    scene = write_chess(tmp_path)
    (scene / "seq-01" / "frame-000000.pose.txt").write_text("-inf " * 4 + "\n" + "-inf " * 12)
    (scene / "seq-01" / "frame-000001.pose.txt").unlink()
    (scene / "seq-02" / "frame-000000.pose.txt").write_text("1 0 0 0  0 1 0 0  0 0 -1 0  0 0 0 1")
    dataset = read_dataset(scene, "7scenes")
    assert [frame.name for frame in dataset.frames] == ["seq-02_frame-000001"]
    why = reasons(dataset)
    assert "not finite" in why["seq-01/frame-000000.color.png"]
    assert "no file" in why["seq-01/frame-000001.color.png"]
    assert "reflection" in why["seq-02/frame-000000.color.png"]


def test_a_sequence_that_is_still_packed_is_named(tmp_path: Path) -> None:
    scene = write_chess(tmp_path)
    shutil.rmtree(scene / "seq-02")
    dataset = read_dataset(scene)
    assert len(dataset.frames) == 2
    assert "still packed" in reasons(dataset)["seq-02"]


def test_contradictory_or_invalid_splits_end_the_reading(tmp_path: Path) -> None:
    scene = write_chess(tmp_path)
    (scene / "TestSplit.txt").write_text("sequence1\n")
    with pytest.raises(ValueError, match=r"TestSplit\.txt: seq-01 is in both"):
        read_dataset(scene)
    (scene / "TestSplit.txt").write_text("sequence2\nchess\n")
    with pytest.raises(ValueError, match=r"TestSplit\.txt:2: .*'chess'"):
        read_dataset(scene)


def test_pseudo_ground_truth_replaces_poses_and_focal_length(tmp_path: Path) -> None:
    scene = write_chess(tmp_path)
    better = [pose.shifted([0.1, 0.2, 0.3]) for pose in TRUTH.poses]
    images = [f"seq-{1 + i // 2:02d}/frame-{i % 2:06d}.color.png" for i in range(4)]
    lines = [pgt_line(image, pose, 526.5) for image, pose in zip(images, better, strict=True)]
    folder = tmp_path / "pgt" / "sfm" / "7scenes"
    folder.mkdir(parents=True)
    (folder / "chess_train.txt").write_text("".join(reversed(lines[:2])))
    (folder / "chess_test.txt").write_text(lines[3])  # SfM lost one
    for place in (tmp_path / "pgt", tmp_path / "pgt" / "sfm", folder):
        dataset = read_dataset(scene, options=ReadOptions(ground_truth=place))
        assert "SfM" in dataset.ground_truth
        frames = by_name(dataset)
        assert set(frames) == {"seq-01_frame-000000", "seq-01_frame-000001", "seq-02_frame-000001"}
        for name, pose in zip(sorted(frames), [better[0], better[1], better[3]], strict=True):
            assert_same_pose(frames[name].world_from_camera, pose, 1e-7)
        # COLMAP's models have the principal point in the middle, which is half a pixel less in our count.
        assert_same_camera(frames["seq-01_frame-000000"].camera, Camera(96, 64, 526.5, 526.5, 47.5, 31.5))
        assert "has no pose" in reasons(dataset)[images[2]]


def test_ground_truth_that_is_not_there_or_malformed_is_named(tmp_path: Path) -> None:
    scene = write_chess(tmp_path)
    with pytest.raises(ValueError, match="no ground truth of chess"):
        read_dataset(scene, options=ReadOptions(ground_truth=tmp_path))
    (tmp_path / "chess.txt").write_text("seq-01/frame-000000.color.png 1 0 0 0 1 2 3\n")
    with pytest.raises(ValueError, match=r"chess\.txt:1: .*found 8 words"):
        read_dataset(scene, options=ReadOptions(ground_truth=tmp_path))


def test_twelve_scenes_takes_the_first_sequence_for_queries(tmp_path: Path) -> None:
    dataset = read_dataset(write_kitchen(tmp_path))
    assert_reads(dataset, replace(TRUTH, camera=TWELVE_CAMERA))
    assert [frame.split for frame in dataset.frames] == ["test", "train", "train", "train"]
    assert (dataset.format, dataset.name) == ("12scenes", "apt1_kitchen")
    assert dataset.frames[0].name == "frame-000000"


def test_twelve_scenes_with_pseudo_ground_truth(tmp_path: Path) -> None:
    room = write_kitchen(tmp_path)
    line = pgt_line("data/frame-000001.color.jpg", TRUTH.poses[2], 1167.8)
    (tmp_path / "apt1_kitchen_train.txt").write_text(line)
    dataset = read_dataset(room, options=ReadOptions(ground_truth=tmp_path))
    (frame,) = dataset.frames
    assert_same_pose(frame.world_from_camera, TRUTH.poses[2], 1e-7)
    assert frame.camera.focal_x_px == 1167.8
    assert len(dataset.refused) == 3


@pytest.mark.parametrize(
    ("file", "text", "message"),
    [
        ("info.txt", "m_colorWidth = 96\n", r"info\.txt: m_colorHeight is missing"),
        (
            "info.txt",
            "m_colorWidth = 96\nm_colorHeight = 64\nm_calibrationColorIntrinsic = 1 2 3\n",
            r"info\.txt: m_calibrationColorIntrinsic must be 16 numbers",
        ),
        ("split.txt", "sequence0 357\n", r"split\.txt:1: expected sequence0"),
    ],
)
def test_twelve_scenes_names_file_and_field(tmp_path: Path, file: str, text: str, message: str) -> None:
    room = write_kitchen(tmp_path)
    (room / file).write_text(text)
    with pytest.raises(ValueError, match=message):
        read_dataset(room)


def test_cambridge_has_centres_rotations_split_and_focals(tmp_path: Path) -> None:
    dataset = read_dataset(write_shop(tmp_path))
    assert dataset.refused == ()
    assert [frame.split for frame in dataset.frames] == ["train", "train", "test", "test"]
    for i, (frame, pose) in enumerate(zip(dataset.frames, TRUTH.poses, strict=True)):
        assert_same_pose(frame.world_from_camera, pose, 1e-8)
        camera = frame.camera
        assert (camera.focal_x_px, camera.focal_y_px) == (70 + i, 70 + i)
        assert (camera.principal_x_px, camera.principal_y_px) == (47.5, 31.5)
    assert dataset.frames[0].name == "seq1_frame00000"
    assert "VisualSFM" in dataset.ground_truth


def test_cambridges_distortion_undoes_visualsfms(tmp_path: Path) -> None:
    """VisualSFM's takes a seen point to an ideal one, ours an ideal one to where it is seen."""
    camera = read_dataset(write_shop(tmp_path)).frames[0].camera
    assert isinstance(camera.distortion, RadialTangential)
    ideal = np.array([[0.1, 0.2], [-0.4, 0.3], [0.5, -0.2]])
    seen = camera.distortion.distort(ideal)
    radius2 = (seen**2).sum(axis=1, keepdims=True)
    np.testing.assert_allclose(seen * (1 + NVM_K * radius2), ideal, atol=1e-4)


def test_cambridge_without_its_reconstruction_needs_intrinsics(tmp_path: Path) -> None:
    scene = write_shop(tmp_path)
    (scene / "reconstruction.nvm").unlink()
    with pytest.raises(ValueError, match=r"reconstruction\.nvm cannot be read"):
        read_dataset(scene)
    given = Intrinsics(70.0, 70.0, 47.5, 31.5)
    assert len(read_dataset(scene, options=ReadOptions(intrinsics=given)).frames) == 4


def test_cambridge_refuses_single_frames_with_their_reasons(tmp_path: Path) -> None:
    scene = write_shop(tmp_path)
    (scene / "seq2" / "frame00002.png").unlink()
    file = scene / "dataset_train.txt"
    extra = "seq1/frame00000.png 0 0 0 1 0 0 0\nseq1/other.png 1 2 3 0.5 0 0 0\n../out.png 0 0 0 1 0 0 0\n"
    write_image(scene / "seq1" / "other.png", seed=9)
    file.write_text(file.read_text() + extra)
    dataset = read_dataset(scene)
    assert len(dataset.frames) == 3
    why = [refusal.reason for refusal in dataset.refused]
    for part in ("named twice", "norm 1", "leads out", "there is no file"):
        assert sum(part in reason for reason in why) == 1, part


def test_a_reconstruction_that_is_cut_off_is_named(tmp_path: Path) -> None:
    scene = write_shop(tmp_path)
    file = scene / "reconstruction.nvm"
    file.write_text("\n".join(file.read_text().splitlines()[:5]))
    with pytest.raises(ValueError, match=r"reconstruction\.nvm:\d+: .*4 cameras are announced"):
        read_dataset(scene)
