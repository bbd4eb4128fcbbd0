"""Conversion between ROS 2 and mapless: images, cameras, poses, and a robot's localizer; without rclpy.

Messages are read by their fields, so those of rclpy and of the package `rosbags` will do; `messages` builds them from
the classes that it is given. `localizer` is what `deploy/ros2/mapless_ros` runs on a robot and `mapless-server
replay-bag` on a recording. Needs OpenCV, which is no dependency of the client.

ROS (REP 103) has bodies with x forward, y left and z up, and cameras twice: `camera_link` in those axes, and
`camera_optical_frame` with x right, y down and z forward, which is OpenCV's and mapless's own. The `frame_id` of an
image is the optical frame. The world is the scene's; for ROS it should have z up (REP 105's `map`).
"""

from .camera_infos import CameraInfos, rectified_differs, says_rectified
from .cameras import RosCamera, camera_from_info
from .depths import Depths, RosDepth, sensor_of
from .images import pixels_from_image
from .localizer import Localizer, Outcome
from .localizer_options import LocalizerOptions
from .messages import Messages
from .poses import pose_of_body, stamp_ns_of, transform_from_message, transform_from_pose

__all__ = [
    "CameraInfos",
    "Depths",
    "Localizer",
    "LocalizerOptions",
    "Messages",
    "Outcome",
    "RosCamera",
    "RosDepth",
    "camera_from_info",
    "pixels_from_image",
    "pose_of_body",
    "rectified_differs",
    "says_rectified",
    "sensor_of",
    "stamp_ns_of",
    "transform_from_message",
    "transform_from_pose",
]
