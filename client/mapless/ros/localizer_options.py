"""Options of a robot's localizer."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from mapless.requests import ImageSource, IntrinsicsUncertainty, ReadoutDirection
from mapless.wire import MAX_READOUT_S, MAX_SPEED_M_PER_S, MAX_TURN_DEG_PER_S

SCENE = "{scene}"
"""In the name of the map's frame, in place of the scene's id."""


@dataclass(frozen=True)
class LocalizerOptions:
    """Options of a robot's localizer.

    Attributes:
        scene: the scene to localize in; empty if it is found among `scenes` or in `group`.
        map_frame: the scene's world, as tf names it. Among several scenes each has a world, and a frame, of its own:
            "map_{scene}", with the scene's id for {scene}.
        odom_frame: the frame of the odometry, for which map > odom is computed; empty without odometry.
        base_frame: the frame whose pose is published; empty for the camera's own.
        rate_hz: largest number of images localized per second; 0 for only those that are requested.
        use_last_pose: whether the last answer, moved by the odometry, is a prior of the next. Errors of successive
            answers then have a common part, so a filter must not treat them as independent.
        coverage: see `Client.localize`.
        timeout_s: deadline of a call.
        sequence_length: largest number of images, 2 to 16, with which an image that is rejected alone is localized
            together, by the odometry between them; 0 for never. This takes as long as localizing all of them.
        mask: a PNG of the camera's size that is 0 where the camera sees the robot itself, or its path; None for none.
        readout_s: seconds that a rolling shutter takes from the first row to the last one; 0 for a global shutter.
        readout_direction: the side of the images that it reads first.
        speed_m_per_s, turn_deg_per_s: standard deviations of each component of the camera's speed and angular speed
            while it moves; 0 for the server's defaults.
        scenes: up to 64 scenes, among which that of each image is found.
        group: labels by name that such scenes have; {} for all.
        allow_adoption: whether images may be kept as references, where the scene adopts.
    """

    scene: str = ""
    map_frame: str = "map"
    odom_frame: str = "odom"
    base_frame: str = "base_link"
    rate_hz: float = 1.0
    use_last_pose: bool = False
    coverage: float = 0.0
    timeout_s: float = 5.0
    sequence_length: int = 0
    mask: ImageSource | None = None
    readout_s: float = 0.0
    readout_direction: ReadoutDirection | str = ReadoutDirection.TOP_TO_BOTTOM
    speed_m_per_s: float = 0.0
    turn_deg_per_s: float = 0.0
    scenes: Sequence[str] = ()
    group: Mapping[str, str] | None = None
    allow_adoption: bool = False

    def __post_init__(self) -> None:
        self._check_scenes()
        if not self.map_frame or self.map_frame in (self.odom_frame, self.base_frame):
            raise ValueError(f"map_frame must differ from odom_frame and base_frame, and is {self.map_frame!r}")
        if not 0 <= self.rate_hz <= 1000:
            raise ValueError(f"rate must be 0 to 1000 images a second, is {self.rate_hz:g}")
        if not self.timeout_s > 0:
            raise ValueError(f"timeout must be above 0 s, is {self.timeout_s:g}")
        self._check_shutter()
        if self.sequence_length not in (0, *range(2, 17)):
            raise ValueError(f"sequence_length must be 0 or 2 to 16 images, is {self.sequence_length}")
        if self.sequence_length and not self.odom_frame:
            raise ValueError("sequence_length needs odom_frame: sequences are images with the odometry between them")

    def _check_scenes(self) -> None:
        given = [bool(self.scene), bool(self.scenes), self.group is not None]
        if not any(given):
            raise ValueError("scene is empty: name the scene to localize in, or give scenes or a group")
        if sum(given) > 1:
            raise ValueError("only one of scene, scenes and group may be given")
        if self.scene:
            return
        if self.map_frame.count(SCENE) != 1 or not self.map_frame.replace(SCENE, ""):
            needed = f"map_frame must have {SCENE} among several scenes, such as map_{SCENE}: each has a world"
            raise ValueError(f"{needed}; is {self.map_frame!r}")
        if self.sequence_length:
            raise ValueError("sequence_length needs scene: the images of a sequence are of one scene")

    def map_frame_of(self, scene: str) -> str:
        """The frame of a scene's world; the scene's name or id may be empty if one scene is given."""
        return self.map_frame if self.scene else self.map_frame.replace(SCENE, scene.rpartition("/")[2])

    def scene_of(self, map_frame: str) -> str | None:
        """Id of the scene whose world is in a frame, empty if one scene is given; None if no scene's is."""
        if self.scene:
            return "" if map_frame == self.map_frame else None
        before, _, after = self.map_frame.partition(SCENE)
        scene = map_frame[len(before) : len(map_frame) - len(after)]
        return scene if scene and map_frame == f"{before}{scene}{after}" else None

    def _check_shutter(self) -> None:
        for name, value, most, unit in (
            ("readout_s", self.readout_s, MAX_READOUT_S, "s"),
            ("speed_m_per_s", self.speed_m_per_s, MAX_SPEED_M_PER_S, "m/s"),
            ("turn_deg_per_s", self.turn_deg_per_s, MAX_TURN_DEG_PER_S, "degrees/s"),
        ):
            if not 0 <= value <= most:
                raise ValueError(f"{name} must be 0 to {most:g} {unit}, is {value:g}")
            if value and not self.readout_s:
                raise ValueError(f"{name} is of a rolling shutter, and readout_s is 0")
        known = [it.value for it in ReadoutDirection]
        if self.readout_direction not in known:
            raise ValueError(f"readout_direction must be one of {', '.join(known)}, is {self.readout_direction!r}")

    @property
    def uncertainty(self) -> IntrinsicsUncertainty | None:
        """The read-out of the images' shutter, for a request; None for a global shutter."""
        if not self.readout_s:
            return None
        return IntrinsicsUncertainty(
            readout_s=self.readout_s,
            readout_direction=self.readout_direction,
            speed_m_per_s=self.speed_m_per_s,
            turn_deg_per_s=self.turn_deg_per_s,
        )
