"""Messages that are published, built from the classes of rclpy or of `rosbags`."""

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

from mapless.geometry import RigidTransform

from .localizer import Outcome

POSE_TYPE = "geometry_msgs/msg/PoseWithCovarianceStamped"
TF_TYPE = "tf2_msgs/msg/TFMessage"
DIAGNOSTICS_TYPE = "diagnostic_msgs/msg/DiagnosticArray"
STATUS_NAME = "mapless: visual localization"


def class_of_ros(name: str) -> Any:
    """The class of a message in an environment of ROS 2, by a name such as "std_msgs/msg/Header"."""
    package, _, kind = name.split("/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


class Messages:
    """Builds messages from classes whose constructors take the fields by name, as rclpy's and those of `rosbags` do."""

    def __init__(self, class_of: Callable[[str], Any] = class_of_ros) -> None:
        """`class_of` returns a message's class by its name."""
        self._class_of = class_of

    def pose(self, outcome: Outcome) -> Any:
        """The PoseWithCovarianceStamped of a localized image; its stamp is the image's."""
        assert outcome.map_from_body is not None
        pose = self._geometry("Pose", position="Point", orientation="Quaternion", of=outcome.map_from_body)
        # An array: serializers take no list.
        covariance = np.array(outcome.covariance, np.float64).ravel()
        filled = self._make("geometry_msgs/msg/PoseWithCovariance", pose=pose, covariance=covariance)
        return self._make(POSE_TYPE, header=self.header(outcome.stamp_ns, outcome.map_frame), pose=filled)

    def transform(self, stamp_ns: int, parent: str, child: str, parent_from_child: RigidTransform) -> Any:
        """A geometry_msgs/TransformStamped."""
        transform = self._geometry("Transform", translation="Vector3", rotation="Quaternion", of=parent_from_child)
        header = self.header(stamp_ns, parent)
        kind = "geometry_msgs/msg/TransformStamped"
        return self._make(kind, header=header, child_frame_id=child, transform=transform)

    def tf(self, outcome: Outcome) -> Any:
        """The TFMessage of a localized image."""
        assert outcome.tf_edge is not None
        return self._make(TF_TYPE, transforms=[self.transform(outcome.stamp_ns, outcome.map_frame, *outcome.tf_edge)])

    def diagnostics(self, outcome: Outcome, hardware_id: str) -> Any:
        """The DiagnosticArray of an image: why it was not localized, or how well it was."""
        kind = self._class_of("diagnostic_msgs/msg/DiagnosticStatus")
        values = [self._make("diagnostic_msgs/msg/KeyValue", key=key, value=it) for key, it in outcome.values.items()]
        status = kind(
            level=getattr(kind, outcome.level),
            name=STATUS_NAME,
            message=outcome.message,
            hardware_id=hardware_id,
            values=values,
        )
        return self._make(DIAGNOSTICS_TYPE, header=self.header(outcome.stamp_ns, ""), status=[status])

    def header(self, stamp_ns: int, frame: str) -> Any:
        """A std_msgs/Header."""
        seconds, rest_ns = divmod(stamp_ns, 1_000_000_000)
        stamp = self._make("builtin_interfaces/msg/Time", sec=seconds, nanosec=rest_ns)
        return self._make("std_msgs/msg/Header", stamp=stamp, frame_id=frame)

    def _geometry(self, kind: str, *, of: RigidTransform, **parts: str) -> Any:
        """Makes a Pose or a Transform with its two fields and their types."""
        (place, place_kind), (turn, turn_kind) = parts.items()
        x, y, z = map(float, of.translation)
        q = of.quaternion()
        fields = {
            place: self._make(f"geometry_msgs/msg/{place_kind}", x=x, y=y, z=z),
            turn: self._make(f"geometry_msgs/msg/{turn_kind}", x=q.x, y=q.y, z=q.z, w=q.w),
        }
        return self._make(f"geometry_msgs/msg/{kind}", **fields)

    def _make(self, kind: str, **fields: Any) -> Any:
        return self._class_of(kind)(**fields)
