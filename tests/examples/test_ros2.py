"""The ROS example without ROS: objects with the fields of messages, and the node on a stand-in for rclpy."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Callable
from datetime import datetime, timezone
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import cv2
import numpy as np
import pytest
from support.images import textured
from support.servers import CAMERA, PHOTO, make_scene, pose, serving
from support.waiting import wait_until

from mapless import Client, Fisheye, RadialTangential, RigidTransform
from mapless.geometry import rotation_from_vector

IDENTITY = RigidTransform(np.eye(3), np.zeros(3))


@pytest.fixture
def messages() -> Any:
    return importlib.import_module("ros2_messages")


def image(pixels: np.ndarray, encoding: str, padding: int = 0) -> SimpleNamespace:
    """A sensor_msgs/Image; each row is followed by so many bytes that belong to nothing."""
    height, width = pixels.shape[:2]
    rows = pixels.reshape(height, -1)
    data = np.concatenate([rows, np.full((height, padding), 77, np.uint8)], axis=1)
    return SimpleNamespace(height=height, width=width, encoding=encoding, step=data.shape[1], data=data.tobytes())


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("encoding", ["bgr8", "rgb8", "bgra8", "rgba8", "mono8"])
def test_every_encoding_is_the_same_photograph(messages: Any, encoding: str, padding: int) -> None:
    bgr = cv2.GaussianBlur(textured(), (0, 0), 3.0)  # which JPEG keeps
    conversions = {"rgb8": cv2.COLOR_BGR2RGB, "bgra8": cv2.COLOR_BGR2BGRA, "rgba8": cv2.COLOR_BGR2RGBA}
    conversions["mono8"] = cv2.COLOR_BGR2GRAY
    sent = cv2.cvtColor(bgr, conversions[encoding]) if encoding in conversions else bgr
    photo = messages.photo_from_image(image(np.asarray(sent, np.uint8), encoding, padding))
    read = cv2.imdecode(np.frombuffer(photo, np.uint8), cv2.IMREAD_COLOR)
    expected = cv2.cvtColor(sent, cv2.COLOR_GRAY2BGR) if encoding == "mono8" else bgr
    assert np.abs(np.asarray(read, float) - expected).mean() < 4


def test_a_compressed_image_is_sent_as_it_is(messages: Any) -> None:
    assert messages.photo_from_image(SimpleNamespace(format="jpeg", data=[1, 2, 255])) == b"\x01\x02\xff"


@pytest.mark.parametrize(
    "wrong", [{"encoding": "yuv422"}, {"step": 10}, {"height": 65}], ids=["encoding", "step", "height"]
)
def test_an_image_that_is_none_is_refused(messages: Any, wrong: dict[str, Any]) -> None:
    message = image(textured(), "bgr8")
    vars(message).update(wrong)
    with pytest.raises(ValueError, match=r"yuv422|bytes"):
        messages.photo_from_image(message)


def info(**given: Any) -> SimpleNamespace:
    roi = SimpleNamespace(width=0, height=0)
    k = [80.0, 0.0, 47.5, 0.0, 81.0, 31.5, 0.0, 0.0, 1.0]
    defaults = {"width": 96, "height": 64, "k": k, "d": [], "distortion_model": "plumb_bob", "binning_x": 0, "roi": roi}
    return SimpleNamespace(**(defaults | {"binning_y": 0} | given))


def test_cameras(messages: Any) -> None:
    assert messages.camera_from_info(info()) == CAMERA
    five = messages.camera_from_info(info(d=[0.1, 0.2, 0.3, 0.4, 0.5]))
    assert five.distortion == RadialTangential(k1=0.1, k2=0.2, p1=0.3, p2=0.4, k3=0.5)
    eight = info(d=[0.1, 0.2, 0.3, 0.4, 0.5, 0.0, 0.0, 0.0], distortion_model="rational_polynomial")
    assert messages.camera_from_info(eight) == five
    fisheye = messages.camera_from_info(info(d=[0.1, 0.2, 0.3, 0.4], distortion_model="equidistant"))
    assert fisheye.distortion == Fisheye(0.1, 0.2, 0.3, 0.4)


@pytest.mark.parametrize(
    "wrong",
    [
        {"k": [0.0] * 9},
        {"binning_x": 2},
        {"roi": SimpleNamespace(width=48, height=32)},
        {"d": [0.1] * 8, "distortion_model": "rational_polynomial"},
        {"d": [0.1] * 4},
    ],
)
def test_a_camera_that_would_be_guessed_is_refused(messages: Any, wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"calibrated|binned|lens"):
        messages.camera_from_info(info(**wrong))


def test_a_stamp_keeps_its_microseconds(messages: Any) -> None:
    stamp = SimpleNamespace(sec=1_800_000_000, nanosec=123_456_789)
    assert messages.time_from_stamp(stamp) == datetime(2027, 1, 15, 8, 0, 0, 123456, timezone.utc)


def answer(world_from_camera: RigidTransform, covariance: np.ndarray | None) -> Any:
    return SimpleNamespace(world_from_camera=world_from_camera, covariance=covariance)


def test_a_camera_that_looks_along_the_maps_x_is_the_identity(messages: Any) -> None:
    """REP 103: forward is x. OpenCV's optical axis is z, its x the map's -y, its y the map's -z."""
    optical = RigidTransform(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([1.0, 2.0, 3.0]))
    found, _ = messages.body_pose(answer(optical, None), IDENTITY)
    np.testing.assert_allclose(
        found.matrix(), RigidTransform(np.eye(3), np.array([1.0, 2.0, 3.0])).matrix(), atol=1e-12
    )
    # The camera sits 0.5 m ahead of the body and looks back.
    backwards = RigidTransform(np.diag([-1.0, -1.0, 1.0]), np.array([0.5, 0.0, 0.0]))
    found, _ = messages.body_pose(answer(optical, None), backwards)
    np.testing.assert_allclose(found.translation, [1.5, 2.0, 3.0], atol=1e-12)
    np.testing.assert_allclose(found.rotation, np.diag([-1.0, -1.0, 1.0]), atol=1e-12)


def test_the_covariance_of_the_body_matches_perturbed_cameras(messages: Any) -> None:
    """Monte Carlo: cameras perturbed as the covariance says put the body where its covariance says."""
    random = np.random.default_rng(7)
    half = random.normal(0, 1e-4, (6, 6))
    covariance = half @ half.T
    sensor = RigidTransform(rotation_from_vector([0.3, -1.0, 2.0]), np.array([1.0, 2.0, 3.0]))
    mount = RigidTransform(rotation_from_vector([0.1, 0.2, 0.3]), np.array([0.4, -0.2, 1.1]))
    mean, claimed = messages.body_pose(answer(sensor, covariance), mount)
    samples = []
    for x, y, z, *turn in random.multivariate_normal(np.zeros(6), covariance, 4_000):
        turned = rotation_from_vector(turn)
        moved = RigidTransform(turned @ sensor.rotation, sensor.translation + [x, y, z])
        body, _ = messages.body_pose(answer(moved, None), mount)
        small = body.rotation @ mean.rotation.T - np.eye(3)
        samples.append([*(body.translation - mean.translation), small[2, 1], small[0, 2], small[1, 0]])
    scale = np.sqrt(np.outer(np.diag(claimed), np.diag(claimed)))
    np.testing.assert_allclose(np.cov(np.array(samples).T) / scale, claimed / scale, atol=0.1)


def pose_message() -> Any:
    def empty() -> SimpleNamespace:
        return SimpleNamespace()

    inner = SimpleNamespace(position=empty(), orientation=empty())
    return SimpleNamespace(header=SimpleNamespace(), pose=SimpleNamespace(pose=inner, covariance=None))


def test_a_pose_is_filled_in_rosses_order(messages: Any) -> None:
    covariance = np.arange(36.0).reshape(6, 6)
    filled = messages.fill_pose(pose_message(), pose(1.5), covariance, "stamp", "map")
    assert (filled.header.stamp, filled.header.frame_id) == ("stamp", "map")
    assert (filled.pose.pose.position.x, filled.pose.pose.position.z) == (1.5, -1.0)
    # An array: serializers other than ROS's own want one.
    assert isinstance(filled.pose.covariance, np.ndarray)
    assert (filled.pose.covariance.dtype, filled.pose.covariance.tolist()) == (np.float64, list(range(36)))
    q = filled.pose.pose.orientation
    assert [q.x, q.y, q.z, q.w] == pytest.approx(list(vars(pose(1.5).quaternion()).values()))


class HandingOnNode:
    """As much of rclpy's Node as the example uses; `parameters` are what the command line says."""

    parameters: dict[str, Any] = {}  # noqa: RUF012 - each test has its own

    def __init__(self, name: str) -> None:
        self.name = name
        self.callbacks: dict[str, Callable[[Any], None]] = {}
        self.published: list[Any] = []
        self.logged: list[str] = []

    def get_name(self) -> str:
        return self.name

    def declare_parameter(self, name: str, value: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, value))

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        return SimpleNamespace(publish=self.published.append)

    def create_subscription(self, kind: Any, topic: str, callback: Callable[[Any], None], profile: Any) -> None:
        self.callbacks[topic] = callback

    def get_logger(self) -> Any:
        def log(text: str, **_: Any) -> None:
            self.logged.append(text)

        return SimpleNamespace(info=log, warning=log, error=log)

    def destroy_node(self) -> None:
        self.callbacks.clear()


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> Any:
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {},
        "rclpy.node": {"Node": HandingOnNode},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "geometry_msgs": {},
        "geometry_msgs.msg": {"PoseWithCovarianceStamped": pose_message},
        "sensor_msgs": {},
        "sensor_msgs.msg": {"CameraInfo": None, "CompressedImage": None, "Image": None},
    }
    for name, members in modules.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, module)
    monkeypatch.delitem(sys.modules, "ros2_node", raising=False)
    return importlib.import_module("ros2_node")


def test_the_node_publishes_the_body_at_the_image_timestamp(
    node_module: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(tmp_path / "data") as server, Client(server.address) as client:
        make_scene(client, "hall", 2)
        parameters = {"address": server.address, "scene": "hall", "compressed": True}
        monkeypatch.setattr(HandingOnNode, "parameters", parameters)
        node = node_module.MaplessNode()
        try:
            stamp = SimpleNamespace(sec=1_800_000_000, nanosec=5)
            photo = SimpleNamespace(data=PHOTO, header=SimpleNamespace(stamp=stamp))
            node.callbacks["image"](photo)
            wait_until(lambda: node.logged)
            assert node.logged == ["no camera_info yet"]
            node.callbacks["camera_info"](info())
            node.callbacks["image"](photo)
            wait_until(lambda: node.published)
            (published,) = node.published
            assert published.header.stamp is stamp
            assert published.header.frame_id == "map"
            assert published.pose.pose.position.y == 2.0
            assert np.reshape(published.pose.covariance, (6, 6))[0, 0] > 0
            server.stop()
            node.callbacks["image"](photo)
            wait_until(lambda: len(node.logged) > 1)
            assert node.logged[1].startswith("no pose: ")
        finally:
            node.destroy_node()
