"""The ROS 2 package without ROS: its node on a stand-in for rclpy with messages of `rosbags`, and its files."""

import importlib
import runpy
import sys
from collections.abc import Callable
from operator import attrgetter
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock, Mock

import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from support.bags import (
    BASE_FROM_CAMERA,
    at,
    class_of,
    compressed,
    drive,
    image,
    info,
    pose_with_covariance,
    transforms,
)
from support.servers import CAMERA, PHOTO, make_scene, pose, serving
from support.waiting import wait_until

from mapless import Client
from mapless.ros import transform_from_message, transform_from_pose
from mapless_server.method.bundle.readout import ReadoutDirection, RollingShutter

PACKAGE = Path(__file__).parents[2] / "deploy" / "ros2" / "mapless_ros"


class StandInNode:
    """As much of rclpy's Node as is used; `parameters` are what a launch file gives."""

    parameters: dict[str, Any] = {}  # noqa: RUF012 - each test has its own

    def __init__(self, name: str) -> None:
        self.callbacks: dict[str, Callable[..., Any]] = {}
        self.published: dict[str, list[Any]] = {}
        self.logged: list[str] = []
        self.get_name = lambda: name
        self.resolve_topic_name = lambda topic: "/front/image_rect/compressed"
        self.get_clock = lambda: SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=at(5.0)))
        self.declare_parameter = lambda name, value: SimpleNamespace(value=self.parameters.get(name, value))
        self.create_publisher = lambda kind, topic, depth: SimpleNamespace(
            publish=self.published.setdefault(topic, []).append
        )
        self.create_subscription = lambda kind, topic, callback, profile: self.callbacks.update({topic: callback})
        self.create_service = lambda kind, name, callback: self.callbacks.update({name: callback})
        self.create_timer = lambda period_s, callback: self.callbacks.update(timer=callback)
        self.get_logger = lambda: Mock(**{f"{it}.side_effect": self._log for it in ("info", "warning", "error")})

    def _log(self, text: str, **_: Any) -> None:
        self.logged.append(text)

    def destroy_node(self) -> None:
        self.callbacks.clear()


class StandInBuffer:
    """tf: the camera on the base, and the base where the drive is."""

    def lookup_transform(self, target: str, source: str, time: Any, timeout: Any) -> Any:
        poses = {("base_link", "camera"): BASE_FROM_CAMERA, ("odom", "base_link"): drive((time - at(0)) / 1e9)}
        return transforms(at(0), (target, source, poses[target, source])).transforms[0]


@pytest.fixture
def ros(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Modules of ROS: stand-ins, and messages of `rosbags`."""
    made = MagicMock()
    made.rclpy.node.Node, made.rclpy.time.Time = StandInNode, lambda nanoseconds: nanoseconds
    made.tf2_ros.Buffer, made.tf2_ros.TransformException = StandInBuffer, KeyError
    for name in ("rclpy", "rclpy.node", "rclpy.qos", "rclpy.duration", "rclpy.time", "tf2_ros", "std_srvs.srv"):
        monkeypatch.setitem(sys.modules, name, attrgetter(name)(made))
    for package in ("builtin_interfaces", "diagnostic_msgs", "geometry_msgs", "sensor_msgs", "std_msgs"):
        module = ModuleType(f"{package}.msg")
        vars(module).update(__path__=[], __getattr__=lambda name, package=package: class_of(f"{package}/msg/{name}"))
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return made


@pytest.fixture
def node_module(ros: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    monkeypatch.syspath_prepend(str(PACKAGE))
    for name in ("mapless_ros", "mapless_ros.node"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("mapless_ros.node")


def shot(time_s: float) -> Any:
    return compressed(at(time_s), PHOTO)


def test_the_node_publishes_pose_transform_and_diagnostics(
    node_module: Any, ros: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(tmp_path / "data") as server, Client(server.address) as client:
        make_scene(client, "hall", 2)
        given = {"address": server.address, "scene": "hall", "compressed": True, "depth": True}
        given |= {"readout_s": 0.02, "readout_direction": "left_to_right", "speed_m_per_s": 1.5, "turn_deg_per_s": 30.0}
        monkeypatch.setattr(StandInNode, "parameters", given)
        node = node_module.MaplessNode()
        poses, reports = node.published["visual_localization/pose"], node.published["/diagnostics"]
        trigger, response = node.callbacks["visual_localization/trigger_localization"], SimpleNamespace()
        try:
            node.callbacks["visual_localization/image_0"](shot(0.0))
            wait_until(lambda: node.logged)
            assert node.logged == ["no camera_info yet"]
            assert not trigger(None, response).success
            node.callbacks["visual_localization/camera_info_0"](info(CAMERA))
            assert node.logged[-1] == "the camera is K and D of CameraInfo (parameter rectified: False)"
            assert trigger(None, response).success
            deep = np.full((64, 96), 2000, np.uint16)
            node.callbacks["visual_localization/depth_camera_info_0"](info(CAMERA))
            node.callbacks["visual_localization/depth_0"](image(at(1.01), deep, "16UC1"))
            node.callbacks["visual_localization/image_0"](shot(1.0))
            wait_until(lambda: poses)
            map_from_base = pose(0).compose(BASE_FROM_CAMERA.inverse())  # what that server answers
            found = transform_from_pose(poses[0].pose.pose)
            np.testing.assert_allclose(found.translation - map_from_base.translation, 0, atol=1e-9)
            assert poses[0].header.frame_id == "map"
            shutter = RollingShutter(0.02, ReadoutDirection.LEFT_TO_RIGHT, 1.5, 30.0)
            assert server.method.options[-1].shutter == shutter
            assert np.linalg.eigvalsh(np.reshape(poses[0].pose.covariance, (6, 6))).min() > 0
            assert reports[0].status[0].level == 0
            assert {it.key: it.value for it in reports[0].status[0].values}["depth"] == "sent"
            node.callbacks["timer"]()
            (edge,) = ros.tf2_ros.TransformBroadcaster.return_value.sendTransform.call_args.args
            assert (edge.header.frame_id, edge.child_frame_id) == ("map", "odom")
            np.testing.assert_allclose(
                transform_from_message(edge.transform).matrix(), found.compose(drive(1.0).inverse()).matrix(), atol=1e-9
            )
            node.callbacks["visual_localization/image_0"](shot(1.2))  # sooner than the rate: skipped
            node.callbacks["/initialpose"](pose_with_covariance(at(1.3), "odom", drive(0)))
            assert "not in 'map'" in node.logged[-1]
            server.stop()
            node.callbacks["visual_localization/image_0"](shot(2.5))
            wait_until(lambda: len(reports) == 2)
            assert reports[1].status[0].level == 2
            assert len(poses) == 1
        finally:
            node.destroy_node()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"scene": ""}, "scene is empty"),
        ({"scene": "hall", "depth": True, "depth_sensor": "lidar"}, "depth_sensor must be one of unknown, .*'lidar'"),
        ({"scene": "hall", "depth": True, "depth_tolerance": -1.0}, "depth_tolerance must be 0 to 1 s"),
    ],
)
def test_a_parameter_that_cannot_be_used_ends_the_node(
    node_module: Any, monkeypatch: pytest.MonkeyPatch, given: dict[str, Any], message: str
) -> None:
    monkeypatch.setattr(StandInNode, "parameters", given)
    with pytest.raises(SystemExit, match=message):
        node_module.main()


def test_file_and_readme_name_the_parameters_of_the_node(node_module: Any) -> None:
    file = yaml.safe_load((PACKAGE / "config" / "mapless.yaml").read_text())
    assert file == {"mapless": {"ros__parameters": node_module.PARAMETERS}}
    readme = (PACKAGE / "README.md").read_text()
    assert [name for name in node_module.PARAMETERS if f"`{name}`" not in readme] == []


def test_the_launch_file_starts_the_program_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """The program and every file that it names are installed by setup.py; each argument that is declared is used."""
    launch, launch_ros, setuptools = MagicMock(), MagicMock(), MagicMock()
    modules = {"launch": launch, "launch.actions": launch, "launch.substitutions": launch, "setuptools": setuptools}
    modules |= {f"launch_ros.{it}": launch_ros for it in ("actions", "substitutions")}
    for name, module in modules.items():
        monkeypatch.setitem(sys.modules, name, module)
    runpy.run_path(str(PACKAGE / "launch" / "mapless.launch.py"))["generate_launch_description"]()
    declared, used = (
        {call.args[0] for call in kind.call_args_list}
        for kind in (launch.DeclareLaunchArgument, launch.LaunchConfiguration)
    )
    assert used == declared != set()
    monkeypatch.chdir(PACKAGE)
    runpy.run_path(str(PACKAGE / "setup.py"))
    installed = setuptools.setup.call_args.kwargs
    program = launch_ros.Node.call_args.kwargs["executable"]
    assert any(it.startswith(f"{program} = ") for it in installed["entry_points"]["console_scripts"])
    files = [file for _, group in installed["data_files"] for file in group]
    assert all((PACKAGE / file).is_file() for file in files)
    assert "share/mapless_ros/config" in dict(installed["data_files"])
