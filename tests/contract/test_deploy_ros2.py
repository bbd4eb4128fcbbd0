"""The ROS 2 package without ROS: its node on a stand-in for rclpy with messages of `rosbags`, and its files."""

import importlib
import runpy
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml  # type: ignore[import-untyped]
from support.bags import BASE_FROM_CAMERA, at, class_of, compressed, drive, info, pose_with_covariance, transforms
from support.servers import CAMERA, PHOTO, make_scene, pose, serving
from support.waiting import wait_until

from mapless import Client
from mapless.ros import transform_from_message, transform_from_pose

PACKAGE = Path(__file__).parents[2] / "deploy" / "ros2" / "mapless_ros"


class StandInNode:
    """As much of rclpy's Node as is used; `parameters` are what a launch file gives."""

    parameters: dict[str, Any] = {}  # noqa: RUF012 - each test has its own

    def __init__(self, name: str) -> None:
        self.name = name
        self.callbacks: dict[str, Callable[..., Any]] = {}
        self.published: dict[str, list[Any]] = {}
        self.logged: list[str] = []

    def get_name(self) -> str:
        return self.name

    def resolve_topic_name(self, topic: str) -> str:
        return "/front/image_rect/compressed"

    def get_clock(self) -> Any:
        return SimpleNamespace(now=lambda: SimpleNamespace(nanoseconds=at(5.0)))

    def declare_parameter(self, name: str, value: Any) -> Any:
        return SimpleNamespace(value=self.parameters.get(name, value))

    def create_publisher(self, kind: Any, topic: str, depth: int) -> Any:
        self.published[topic] = []
        return SimpleNamespace(publish=self.published[topic].append)

    def create_subscription(self, kind: Any, topic: str, callback: Callable[[Any], None], profile: Any) -> None:
        self.callbacks[topic] = callback

    def create_service(self, kind: Any, name: str, callback: Callable[[Any, Any], Any]) -> None:
        self.callbacks[name] = callback

    def create_timer(self, period_s: float, callback: Callable[[], None]) -> None:
        self.callbacks["timer"] = callback

    def get_logger(self) -> Any:
        def log(text: str, **_: Any) -> None:
            self.logged.append(text)

        return SimpleNamespace(info=log, warning=log, error=log)

    def destroy_node(self) -> None:
        self.callbacks.clear()


class TransformException(Exception):
    """As tf2's."""


class StandInBuffer:
    """tf: the camera on the base, and the base where the drive is."""

    def lookup_transform(self, target: str, source: str, time: Any, timeout: Any) -> Any:
        poses = {("base_link", "camera"): BASE_FROM_CAMERA, ("odom", "base_link"): drive((time - at(0)) / 1e9)}
        if (target, source) not in poses:
            raise TransformException(f'"{source}" passed to lookupTransform does not exist')
        return transforms(at(0), (target, source, poses[target, source])).transforms[0]


class StandInBroadcaster:
    """Keeps what is sent."""

    sent: list[Any] = []  # noqa: RUF012 - each test has its own

    def __init__(self, node: Any) -> None:
        pass

    def sendTransform(self, message: Any) -> None:  # noqa: N802 - tf2's name
        self.sent.append(message)


@pytest.fixture
def node_module(monkeypatch: pytest.MonkeyPatch) -> Any:
    def messages(package: str, *names: str) -> dict[str, Any]:
        return {name: class_of(f"{package}/msg/{name}") for name in names}

    geometry = ("Point", "Pose", "PoseWithCovariance", "PoseWithCovarianceStamped", "Quaternion", "Transform")
    modules: dict[str, dict[str, Any]] = {
        "rclpy": {},
        "rclpy.node": {"Node": StandInNode},
        "rclpy.qos": {"qos_profile_sensor_data": None},
        "rclpy.duration": {"Duration": lambda seconds: seconds},
        "rclpy.time": {"Time": lambda nanoseconds: nanoseconds},
        "tf2_ros": {
            "Buffer": StandInBuffer,
            "TransformListener": lambda buffer, node: None,
            "TransformBroadcaster": StandInBroadcaster,
            "TransformException": TransformException,
        },
        "std_srvs.srv": {"Trigger": None},
        "builtin_interfaces.msg": messages("builtin_interfaces", "Time"),
        "diagnostic_msgs.msg": messages("diagnostic_msgs", "DiagnosticArray", "DiagnosticStatus", "KeyValue"),
        "geometry_msgs.msg": messages("geometry_msgs", *geometry, "TransformStamped", "Vector3"),
        "sensor_msgs.msg": messages("sensor_msgs", "CameraInfo", "CompressedImage", "Image"),
        "std_msgs.msg": messages("std_msgs", "Header"),
    }
    for name in list(modules):
        modules.setdefault(name.partition(".")[0], {})
    for name, members in modules.items():
        module = ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
    for name in modules:
        parent, _, child = name.rpartition(".")
        if parent:
            setattr(sys.modules[parent], child, sys.modules[name])
    monkeypatch.syspath_prepend(str(PACKAGE))
    monkeypatch.setattr(StandInBroadcaster, "sent", [])
    for name in ("mapless_ros", "mapless_ros.node"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    return importlib.import_module("mapless_ros.node")


def shot(time_s: float) -> Any:
    return compressed(at(time_s), PHOTO)


def test_the_node_publishes_pose_transform_and_diagnostics(
    node_module: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with serving(tmp_path / "data") as server, Client(server.address) as client:
        make_scene(client, "hall", 2)
        given = {"address": server.address, "scene": "hall", "compressed": True}
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
            node.callbacks["visual_localization/image_0"](shot(1.0))
            wait_until(lambda: poses)
            map_from_base = pose(0).compose(BASE_FROM_CAMERA.inverse())  # what that server answers
            found = transform_from_pose(poses[0].pose.pose)
            np.testing.assert_allclose(found.translation - map_from_base.translation, 0, atol=1e-9)
            assert poses[0].header.frame_id == "map"
            assert np.linalg.eigvalsh(np.reshape(poses[0].pose.covariance, (6, 6))).min() > 0
            assert reports[0].status[0].level == 0
            node.callbacks["timer"]()
            (edge,) = StandInBroadcaster.sent
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


def test_a_parameter_that_cannot_be_used_ends_the_node(node_module: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(StandInNode, "parameters", {"scene": ""})
    for name in ("init", "spin", "try_shutdown"):
        monkeypatch.setattr(node_module.rclpy, name, lambda *_: None, raising=False)
    with pytest.raises(SystemExit, match="scene is empty"):
        node_module.main()


def test_file_and_readme_name_the_parameters_of_the_node(node_module: Any) -> None:
    file = yaml.safe_load((PACKAGE / "config" / "mapless.yaml").read_text())
    assert file == {"mapless": {"ros__parameters": node_module.PARAMETERS}}
    readme = (PACKAGE / "README.md").read_text()
    assert [name for name in node_module.PARAMETERS if f"`{name}`" not in readme] == []


def test_the_launch_file_starts_the_program_of_the_package(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its actions are kept as they are called; the program and every file that it names are installed by setup.py."""

    def keep(name: str) -> Callable[..., Any]:
        return lambda *positional, **named: SimpleNamespace(kind=name, positional=positional, **named)

    names = {
        "launch": ["LaunchDescription"],
        "launch.actions": ["DeclareLaunchArgument"],
        "launch.substitutions": ["LaunchConfiguration", "PathJoinSubstitution"],
        "launch_ros": [],
        "launch_ros.actions": ["Node"],
        "launch_ros.substitutions": ["FindPackageShare"],
    }
    for module, members in names.items():
        made = ModuleType(module)
        vars(made).update({name: keep(name) for name in members})
        monkeypatch.setitem(sys.modules, module, made)
    program = runpy.run_path(str(PACKAGE / "launch" / "mapless.launch.py"))
    *arguments, node = program["generate_launch_description"]().positional[0]
    declared = {it.positional[0] for it in arguments}
    used = {value.positional[0] for value in (*node.parameters[1].values(), *dict(node.remappings).values())}
    assert used | {node.parameters[0].positional[0]} == declared
    installed: dict[str, Any] = {}
    setuptools = ModuleType("setuptools")  # the real one cannot be imported after the standard library's distutils
    vars(setuptools).update(setup=installed.update)
    monkeypatch.setitem(sys.modules, "setuptools", setuptools)
    monkeypatch.chdir(PACKAGE)
    runpy.run_path(str(PACKAGE / "setup.py"))
    assert any(it.startswith(f"{node.executable} = ") for it in installed["entry_points"]["console_scripts"])
    files = [file for _, group in installed["data_files"] for file in group]
    assert all((PACKAGE / file).is_file() for file in files)
    assert "share/mapless_ros/config" in dict(installed["data_files"])
