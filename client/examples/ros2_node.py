r"""A ROS 2 node: images in, geometry_msgs/PoseWithCovarianceStamped out, for robot_localization and its like.

    python ros2_node.py --ros-args -p scene:=hall -p address:=server:50051 -p compressed:=true \
        -r image:=/camera/image_raw/compressed -r camera_info:=/camera/camera_info

It publishes `pose`: of the body in `map_frame`, stamped with the time of the image, with the covariance that mapless
estimated for that very image. It publishes nothing for an image that was not localized, and logs the reason. One
call at a time, always with the newest image. `body_from_camera` is the pose of camera_link in the body's frame,
x y z and quaternion x y z w; the default publishes camera_link's own pose.
"""

from __future__ import annotations

import threading
from typing import Any

import numpy as np
import rclpy
import rclpy.node
import ros2_messages
from geometry_msgs.msg import PoseWithCovarianceStamped
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import CameraInfo, CompressedImage, Image

import mapless

PARAMETERS: dict[str, Any] = {
    "address": "localhost:50051",
    "scene": "",
    "compressed": False,
    "map_frame": "map",
    "body_from_camera": [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0],
    "timeout_s": 5.0,
}


class MaplessNode(rclpy.node.Node):  # type: ignore[misc]
    """Keeps the newest image, and a thread that localizes it."""

    def __init__(self) -> None:
        super().__init__("mapless")
        given = {name: self.declare_parameter(name, value).value for name, value in PARAMETERS.items()}
        self._scene, self._map_frame = given["scene"], given["map_frame"]
        x, y, z, *quaternion = given["body_from_camera"]
        self._body_from_camera = mapless.RigidTransform(mapless.Quaternion(*quaternion).matrix(), np.array([x, y, z]))
        # One attempt: for an image that failed there is a newer one.
        options = mapless.ConnectOptions(timeout_s=given["timeout_s"], max_attempts=1, client_id=self.get_name())
        self._client = mapless.Client(given["address"], options)
        self._publisher = self.create_publisher(PoseWithCovarianceStamped, "pose", 10)
        self._camera: mapless.Camera | None = None
        self._image: Any = None
        self._changed = threading.Condition()
        self._is_closed = False
        kind = CompressedImage if given["compressed"] else Image
        self.create_subscription(CameraInfo, "camera_info", self._on_camera, qos_profile_sensor_data)
        self.create_subscription(kind, "image", self._on_image, qos_profile_sensor_data)
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

    def _on_camera(self, message: Any) -> None:
        try:
            self._camera = ros2_messages.camera_from_info(message)
        except ValueError as error:
            self.get_logger().error(str(error), throttle_duration_sec=10.0)

    def _on_image(self, message: Any) -> None:
        with self._changed:
            self._image = message
            self._changed.notify_all()

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._is_closed or self._image is not None)
                if self._is_closed:
                    return
                message, self._image = self._image, None
            try:
                self._look(message)
            except (mapless.MaplessError, ValueError) as error:
                if not self._is_closed:
                    self.get_logger().warning(f"no pose: {error}", throttle_duration_sec=5.0)

    def _look(self, message: Any) -> None:
        if self._camera is None:
            self.get_logger().warning("no camera_info yet", throttle_duration_sec=5.0)
            return
        stamp = message.header.stamp
        answer = self._client.localize(
            ros2_messages.photo_from_image(message),
            self._camera,
            self._scene,
            capture_time=ros2_messages.time_from_stamp(stamp),
        )
        if isinstance(answer, mapless.Rejected):
            self.get_logger().info(f"not localized: {answer.reason}: {answer.message}")
            return
        pose, covariance = ros2_messages.body_pose(answer, self._body_from_camera)
        if covariance is None:
            self.get_logger().info("a pose without covariance is not published")
            return
        filled = PoseWithCovarianceStamped()
        self._publisher.publish(ros2_messages.fill_pose(filled, pose, covariance, stamp, self._map_frame))


def main() -> None:
    """Run the node until it is interrupted."""
    rclpy.init()
    node = MaplessNode()
    try:
        rclpy.spin(node)
    except KeyboardInterrupt:
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
