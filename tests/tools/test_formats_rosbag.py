"""Recordings of robots: planted poses come back, and what is damaged, missing or ambiguous is named."""

import json
import sqlite3
from contextlib import suppress
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.bags import (
    BASE_FROM_CAMERA,
    EQUIDISTANT,
    PLUMB_BOB,
    Recorded,
    at,
    compressed,
    drive,
    image,
    info,
    odometry,
    pose_stamped,
    recorded_drive,
    transforms,
    write_bag,
)
from support.images import encode, textured

from mapless import Camera, RigidTransform
from mapless_tools.bags.options import BagOptions
from mapless_tools.dataset import Dataset
from mapless_tools.ingest.formats import Intrinsics, KeyframeOptions, ReadOptions, read_dataset

CAMERA = Camera(96, 64, 80.0, 81.0, 47.25, 30.75, PLUMB_BOB)
PICTURES = [textured(seed=i) for i in range(12)]
ALL = KeyframeOptions(0, 0)


def recorded(**options: Any) -> list[Recorded]:
    return recorded_drive(CAMERA, PICTURES, **options)


def without(topic: str, messages: list[Recorded]) -> list[Recorded]:
    return [it for it in messages if it[0] != topic]


def read(path: Path, keyframes: KeyframeOptions = ALL, intrinsics: Intrinsics | None = None, **bag: Any) -> Dataset:
    return read_dataset(path, options=ReadOptions(bag=BagOptions(**bag), keyframes=keyframes, intrinsics=intrinsics))


def check(dataset: Dataset, count: int = len(PICTURES), period_s: float = 0.1) -> None:
    """Every image is there with the drive's pose, to what a stamp of nanoseconds and a double allow."""
    assert len(dataset.frames) == count
    for number, frame in enumerate(dataset.frames):
        want = drive(number * period_s).compose(BASE_FROM_CAMERA)
        np.testing.assert_allclose(frame.world_from_camera.matrix(), want.matrix(), atol=1e-8)
        assert frame.camera == CAMERA
        assert frame.name.endswith(str(at(number * period_s)))


def refusal(path: Path, **options: Any) -> str:
    with pytest.raises(ValueError, match=path.name) as caught:
        read(path, **options)
    return str(caught.value)


@pytest.mark.parametrize("mcap", [True, False])
def test_a_recording_comes_back_as_folder_and_file(tmp_path: Path, mcap: bool) -> None:
    bag = write_bag(tmp_path / "bag", recorded(), mcap)
    (file,) = (it for it in bag.iterdir() if it.suffix in (".mcap", ".db3"))
    for path in (bag, file):
        dataset = read(path)
        check(dataset)
        assert (dataset.format, dataset.metric, dataset.ground_truth) == ("rosbag", True, "/odom")
    pixels = cv2.imread(str(dataset.frames[3].image_path))
    np.testing.assert_array_equal(cv2.cvtColor(np.asarray(pixels), cv2.COLOR_BGR2RGB), PICTURES[3])
    (bag / "metadata.yaml").unlink()  # the recorder was killed
    check(read(bag))


def test_poses_between_two_messages_are_on_the_arc(tmp_path: Path) -> None:
    """Odometry every 0.17 s, images every 0.1 s: positions on the line, rotations on the shortest arc."""
    messages = recorded(pose_period_s=0.17)
    messages.append(("/odom", at(1.4), odometry(at(1.4), drive(1.4))))
    check(read(write_bag(tmp_path / "bag", messages), max_pose_gap_s=0.2))


def test_poses_of_tf_through_a_moving_joint(tmp_path: Path) -> None:
    """Map > odom > base by /tf, and a head that turns on the base; the recording has odometry, too."""
    joint = BASE_FROM_CAMERA.inverse()
    messages = [it for it in recorded() if it[0] != "/tf_static"]
    still = RigidTransform.identity()
    messages.append(("/tf_static", at(0), transforms(at(0), ("map", "odom", still))))
    for time_s in np.arange(-0.05, 1.3, 0.05):
        edges = [("/odom", "/base_link", drive(time_s)), ("base_link", "head", drive(time_s))]
        edges.append(("head", "camera", drive(time_s).inverse().compose(joint.inverse())))
        messages += [("/tf", at(time_s), transforms(at(time_s), edge)) for edge in edges]
    bag = write_bag(tmp_path / "bag", sorted(messages, key=lambda it: it[1]))
    dataset = read(bag, pose_topic="/tf")
    assert "in frame map" in dataset.notes[0]
    check(dataset)
    assert "in frame odom" in read(bag, world_frame="odom").notes[0]
    assert "in frame map" in read(bag, pose_topic="/odom", world_frame="map").notes[0]
    assert "no transform leads from the camera's frame 'camera' to 'moon'" in refusal(bag, world_frame="moon")


@pytest.mark.parametrize("known", ["frame", "extrinsics"])
def test_poses_that_do_not_name_their_body(tmp_path: Path, known: str) -> None:
    topic = "/vicon/pose"
    messages = without("/odom", recorded())
    if known == "extrinsics":
        messages = without("/tf_static", messages)
    messages += [(topic, at(t), pose_stamped(at(t), "world", drive(t))) for t in np.arange(-0.05, 1.3, 0.05)]
    bag = write_bag(tmp_path / "bag", messages)
    if known == "frame":
        check(read(bag))
    else:
        assert "do not name the frame" in refusal(bag)
        check(read(bag, body_from_camera=json.dumps(BASE_FROM_CAMERA.matrix().tolist())))


def test_keyframes_are_the_sharpest_after_each_step(tmp_path: Path) -> None:
    """Two seconds at 1 m/s and 20 Hz; of the candidates after each step the one that is not blurred."""
    rng = np.random.default_rng(1)
    blurred, sharp = [], []
    for number in range(40):
        picture = textured(seed=number)
        if rng.random() < 0.4:
            sharp.append(number)
        else:
            picture = np.asarray(cv2.GaussianBlur(picture, (0, 0), 2.0), np.uint8)
        blurred.append(picture)
    bag = write_bag(tmp_path / "bag", recorded_drive(CAMERA, blurred, period_s=0.05))
    frames = read(bag, KeyframeOptions(0.4, 180)).frames
    chosen = [round((int(it.name.rpartition("_")[2]) - at(0)) / 5e7) for it in frames]
    steps = np.diff(chosen)
    assert len(chosen) == 5
    assert (steps >= 8).all()  # 0.4 m
    assert (steps <= 13).all()
    for number in chosen:
        if number not in sharp:  # then no neighbour among the candidates was
            assert not {number - 1, number + 1} <= set(sharp)
    turning = read(bag, KeyframeOptions(100.0, 10.0)).frames
    assert 5 <= len(turning) <= 6  # 0.5 rad/s for two seconds, candidates within two degrees


def test_compressed_images_stay_bit_by_bit(tmp_path: Path) -> None:
    files = [encode(".jpg" if i % 2 else ".png", it) for i, it in enumerate(PICTURES)]
    messages = [it for it in recorded() if "image" not in it[0]]
    messages += [
        ("/front/image_raw/compressed", at(i * 0.1), compressed(at(i * 0.1), it)) for i, it in enumerate(files)
    ]
    dataset = read(write_bag(tmp_path / "bag", messages))
    check(dataset)
    assert [it.image_path.read_bytes() for it in dataset.frames] == files
    assert dataset.frames[1].image_path.suffix == ".jpg"


def test_lenses_and_rectified_topics(tmp_path: Path) -> None:
    fisheye = Camera(96, 64, 50.0, 51.0, 47.5, 31.5, EQUIDISTANT)
    messages = recorded_drive(fisheye, PICTURES)
    assert {it.camera for it in read(write_bag(tmp_path / "fisheye", messages)).frames} == {fisheye}
    renamed = [(topic.replace("image_raw", "image_rect_color"), time_ns, it) for topic, time_ns, it in messages]
    found = read(write_bag(tmp_path / "rectified", renamed))
    assert {it.camera for it in found.frames} == {fisheye.pinhole()}
    d = np.array([0.2, -0.1, 0, 0, 0.01, 0.3, -0.1, 0.02])
    rational = info(fisheye, d=d, distortion_model="rational_polynomial")
    changed = [(topic, t, rational if topic.endswith("info") else it) for topic, t, it in messages]
    found = read(write_bag(tmp_path / "rational", changed))
    assert "undistorted to a pinhole" in found.notes[-1]
    assert all(it.camera.distortion is None and it.camera.focal_x_px != 50.0 for it in found.frames)


def test_a_gap_of_poses_refuses_the_images_in_it_together(tmp_path: Path) -> None:
    messages = [it for it in recorded() if not (it[0] == "/odom" and at(0.31) < it[1] < at(0.79))]
    dataset = read(write_bag(tmp_path / "bag", messages))
    assert len(dataset.frames) == 12 - 4
    (gap,) = dataset.refused
    assert gap.frame == "images 5 to 8, 0.400 to 0.700 s after the first"
    assert "none within 150 ms" in gap.reason


def shifted(messages: list[Recorded], topic: str, since_s: float, by_s: float) -> list[Recorded]:
    """Stamps of a topic from a time on are others; the recorder's times stay."""
    for name, time_ns, message in messages:
        if name == topic and time_ns >= at(since_s):
            moved = time_ns + round(by_s * 1e9)
            message.header.stamp.sec, message.header.stamp.nanosec = divmod(moved, 1_000_000_000)
    return messages


@pytest.mark.parametrize("topic", ["/odom", "/front/image_raw"])
def test_time_that_jumps_back_is_named(tmp_path: Path, topic: str) -> None:
    text = refusal(write_bag(tmp_path / "bag", shifted(recorded(), topic, 0.8, -5.0)))
    assert topic in text
    assert "time jumps back by 4.9" in text
    assert "recorded at 1700000000.9" in text or "recorded at 1700000001" in text


def test_time_that_jumps_ahead_refuses_what_has_no_pose(tmp_path: Path) -> None:
    dataset = read(write_bag(tmp_path / "bag", shifted(recorded(), "/front/image_raw", 0.8, 60.0)))
    assert len(dataset.frames) == 8
    assert "images 9 to 12" in dataset.refused[0].frame
    assert "outside those of the poses" in dataset.refused[0].reason


def test_an_unknown_encoding_is_named_with_its_image(tmp_path: Path) -> None:
    messages = recorded()
    odd = [i for i, it in enumerate(messages) if it[0].endswith("image_raw")][4]
    messages[odd][2].encoding = "bayer_rgbw8"
    dataset = read(write_bag(tmp_path / "some", messages))
    (refused,) = dataset.refused
    assert refused.frame == "/front/image_raw at 0.400 s"
    assert "'bayer_rgbw8' is none of 8UC1" in refused.reason
    for _, _, message in messages:
        if hasattr(message, "encoding"):
            message.encoding = "yuv444"
    with pytest.raises(ValueError, match="none of 12 frames can be used; the first, /front/image_raw at"):
        read(write_bag(tmp_path / "all", messages))


def test_no_camera_info_takes_given_intrinsics(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", without("/front/camera_info", recorded()))
    assert "has no CameraInfo for the images of /front/image_raw; give --intrinsics" in refusal(bag)
    frames = read(bag, intrinsics=Intrinsics(80.0, 81.0, 47.0, 31.0)).frames
    assert {it.camera for it in frames} == {Camera(96, 64, 80.0, 81.0, 47.0, 31.0)}


def test_topics_that_are_ambiguous_or_absent_are_listed(tmp_path: Path) -> None:
    messages = recorded()
    second = [("/back/image_raw", at(0.1), image(at(0.1), PICTURES[0], "rgb8"))]
    depth = [("/depth/image", at(0.1), image(at(0.1), np.zeros((64, 96), "<u2"), "16UC1"))]
    check(read(write_bag(tmp_path / "depth", messages + depth)))
    bag = write_bag(tmp_path / "two", messages + second)
    assert "images on /back/image_raw, /front/image_raw: choose with --image-topic" in refusal(bag)
    check(read(bag, image_topic="/front/image_raw"))
    assert "no images on '/left', but on /back/image_raw" in refusal(bag, image_topic="/left")
    assert "no CameraInfo on '/x', but on /front/camera_info" in refusal(
        bag, image_topic="/back/image_raw", camera_topic="/x"
    )
    assert "no poses on '/x', but on /odom" in refusal(bag, image_topic="/front/image_raw", pose_topic="/x")
    assert "no poses" in refusal(write_bag(tmp_path / "still", without("/odom", messages)))
    assert "no topic of images" in refusal(write_bag(tmp_path / "blind", without("/front/image_raw", messages)))
    apart = [(f"/a{topic}" if "info" in topic else topic, *rest) for topic, *rest in messages]
    apart += [("/b/camera_info", at(0), info(CAMERA))]
    text = refusal(write_bag(tmp_path / "apart", apart))
    assert "CameraInfo on /a/front/camera_info, /b/camera_info, none beside /front/image_raw" in text


def test_frames_that_lead_nowhere_are_named(tmp_path: Path) -> None:
    messages = without("/tf_static", recorded())
    bag = write_bag(tmp_path / "bag", messages)
    assert "no transform leads from the camera's frame 'camera' to 'base_link', whose poses /odom has" in refusal(bag)
    check(read(bag, body_from_camera=json.dumps(BASE_FROM_CAMERA.matrix().tolist())))
    two = [("/tf_static", at(0), transforms(at(0), (it, "camera", BASE_FROM_CAMERA))) for it in ("base_link", "arm")]
    assert "a frame has one parent" in refusal(write_bag(tmp_path / "two", messages + two))
    joints = [("/tf", at(0.1), transforms(at(0.1), (it, "wheel", BASE_FROM_CAMERA))) for it in ("left", "right")]
    check(read(write_bag(tmp_path / "joints", recorded() + joints)))  # nothing to do with the camera


@pytest.mark.parametrize(
    ("wrong", "says"),
    [
        ("lens", "/front/camera_info: a lens 'double_sphere'"),
        ("uncalibrated", "/front/camera_info: the camera is not calibrated"),
        ("frame", "message 9 of /odom, recorded at 1700000000.473456789 s: is of lab > base_link"),
        ("quaternions", "/odom holds no pose; 27 of 27 messages of /odom cannot be used and are skipped, the first: "),
    ],
)
def test_messages_that_contradict_are_named(tmp_path: Path, wrong: str, says: str) -> None:
    messages = recorded()
    poses = [it for topic, _, it in messages if topic == "/odom"]
    if wrong == "frame":
        poses[8].header.frame_id = "lab"
    for pose in poses if wrong == "quaternions" else ():
        pose.pose.pose.orientation.w = 7.0
    for it in (it for topic, _, it in messages if topic.endswith("info")):
        it.distortion_model = "double_sphere" if wrong == "lens" else it.distortion_model
        it.k = np.zeros(9) if wrong == "uncalibrated" else it.k
    assert says in refusal(write_bag(tmp_path / "bag", messages))


@pytest.mark.parametrize("wrong", ["null", "nan", "infinite", "stamp", "norm"])
@pytest.mark.parametrize("topic", ["/odom", "/tf"])
def test_images_beside_bad_poses_are_refused_alone(tmp_path: Path, wrong: str, topic: str) -> None:
    messages = recorded()
    if topic == "/tf":
        poses = [(t, drive((t - at(0)) / 1e9)) for name, t, _ in messages if name == "/odom"]
        edges = [(topic, t, transforms(t, ("odom", "base_link", pose))) for t, pose in poses]
        messages = sorted(without("/odom", messages) + edges, key=lambda it: it[1])
    for _, time_ns, it in messages:
        if time_ns == at(0.5) and hasattr(it, "child_frame_id"):
            spoil(it.header, it.pose.pose.position, it.pose.pose.orientation, wrong)
        if time_ns == at(0.5) and hasattr(it, "transforms"):
            (edge,) = it.transforms
            spoil(edge.header, edge.transform.translation, edge.transform.rotation, wrong)
    dataset = read(write_bag(tmp_path / "bag", messages))
    (refused,) = dataset.refused
    assert refused.frame == "images 6 to 6, 0.500 to 0.500 s after the first"
    assert "tracking was lost at that time" in refused.reason
    assert len(dataset.frames) == len(PICTURES) - 1
    (note,) = [it for it in dataset.notes if "skipped" in it]
    assert note.startswith(f"1 of 27 messages of {topic} cannot be used and are skipped, the first: message 12 of")


def spoil(header: Any, position: Any, rotation: Any, wrong: str) -> None:
    """Makes a pose one of those that trackers write while they are lost."""
    if wrong == "null":
        rotation.x = rotation.y = rotation.z = rotation.w = 0.0
    elif wrong == "norm":
        rotation.w = 7.0
    elif wrong == "stamp":
        header.stamp.sec = header.stamp.nanosec = 0
    else:
        position.x = np.nan if wrong == "nan" else np.inf


def test_odometry_that_begins_with_null_poses_is_read(tmp_path: Path) -> None:
    messages = recorded()
    for topic, time_ns, it in messages:
        if topic == "/odom" and time_ns < at(0.32):
            it.pose.pose.orientation.w = it.pose.pose.orientation.z = 0.0
    dataset = read(write_bag(tmp_path / "bag", messages))
    assert len(dataset.frames) == len(PICTURES) - 4
    assert "outside those of the poses" in dataset.refused[0].reason


def test_truncated_messages_among_good_ones_are_counted(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / "bag", recorded(), mcap=False)
    (file,) = bag.glob("*.db3")
    with sqlite3.connect(file) as database:
        ids = dict(database.execute("SELECT name, id FROM topics"))
        for topic, number in (("/odom", 11), ("/front/image_raw", 3), ("/front/camera_info", 0)):
            query = f"SELECT id, data FROM messages WHERE topic_id = {ids[topic]} ORDER BY timestamp"
            row, data = list(database.execute(query))[number]
            database.execute("UPDATE messages SET data = ? WHERE id = ?", (data[: len(data) // 3], row))
    dataset = read(bag)
    assert len(dataset.frames) == len(PICTURES) - 2
    assert sum("1 of " in note and "damaged" in note for note in dataset.notes) == 3


def test_each_image_has_the_camera_info_of_its_time(tmp_path: Path) -> None:
    messages = recorded()
    infos = [it for topic, _, it in messages if topic.endswith("info")]
    for i, it in enumerate(infos):
        it.k = it.k.copy()
        it.k[0] = 80.0 + i
    infos[0].k[:] = 0.0  # not initialized
    dataset = read(write_bag(tmp_path / "bag", messages))
    assert [it.camera.focal_x_px for it in dataset.frames] == [81.0, *(80.0 + i for i in range(1, len(PICTURES)))]
    assert any(note.startswith("1 of 12 messages of /front/camera_info cannot be used") for note in dataset.notes)


def test_given_intrinsics_make_camera_info_irrelevant(tmp_path: Path) -> None:
    messages = recorded()
    for topic, _, it in messages:
        if topic.endswith("info"):
            it.distortion_model, it.k = "double_sphere", np.zeros(9)
    frames = read(write_bag(tmp_path / "bag", messages), intrinsics=Intrinsics(80.0, 81.0, 47.0, 31.0)).frames
    assert {it.camera for it in frames} == {Camera(96, 64, 80.0, 81.0, 47.0, 31.0)}


@pytest.mark.parametrize(
    ("name", "given", "pinhole"),
    [
        ("/front/image_undistorted", None, True),
        ("/front/image_undistorted", False, False),
        ("/front/image_raw", None, False),
        ("/front/image_raw", True, True),
    ],
)
def test_the_name_or_the_flag_says_what_is_rectified(
    tmp_path: Path, name: str, given: bool | None, pinhole: bool
) -> None:
    camera = Camera(96, 64, 50.0, 51.0, 47.5, 31.5, PLUMB_BOB)
    named = [(it[0].replace("/front/image_raw", name), *it[1:]) for it in recorded_drive(camera, PICTURES)]
    dataset = read(write_bag(tmp_path / "bag", named), rectified=given)
    assert {it.camera for it in dataset.frames} == {camera.pinhole() if pinhole else camera}
    (line,) = [it for it in dataset.notes if it.startswith("the camera is")]
    assert line.startswith(f"the camera is {'P' if pinhole else 'K and D'} of /front/camera_info, ")
    assert (name if given is None else "rectified says") in line


def test_damaged_images_are_no_keyframes(tmp_path: Path) -> None:
    messages = recorded()
    odd = next(i for i, it in enumerate(messages) if it[0].endswith("image_raw"))
    messages[odd][2].encoding = "bayer_rgbw8"
    dataset = read(write_bag(tmp_path / "bag", messages), KeyframeOptions(0.01, 1.0))
    assert len(dataset.frames) > 2
    assert dataset.refused[0].frame == "/front/image_raw at 0.000 s"


@pytest.mark.parametrize("mcap", [True, False])
def test_truncated_and_damaged_files_are_named(tmp_path: Path, mcap: bool) -> None:
    """Cut anywhere, or with bytes overwritten: a dataset that is right, or an error that names the file."""
    bag = write_bag(tmp_path / "bag", recorded(), mcap)
    (file,) = (it for it in bag.iterdir() if it.suffix in (".mcap", ".db3"))
    whole = file.read_bytes()
    for share in (0, 0.001, 0.3, 0.6, 0.9, 0.9999):
        file.write_bytes(whole[: int(share * len(whole))])
        text = refusal(bag)
        assert "bag" in text
        assert "cannot be read" in text or "damaged" in text
        assert "truncated" in text or share < 0.01
    random = np.random.default_rng(5)
    for _ in range(10):
        damaged = bytearray(whole)
        start = int(random.integers(len(whole) - 200))
        damaged[start : start + 200] = random.bytes(200)
        file.write_bytes(damaged)
        with suppress(ValueError):  # and no other error
            assert len(read(bag).frames) <= len(PICTURES)


def test_what_is_no_recording_is_said(tmp_path: Path) -> None:
    (tmp_path / "notes.mcap").write_text("no recording")
    with pytest.raises(ValueError, match=r"notes\.mcap cannot be read"):
        read(tmp_path / "notes.mcap")
    (tmp_path / "notes.txt").write_text("no recording")
    with pytest.raises(ValueError, match=r"not a folder, nor a recording \(\.mcap, \.db3\)"):
        read(tmp_path / "notes.txt")
