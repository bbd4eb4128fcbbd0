"""The parts of a recording that are used. Imports what it needs when it runs, so that --help answers at once."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from mapless.geometry import RigidTransform


@dataclass(frozen=True)
class BagOptions:
    """The topics and frames of a recording that are used; empty for unambiguous ones. Each field is a flag.

    Poses of /tf are in `world_frame`, by default the root of its tree. `body_frame` is the frame whose poses a topic
    without child_frame_id has, by default the root of the camera's static frames. `rectified` says whether P of
    CameraInfo is the camera of the images, or K and D; by default the topic's name does. An image is used if there are
    poses within `max_pose_gap_s` before and after it. At 10 Hz there is one every 0.1 s; between two of them a robot
    that accelerates by 2 m/s2 is off a straight line by 2.5 mm.
    """

    image_topic: Annotated[str, typer.Option(help="Of a recording: topic of the images, where there are several.")] = ""
    camera_topic: Annotated[str, typer.Option(help="Of a recording: topic of their CameraInfo.")] = ""
    pose_topic: Annotated[
        str, typer.Option(help="Of a recording: topic of Odometry, PoseStamped or TransformStamped, or /tf.")
    ] = ""
    world_frame: Annotated[str, typer.Option(help="Of a recording: frame of the poses in /tf, map for instance.")] = ""
    body_frame: Annotated[
        str, typer.Option(help="Of a recording: frame whose poses a topic has that does not name it.")
    ] = ""
    rectified: Annotated[
        bool | None,
        typer.Option(
            "--rectified/--no-rectified",
            help="Of a recording: its images are undistorted, P of CameraInfo is theirs; default: by the topic's name.",
        ),
    ] = None
    body_from_camera: Annotated[
        str, typer.Option(help="Of a recording without /tf_static: the camera's pose on the body, JSON or a file.")
    ] = ""
    max_pose_gap_s: Annotated[
        float,
        typer.Option(
            "--max-pose-gap",
            help="Of a recording: seconds within which there must be a pose before and after an image.",
        ),
    ] = 0.15

    def __post_init__(self) -> None:
        if not 0 < self.max_pose_gap_s <= 10:
            raise ValueError(f"the gap of poses must be above 0 and at most 10 s, is {self.max_pose_gap_s:g}")

    def extrinsics(self) -> RigidTransform | None:
        """The pose of the camera's optical frame on the body; None for /tf_static's. ValueError names the flag."""
        from mapless.cameras import read_pose

        try:
            return read_pose(self.body_from_camera) if self.body_from_camera else None
        except (OSError, ValueError) as error:
            raise ValueError(f"--body-from-camera: {error}") from error
