"""Depth topics of recordings: aligned, beside the camera, compressed, and those that cannot be used."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from support.bags import BASE_FROM_CAMERA, at, compressed, image, info, recorded_drive, transforms, write_bag
from support.depth_layouts import BESIDE
from support.depths import assert_planted, planted_depth_m, png
from support.images import textured
from support.layouts import CAMERA

from mapless import Camera, RigidTransform
from mapless.depth import DepthSensor
from mapless_tools.dataset import Dataset
from mapless_tools.ingest.depth_options import DepthOptions
from mapless_tools.ingest.formats import KeyframeOptions, ReadOptions, read_dataset

PICTURES = [textured(seed=i) for i in range(3)]
ALIGNED, BESIDE_TOPIC = "/front/aligned_depth/image_raw", "/depth/image_rect"
RAW = Camera(64, 48, 57.2, 57.5, 31.5, 23.5)


def with_hole(depth: np.ndarray) -> np.ndarray:
    depth = depth.copy()
    depth[0, 0] = 0
    return depth


def millimetres(depth: np.ndarray) -> np.ndarray:
    return np.asarray(np.rint(1000 * with_hole(depth)), np.uint16)


DEPTH_M = planted_depth_m(CAMERA)
KINDS = {
    "16UC1": lambda t, frame: image(t, millimetres(DEPTH_M), "16UC1", frame, padding=6),
    "big-endian": lambda t, frame: image(t, millimetres(DEPTH_M).astype(">u2"), "16UC1", frame),
    "32FC1": lambda t, frame: image(t, with_hole(DEPTH_M).astype(np.float32), "32FC1", frame),
    "compressedDepth": lambda t, frame: compressed(
        t, struct.pack("<iff", 0, 0, 0) + png(millimetres(DEPTH_M)), "16UC1; compressedDepth png", frame
    ),
    "quantized": lambda t, frame: compressed(t, quantized(), "32FC1; compressedDepth", frame),
}


def quantized() -> bytes:
    """Inverse depths in steps, by compressed_depth_image_transport's defaults: quantization 100, at most 10 m."""
    first = 100.0 * 101.0
    second = 1 - first / 10
    steps = np.rint(first / DEPTH_M + second)
    steps[0, 0] = 0
    return struct.pack("<iff", 1, first, second) + png(steps.astype(np.uint16))


def recorded(*depths: tuple[str, float, Any]) -> list[Any]:
    messages = recorded_drive(CAMERA, PICTURES)
    messages += [(topic, at(time_s), message) for topic, time_s, message in depths]
    return sorted(messages, key=lambda it: it[1])


def read(path: Path, **depths: Any) -> Dataset:
    return read_dataset(path, options=ReadOptions(depths=DepthOptions(**depths), keyframes=KeyframeOptions(0, 0)))


@pytest.mark.parametrize("kind", KINDS)
def test_an_aligned_depth_is_that_of_the_image(tmp_path: Path, kind: str) -> None:
    depths = [(ALIGNED, it, KINDS[kind](at(it), "camera")) for it in (0.004, 0.12)]
    first, second, third = read(write_bag(tmp_path / "bag", recorded(*depths))).frames
    assert_planted(first, 0.002)
    assert_planted(second, 0.002)
    assert third.depth is None


def test_the_nearest_in_time_is_taken_and_none_after_20_ms(tmp_path: Path) -> None:
    def flat(time_s: float, depth_mm: int) -> tuple[str, float, Any]:
        return ALIGNED, time_s, image(at(time_s), np.full((64, 96), depth_mm, np.uint16), "16UC1")

    depths = [flat(-0.015, 3000), flat(0.005, 1500), flat(0.011, 3000), flat(0.125, 1000), flat(0.175, 1000)]
    first, second, third = read(write_bag(tmp_path / "bag", recorded(*depths))).frames
    assert (second.depth, third.depth) == (None, None)
    assert first.depth is not None
    values = cv2.imdecode(np.frombuffer(first.depth.read().data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert values is not None
    assert (values == 1500).all()


def beside(frame: str = "depth_optical", *extra: Any) -> list[Any]:
    """The depth of another camera, whose CameraInfo is beside it."""
    depth = millimetres(planted_depth_m(RAW, BESIDE))
    camera = ("/depth/camera_info", 0.0, info(RAW, at(0)))
    return recorded((BESIDE_TOPIC, 0.0, image(at(0), depth, "16UC1", frame)), camera, *extra)


def test_a_depth_camera_beside_it_is_placed_by_static_tf(tmp_path: Path) -> None:
    edges = [("mount", "depth_optical", BASE_FROM_CAMERA.compose(BESIDE))]
    tf = ("/tf_static", 0.0, transforms(at(0), *edges))
    frame = read(write_bag(tmp_path / "bag", beside("depth_optical", tf))).frames[0]
    assert_planted(frame)
    assert frame.depth is not None
    assert frame.depth.camera_from_depth_camera is not None
    np.testing.assert_allclose(frame.depth.camera_from_depth_camera.matrix(), BESIDE.matrix(), atol=1e-9)


def test_a_depth_of_a_frame_that_nothing_connects_is_left_out(tmp_path: Path) -> None:
    dataset = read(write_bag(tmp_path / "bag", beside("elsewhere")))
    assert [it.depth for it in dataset.frames] == [None, None, None]
    assert any("nothing connects frame 'elsewhere'" in note for note in dataset.notes)


def test_a_depth_of_another_frame_without_a_camera_is_left_out(tmp_path: Path) -> None:
    tf = ("/tf_static", 0.0, transforms(at(0), ("mount", "depth_optical", RigidTransform.identity())))
    messages = [it for it in beside("depth_optical", tf) if it[0] != "/depth/camera_info"]
    dataset = read(write_bag(tmp_path / "bag", messages))
    assert dataset.frames[0].depth is None
    assert any("no camera_info" in note for note in dataset.notes)


def test_of_two_topics_the_aligned_one_is_taken_or_the_named(tmp_path: Path) -> None:
    edges = [("mount", "depth_optical", BASE_FROM_CAMERA.compose(BESIDE))]
    tf = ("/tf_static", 0.0, transforms(at(0), *edges))
    aligned = (ALIGNED, 0.0, KINDS["32FC1"](at(0), "camera"))
    bag = write_bag(tmp_path / "bag", beside("depth_optical", tf, aligned))
    by_default, named = read(bag).frames[0], read(bag, depth_topic=BESIDE_TOPIC, depth_sensor="stereo").frames[0]
    assert_planted(by_default)
    assert_planted(named)
    assert by_default.depth is not None
    assert named.depth is not None
    assert (by_default.depth.unit_m, named.depth.unit_m, named.depth.sensor) == (1.0, 0.001, DepthSensor.STEREO)


def test_several_aligned_topics_are_a_choice(tmp_path: Path) -> None:
    depths = [(topic, 0.0, KINDS["16UC1"](at(0), "camera")) for topic in (ALIGNED, "/other/depth")]
    dataset = read(write_bag(tmp_path / "bag", recorded(*depths)))
    assert dataset.frames[0].depth is None
    assert any(f"{ALIGNED}, /other/depth: choose with --depth-topic" in note for note in dataset.notes)


@pytest.mark.parametrize(
    ("message", "said"),
    [
        (lambda: compressed(at(0), b"short", "16UC1; compressedDepth", "camera"), "fewer than its header"),
        (lambda: compressed(at(0), bytes(40), "16UC1; compressedDepth rvl", "camera"), "rvl' is not read"),
        (lambda: image(at(0), np.ones((60, 60), np.uint16), "16UC1"), "another aspect"),
        (lambda: image(at(0), np.full((64, 96), np.nan, np.float32), "32FC1"), "no pixel"),
        (lambda: image(at(0), np.full((64, 96), -1, np.float32), "32FC1"), "below 0"),
    ],
)
def test_unusable_depth_messages_are_left_out_with_a_note(tmp_path: Path, message: Any, said: str) -> None:
    dataset = read(write_bag(tmp_path / "bag", recorded((ALIGNED, 0.0, message()))))
    assert len(dataset.frames) == 3
    assert dataset.frames[0].depth is None
    assert any(said in note for note in dataset.notes)


def test_no_depth_reads_no_topic_of_depths(tmp_path: Path) -> None:
    dataset = read(write_bag(tmp_path / "bag", beside("elsewhere")), no_depth=True)
    assert not any("depth" in note for note in dataset.notes)
