"""Depth messages of ROS: their values, cameras and times; what cannot be used is named, and left out."""

import struct
import threading
from types import SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from support.bags import BASE_FROM_CAMERA, at, compressed, image, info
from support.depths import png
from support.images import textured
from support.servers import CAMERA

from mapless import Camera, DepthSensor, Rejected, RigidTransform
from mapless.ros import Depths, Localizer, LocalizerOptions, RosCamera, RosDepth, camera_from_info
from mapless.ros.depths import depth_image, depth_values

MILLIMETRES = np.random.default_rng(3).integers(400, 6000, (64, 96)).astype(np.uint16)
METRES = (MILLIMETRES / np.float32(1000)).astype(np.float32)
QUARTER = Camera(48, 32, 39.0, 39.5, 23.4, 15.6)
BESIDE = RigidTransform(np.eye(3), np.array([-0.02, 0.0, 0.0]))


def by_transport(encoding: str, values: np.ndarray, first: float = 0.0, second: float = 0.0) -> Any:
    """As image_transport's compressedDepth has it."""
    return compressed(at(1), struct.pack("<iff", 0, first, second) + png(values), f"{encoding}; compressedDepth png")


def quantized(depth_m: np.ndarray) -> tuple[np.ndarray, float, float]:
    """Inverse depths as that plugin quantizes them, with its defaults, and their two numbers."""
    first = 100.0 * 101.0
    second = 1 - first / 10.0
    return (first / depth_m + second).astype(np.uint16), first, second


class TestValues:
    @pytest.mark.parametrize("order", ["<", ">"])
    @pytest.mark.parametrize("padding", [0, 6])
    def test_rows_of_both_orders_are_read(self, order: str, padding: int) -> None:
        deep = image(at(1), MILLIMETRES.astype(f"{order}u2"), "16UC1", padding=padding)
        np.testing.assert_array_equal(depth_values(deep), MILLIMETRES)
        floats = image(at(1), METRES.astype(f"{order}f4"), "32FC1", padding=padding)
        np.testing.assert_array_equal(depth_values(floats), METRES)

    def test_compressed_depth_is_what_was_compressed(self) -> None:
        np.testing.assert_array_equal(depth_values(by_transport("16UC1", MILLIMETRES)), MILLIMETRES)
        np.testing.assert_array_equal(depth_values(compressed(at(1), png(MILLIMETRES), "16UC1; png")), MILLIMETRES)
        values, first, second = quantized(METRES)
        found = depth_values(by_transport("32FC1", np.where(MILLIMETRES > 5900, 0, values), first, second))
        np.testing.assert_allclose(found[MILLIMETRES <= 5900], METRES[MILLIMETRES <= 5900], rtol=0.002)
        assert not found[MILLIMETRES > 5900].any()

    @pytest.mark.parametrize(
        ("message", "error"),
        [
            (image(at(1), textured(), "rgb8"), "'rgb8' is none of a depth"),
            (image(at(1), MILLIMETRES, "64FC1"), "'64FC1' is none"),
            (compressed(at(1), b"\0" * 40, "16UC1; compressedDepth rvl"), "rvl' is not read"),
            (compressed(at(1), b"\0" * 4, "16UC1; compressedDepth png"), "fewer than its header"),
            (compressed(at(1), png(textured()), "bgr8; png compressed"), "is not read"),
            (compressed(at(1), png(textured()), "16UC1; png compressed"), "no PNG with one channel of 16 bits"),
            (compressed(at(1), png(MILLIMETRES)[:60], "16UC1; png compressed"), "no PNG with one channel"),
        ],
    )
    def test_what_is_no_depth_is_named(self, message: Any, error: str) -> None:
        with pytest.raises(ValueError, match=error):
            depth_values(message)

    def test_too_few_bytes_are_named(self) -> None:
        short = image(at(1), MILLIMETRES, "16UC1")
        short.data = short.data[:-1]
        with pytest.raises(ValueError, match="cannot have 12287 bytes"):
            depth_values(short)

    def test_millimetres_are_sent_as_they_are(self) -> None:
        found = depth_image(MILLIMETRES, DepthSensor.STEREO)
        assert (found.unit_m, found.size, found.sensor) == (0.001, None, DepthSensor.STEREO)
        decoded = cv2.imdecode(np.frombuffer(found.data, np.uint8), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(decoded, MILLIMETRES)


def deep(time_s: float = 1.0, frame: str = "camera", values: np.ndarray = MILLIMETRES) -> Any:
    return image(at(time_s), np.ascontiguousarray(values), "16UC1", frame)


class TestCamera:
    def test_aligned_depth_has_the_photographs_camera(self) -> None:
        for values in (MILLIMETRES, MILLIMETRES[::2, ::2]):
            found = RosDepth(deep(values=values)).image(RosCamera(CAMERA), None)
            assert (found.camera, found.camera_from_depth_camera) == (None, None)
        assert RosDepth(deep(), RosCamera(CAMERA)).image(RosCamera(CAMERA), None).camera is None

    def test_another_camera_is_sent_with_its_pose(self) -> None:
        depth = RosDepth(deep(frame="depth", values=MILLIMETRES[::2, ::2]), RosCamera(QUARTER))
        found = depth.image(RosCamera(CAMERA), BESIDE)
        assert (found.camera, found.camera_from_depth_camera) == (QUARTER, BESIDE)

    @pytest.mark.parametrize(
        ("camera", "pose", "values", "error"),
        [
            (QUARTER, BESIDE, MILLIMETRES, "the depth has 96 x 64 pixels, its CameraInfo 48 x 32"),
            (None, BESIDE, MILLIMETRES, "of another frame, depth, and no camera_info"),
            (None, None, MILLIMETRES[:, ::2], "48 x 64 pixels, another aspect than the image's 96 x 64"),
        ],
    )
    def test_what_does_not_fit_is_named(
        self, camera: Camera | None, pose: RigidTransform | None, values: np.ndarray, error: str
    ) -> None:
        depth = RosDepth(deep(frame="depth", values=values), None if camera is None else RosCamera(camera))
        with pytest.raises(ValueError, match=error):
            depth.image(RosCamera(CAMERA), pose)

    def test_depth_is_undistorted_with_its_image(self) -> None:
        """Where the lens is none of mapless's, the pixels of both move alike."""
        lens = np.array([0.1, -0.05, 0.001, 0.0, 0.02, 0.3, -0.1, 0.05])
        camera = camera_from_info(info(CAMERA, distortion_model="rational_polynomial", d=lens))
        assert camera.undistortion is not None
        smooth = np.tile(np.arange(1000, 1960, 10, dtype=np.uint16), (64, 1))
        found = RosDepth(deep(values=smooth)).image(camera, None)
        moved = cv2.imdecode(np.frombuffer(found.data, np.uint8), cv2.IMREAD_UNCHANGED)
        exact = cv2.remap(smooth.astype(np.float32), *camera.undistortion, cv2.INTER_LINEAR)
        assert np.abs(np.asarray(moved, float) - exact)[2:-2, 2:-2].max() <= 6
        with pytest.raises(ValueError, match="undistorted, so the depth needs its size"):
            RosDepth(deep(values=smooth[::2, ::2])).image(camera, None)


class TestTimes:
    def test_the_nearest_in_time_is_taken(self) -> None:
        depths = Depths(wait_s=0.0)
        for time_s in (1.0, 1.1, 1.2):
            depths.add(deep(time_s))
        assert depths.at(at(1.11)).message.header.stamp.nanosec == deep(1.1).header.stamp.nanosec

    @pytest.mark.parametrize(("time_s", "error"), [(1.34, "140 ms older than the image"), (0.9, "100 ms newer")])
    def test_one_that_is_too_far_away_is_none(self, time_s: float, error: str) -> None:
        depths = Depths(wait_s=0.0)
        with pytest.raises(LookupError, match="no depth has come yet"):
            depths.at(at(1.0))
        for each in (1.0, 1.2):
            depths.add(deep(each))
        with pytest.raises(LookupError, match=error):
            depths.at(at(time_s))

    def test_one_that_comes_after_the_image_is_awaited(self) -> None:
        depths = Depths(wait_s=5.0)
        timer = threading.Timer(0.05, depths.add, [deep(1.0)])
        timer.start()
        assert depths.at(at(1.0)).frame == "camera"
        timer.join()

    def test_an_impossible_tolerance_is_named(self) -> None:
        with pytest.raises(ValueError, match="depth_tolerance must be 0 to 1 s"):
            Depths(tolerance_s=-0.1)


class Client:
    """Rejects every photograph, and keeps the depths that it was given."""

    def __init__(self) -> None:
        self.depths: list[Any] = []

    def localize(self, *_: Any, depth: Any, **__: Any) -> Any:
        self.depths.append(depth)
        about = SimpleNamespace(
            request_id="r",
            total_s=0.2,
            queue_s=0.0,
            references=(),
            depth_check=None,
            searched_scene_count=1,
            adoption="",
        )
        return Rejected("LOW_OVERLAP", "3 matches", about)  # type: ignore[arg-type]


def lookup(target: str, source: str, stamp_ns: int) -> RigidTransform:
    poses = {("base_link", "camera"): BASE_FROM_CAMERA, ("camera", "depth"): BESIDE}
    if (target, source) not in poses:
        raise LookupError(f"no {target} > {source}")
    return poses[target, source]


def test_a_photograph_without_usable_depth_is_localized_alone() -> None:
    client: Any = Client()
    localizer = Localizer(client, LocalizerOptions("hall", odom_frame=""), lookup)
    depths = Depths(wait_s=0.0)
    depths.add_camera(info(QUARTER))
    photo = image(at(1.0), textured(), "rgb8", "camera")

    def said(message: Any) -> str:
        depths.add(message)
        return localizer.localize(photo, RosCamera(CAMERA), depths.at).values["depth"]

    assert said(deep(frame="depth", values=MILLIMETRES[::2, ::2])) == "sent"
    assert client.depths[-1].camera_from_depth_camera is BESIDE
    for wrong, why in (
        (deep(frame="elsewhere"), "none: no camera > elsewhere"),
        (deep(frame="depth"), "none: the depth has 96 x 64 pixels, its CameraInfo 48 x 32"),
        (image(at(1.0), METRES.astype(np.float64), "64FC1", "depth"), "none: encoding '64FC1' is none of a depth"),
    ):
        depths = Depths(wait_s=0.0)
        depths.add_camera(info(QUARTER))
        assert said(wrong).startswith(why)
        assert client.depths[-1] is None
    assert "depth" not in localizer.localize(photo, RosCamera(CAMERA)).values
