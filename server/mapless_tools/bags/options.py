"""Which topics and frames of a recording are used."""

from dataclasses import dataclass

from mapless.geometry import RigidTransform


@dataclass(frozen=True)
class BagOptions:
    """Which topics and frames of a recording are used; empty for unambiguous ones.

    A `pose_topic` has Odometry, PoseStamped, PoseWithCovarianceStamped or TransformStamped, or is /tf, whose poses are
    in `world_frame`, by default the root of its tree. `body_frame` is the frame whose poses a topic without
    child_frame_id has, by default the root of the camera's static frames; `body_from_camera` is the pose of the
    camera's optical frame on it, None for that of /tf_static. An image is used if there are poses within
    `max_pose_gap_s` before and after it. At 10 Hz there is one every 0.1 s; between two of them a robot that
    accelerates by 2 m/s2 is off a straight line by 2.5 mm.
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
