"""Where a recording holds what."""

from __future__ import annotations

from dataclasses import dataclass

from mapless.geometry import RigidTransform


@dataclass(frozen=True)
class BagOptions:
    """Where a recording holds what; empty for what is unambiguous.

    Attributes:
        image_topic: of images.
        camera_topic: of the images' CameraInfo.
        pose_topic: of Odometry, PoseStamped, PoseWithCovarianceStamped, TransformStamped, or /tf.
        world_frame: frame of the poses, for /tf: by default the root of its tree.
        body_frame: whose poses a topic without child_frame_id has: by default the root of the camera's static frames.
        body_from_camera: pose of the camera's optical frame on that body; None for what /tf_static says.
        max_pose_gap_s: how far before and after an image poses may be. At 10 Hz there is one every 0.1 s; between two
            of them a robot that accelerates by 2 m/s2 is off a straight line by 2.5 mm.
    """

    image_topic: str = ""
    camera_topic: str = ""
    pose_topic: str = ""
    world_frame: str = ""
    body_frame: str = ""
    body_from_camera: RigidTransform | None = None
    max_pose_gap_s: float = 0.15

    def __post_init__(self) -> None:
        if not 0 < self.max_pose_gap_s <= 10:
            raise ValueError(f"the gap of poses must be above 0 and at most 10 s, is {self.max_pose_gap_s:g}")
