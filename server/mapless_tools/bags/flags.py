"""Flags of the commands that read recordings."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from .options import BagOptions


@dataclass(frozen=True)
class BagFlags:
    """Which parts of a recording are used; each field is a flag."""

    image_topic: Annotated[str, typer.Option(help="Of a recording: topic of the images, where there are several.")] = ""
    camera_topic: Annotated[str, typer.Option(help="Of a recording: topic of their CameraInfo.")] = ""
    pose_topic: Annotated[
        str, typer.Option(help="Of a recording: topic of Odometry, PoseStamped or TransformStamped, or /tf.")
    ] = ""
    world_frame: Annotated[str, typer.Option(help="Of a recording: frame of the poses in /tf, map for instance.")] = ""
    body_frame: Annotated[
        str, typer.Option(help="Of a recording: frame whose poses a topic has that does not name it.")
    ] = ""
    body_from_camera: Annotated[
        str, typer.Option(help="Of a recording without /tf_static: the camera's pose on the body, JSON or a file.")
    ] = ""
    max_pose_gap: Annotated[
        float,
        typer.Option(help="Of a recording: seconds within which there must be a pose before and after an image."),
    ] = 0.15

    def options(self) -> BagOptions:
        """The options in the form of `bags`; ValueError if a flag is invalid."""
        from mapless.cameras import read_pose

        from .options import BagOptions

        given = asdict(self)
        gap_s = given.pop("max_pose_gap")
        try:
            given["body_from_camera"] = read_pose(self.body_from_camera) if self.body_from_camera else None
        except (OSError, ValueError) as error:
            raise ValueError(f"--body-from-camera: {error}") from error
        return BagOptions(**given, max_pose_gap_s=gap_s)
