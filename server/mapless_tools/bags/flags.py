"""Flags of the commands that read recordings."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from .options import BagOptions

ImageTopic = Annotated[str, typer.Option(help="Of a recording: topic of the images, where there are several.")]
CameraTopic = Annotated[str, typer.Option(help="Of a recording: topic of their CameraInfo.")]
PoseTopic = Annotated[
    str, typer.Option(help="Of a recording: topic of Odometry, PoseStamped or TransformStamped, or /tf.")
]
WorldFrame = Annotated[str, typer.Option(help="Of a recording: frame of the poses in /tf, map for instance.")]
BodyFrame = Annotated[str, typer.Option(help="Of a recording: frame whose poses a topic has that does not name it.")]
BodyFromCamera = Annotated[
    str, typer.Option(help="Of a recording without /tf_static: the camera's pose on the body, JSON or a file.")
]
MaxPoseGap = Annotated[
    float, typer.Option(help="Of a recording: seconds within which there must be a pose before and after an image.")
]


def bag_options(
    image_topic: str,
    camera_topic: str,
    pose_topic: str,
    world_frame: str,
    body_frame: str,
    body_from_camera: str,
    max_pose_gap: float,
) -> BagOptions:
    """Makes options from these flags; ValueError if a flag is invalid."""
    from mapless.cameras import read_pose

    from .options import BagOptions

    try:
        pose = read_pose(body_from_camera) if body_from_camera else None
    except (OSError, ValueError) as error:
        raise ValueError(f"--body-from-camera: {error}") from error
    return BagOptions(image_topic, camera_topic, pose_topic, world_frame, body_frame, pose, max_pose_gap)
