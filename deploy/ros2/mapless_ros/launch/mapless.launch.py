"""Starts the node: parameters of a file, then those of the command line, and the topics of a camera."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.substitutions import FindPackageShare

TOPICS = {
    "image": "visual_localization/image_0",
    "camera_info": "visual_localization/camera_info_0",
    "depth_image": "visual_localization/depth_0",
    "depth_camera_info": "visual_localization/depth_camera_info_0",
}


def generate_launch_description() -> LaunchDescription:
    """Arguments and the node."""
    own = PathJoinSubstitution([FindPackageShare("mapless_ros"), "config", "mapless.yaml"])
    arguments = [
        DeclareLaunchArgument("scene", description="scene of the server"),
        DeclareLaunchArgument("address", default_value="localhost:50051", description="host:port of the server"),
        DeclareLaunchArgument("params_file", default_value=own, description="YAML file of parameters"),
        DeclareLaunchArgument("image", default_value="/camera/image_raw", description="topic of the images"),
        DeclareLaunchArgument("camera_info", default_value="/camera/camera_info", description="topic of CameraInfo"),
        DeclareLaunchArgument(
            "depth_image",
            default_value="/camera/aligned_depth_to_color/image_raw",
            description="topic of depth images, with the parameter depth",
        ),
        DeclareLaunchArgument(
            "depth_camera_info",
            default_value="/camera/aligned_depth_to_color/camera_info",
            description="topic of CameraInfo of the depth images",
        ),
    ]
    node = Node(
        package="mapless_ros",
        executable="mapless_node",
        name="mapless",
        output="screen",
        parameters=[
            LaunchConfiguration("params_file"),
            {name: LaunchConfiguration(name) for name in ("scene", "address")},
        ],
        remappings=[(topic, LaunchConfiguration(name)) for name, topic in TOPICS.items()],
    )
    return LaunchDescription([*arguments, node])
