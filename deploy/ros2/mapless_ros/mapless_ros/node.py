"""The node: images, /initialpose and tf in; pose, map > odom and diagnostics out.

One call at a time, in a thread of its own, and always with the newest image: an old pose is of no use, so images that
arrive during a call are skipped. What is published is computed in `mapless.ros.localizer`, without ROS.
"""

import threading
from pathlib import Path
from typing import Any

import rclpy
import rclpy.duration
import rclpy.node
import rclpy.time
import tf2_ros
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image
from std_srvs.srv import Trigger

import mapless
import mapless.ros
from mapless.geometry import RigidTransform
from mapless.labels import parse_labels
from mapless.text_files import read_text

PARAMETERS: dict[str, Any] = {
    "address": "localhost:50051",
    "scene": "",
    "scenes": "",
    "group": "",
    "token_file": "",
    "tls": False,
    "ca": "",
    "map_frame": "map",
    "odom_frame": "odom",
    "base_frame": "base_link",
    "rate": 1.0,
    "use_initial_guess": False,
    "coverage": 0.0,
    "allow_adoption": False,
    "timeout": 5.0,
    "sequence_length": 0,
    "mask": "",
    "readout_s": 0.0,
    "readout_direction": "top_to_bottom",
    "speed_m_per_s": 0.0,
    "turn_deg_per_s": 0.0,
    "depth": False,
    "depth_compressed": False,
    "depth_sensor": "unknown",
    "depth_tolerance": 0.02,
    "compressed": False,
    "rectified": False,
    "publish_tf": True,
    "tf_rate": 20.0,
    "transform_tolerance": 0.1,
    "tf_timeout": 0.2,
}
"""Names and defaults; what they mean is in the package's README."""

IMAGE_TOPIC = "visual_localization/image_0"
CAMERA_INFOS_KEPT = 100
"""A few seconds of a camera whose CameraInfo changes with the focus, longer than an image waits for its call."""


class MaplessNode(rclpy.node.Node):  # type: ignore[misc]
    """Keeps the newest image, and a thread that localizes it."""

    def __init__(self) -> None:
        """Raises ValueError or OSError if a parameter cannot be used."""
        super().__init__("mapless")
        self._given = {name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
        options = mapless.ros.LocalizerOptions(
            scene=self._given["scene"],
            scenes=[it for it in self._given["scenes"].split(",") if it],
            group=self._group(),
            map_frame=self._given["map_frame"],
            odom_frame=self._given["odom_frame"],
            base_frame=self._given["base_frame"],
            rate_hz=self._given["rate"],
            use_last_pose=self._given["use_initial_guess"],
            coverage=self._given["coverage"],
            allow_adoption=self._given["allow_adoption"],
            timeout_s=self._given["timeout"],
            sequence_length=self._given["sequence_length"],
            mask=self._given["mask"] or None,
            readout_s=self._given["readout_s"],
            readout_direction=self._given["readout_direction"],
            speed_m_per_s=self._given["speed_m_per_s"],
            turn_deg_per_s=self._given["turn_deg_per_s"],
        )
        self._client = mapless.Client(self._given["address"], self._connect_options())
        self._tf = tf2_ros.Buffer()
        self._listener = tf2_ros.TransformListener(self._tf, self)
        self._broadcaster = tf2_ros.TransformBroadcaster(self)
        self._localizer = mapless.ros.Localizer(self._client, options, self._lookup)
        self._messages = mapless.ros.Messages()
        self._pose = self.create_publisher(PoseWithCovarianceStamped, "visual_localization/pose", 10)
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._cameras = mapless.ros.CameraInfos(self._given["rectified"], CAMERA_INFOS_KEPT)
        self._is_camera_said = False
        self._depths: mapless.ros.Depths | None = None
        if self._given["depth"]:
            kind_of_sensor = mapless.ros.sensor_of(self._given["depth_sensor"])
            self._depths = mapless.ros.Depths(kind_of_sensor, self._given["depth_tolerance"])
        self._image: Any = None
        self._edge: tuple[str, str, RigidTransform] | None = None
        self._is_triggered = self._is_closed = False
        self._changed = threading.Condition()
        kind = CompressedImage if self._given["compressed"] else Image
        sensor = qos_profile_sensor_data
        self.create_subscription(CameraInfo, "visual_localization/camera_info_0", self._on_camera, sensor)
        self.create_subscription(kind, IMAGE_TOPIC, self._on_image, sensor)
        if self._depths is not None:
            depth_kind = CompressedImage if self._given["depth_compressed"] else Image
            self.create_subscription(
                CameraInfo, "visual_localization/depth_camera_info_0", self._on_depth_camera, sensor
            )
            self.create_subscription(depth_kind, "visual_localization/depth_0", self._depths.add, sensor)
        self.create_subscription(PoseWithCovarianceStamped, "/initialpose", self._on_guess, 1)
        self.create_service(Trigger, "visual_localization/trigger_localization", self._on_trigger)
        if self._given["publish_tf"]:
            self.create_timer(1 / self._given["tf_rate"], self._broadcast)
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def destroy_node(self) -> None:
        """Ends the thread, whose call fails, and the node."""
        with self._changed:
            self._is_closed = True
            self._changed.notify_all()
        self._client.close()
        self._thread.join()
        super().destroy_node()

    def _group(self) -> dict[str, str] | None:
        given = self._given["group"]
        return None if not given else {} if given == "*" else parse_labels(given.split(","), "group")

    def _connect_options(self) -> mapless.ConnectOptions:
        ca, token_file = self._given["ca"], self._given["token_file"]
        return mapless.ConnectOptions(
            timeout_s=self._given["timeout"],
            tls=self._given["tls"] or bool(ca),
            root_certificates=Path(ca).read_bytes() if ca else None,
            token=read_text(Path(token_file)).strip() if token_file else None,
            client_id=self.get_name(),
        )

    def _on_camera(self, message: Any) -> None:
        try:
            self._cameras.add(message, self.get_clock().now().nanoseconds)
        except ValueError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)
            return
        if not self._is_camera_said:
            self._is_camera_said = True
            self._say_camera(message)

    def _on_depth_camera(self, message: Any) -> None:
        assert self._depths is not None
        try:
            self._depths.add_camera(message, self.get_clock().now().nanoseconds)
        except ValueError as error:
            self.get_logger().error(f"depth: {error}", throttle_duration_sec=10.0)

    def _say_camera(self, message: Any) -> None:
        """Logs which camera of CameraInfo is used, and warns where the topic's name says that it is the other."""
        topic, rectified = self.resolve_topic_name(IMAGE_TOPIC), self._given["rectified"]
        camera = self._cameras.at(mapless.ros.stamp_ns_of(message.header.stamp))
        if camera is not None and camera.undistortion is not None:
            self.get_logger().info("the lens is rational_polynomial: images are undistorted to a pinhole")
        used = "P" if rectified else "K and D"
        self.get_logger().info(f"the camera is {used} of CameraInfo (parameter rectified: {rectified})")
        if not rectified and mapless.ros.says_rectified(topic) and mapless.ros.rectified_differs(message):
            self.get_logger().warning(
                f"the name {topic} says that images are rectified, but K and D are used: set the parameter rectified"
            )

    def _on_image(self, message: Any) -> None:
        stamp_ns = mapless.ros.stamp_ns_of(message.header.stamp)
        with self._changed:
            if self._is_triggered or self._localizer.is_due(stamp_ns):
                self._image = message
                self._changed.notify_all()

    def _on_guess(self, message: Any) -> None:
        try:
            self._localizer.guess(message, self.get_clock().now().nanoseconds)
        except ValueError as error:
            self.get_logger().error(str(error))
            return
        with self._changed:
            self._is_triggered = True

    def _on_trigger(self, request: Any, response: Any) -> Any:
        with self._changed:
            self._is_triggered = True
        response.success = self._is_camera_said
        response.message = "the next image is localized" if response.success else "no usable camera_info has come yet"
        return response

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or self._image is not None)
                if self._is_closed:
                    return
                message, self._image = self._image, None
            camera = self._cameras.at(mapless.ros.stamp_ns_of(message.header.stamp))
            if camera is None:
                self.get_logger().warning("no camera_info yet", throttle_duration_sec=5.0)
                continue
            with self._changed:
                self._is_triggered = False
            find_depth = None if self._depths is None else self._depths.at
            outcome = self._localizer.localize(message, camera, find_depth)
            if (about_depth := outcome.values.get("depth", "")).startswith("none"):
                self.get_logger().warning(f"depth: {about_depth}", throttle_duration_sec=5.0)
            if not self._is_closed:
                self._publish(outcome)

    def _publish(self, outcome: mapless.ros.Outcome) -> None:
        self._diagnostics.publish(self._messages.diagnostics(outcome, self._given["address"]))
        if outcome.map_from_body is None:
            self.get_logger().warning(f"not localized: {outcome.message}", throttle_duration_sec=5.0)
            return
        self._pose.publish(self._messages.pose(outcome))
        if outcome.tf_edge is not None:
            self._edge = (outcome.map_frame, *outcome.tf_edge)

    def _broadcast(self) -> None:
        """Repeats the last map > odom with the present time, for nodes that need the present pose."""
        if self._edge is None:
            return
        parent, child, map_from_child = self._edge
        stamp_ns = self.get_clock().now().nanoseconds + round(1e9 * self._given["transform_tolerance"])
        self._broadcaster.sendTransform(self._messages.transform(stamp_ns, parent, child, map_from_child))

    def _lookup(self, target: str, source: str, stamp_ns: int) -> RigidTransform:
        timeout = rclpy.duration.Duration(seconds=self._given["tf_timeout"])
        try:
            found = self._tf.lookup_transform(target, source, rclpy.time.Time(nanoseconds=stamp_ns), timeout)
        except tf2_ros.TransformException as error:
            raise LookupError(str(error)) from error
        return mapless.ros.transform_from_message(found.transform)


def main() -> None:
    """Runs the node until it is interrupted; exit code 1 if a parameter cannot be used."""
    rclpy.init()
    node = None
    try:
        node = MaplessNode()
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    except (OSError, ValueError) as error:
        raise SystemExit(f"mapless: {error}") from error
    finally:
        if node is not None:
            node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
