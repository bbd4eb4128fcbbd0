"""The read-out of a photograph by a rolling shutter, as a caller states it; `shutter` has what follows from it."""

import math
from dataclasses import dataclass
from enum import Enum

from mapless_server.bounds import check_bounds

USUAL_TURN_DEG_PER_S = 90.0
"""Standard deviation of the angular speed of cameras that move, where none is stated: of a hand that looks around.
Evidence: rolling-shutter."""


class ReadoutDirection(Enum):
    """The side of the raster that is read first, and last; values are the axis (x, y) along which time runs."""

    TOP_TO_BOTTOM = (0.0, 1.0)
    BOTTOM_TO_TOP = (0.0, -1.0)
    LEFT_TO_RIGHT = (1.0, 0.0)
    RIGHT_TO_LEFT = (-1.0, 0.0)


@dataclass(frozen=True)
class TrackedMotion:
    """The motion of a camera during its read-out, by the tracked poses of other moments.

    Attributes:
        mean: (6,) left perturbation of camera_from_world from the first to the last row, metres and radians.
        left_shift, left_turn: shares, above 0 and at most 1, of the standard deviations that remain beside it.
    """

    mean: tuple[float, ...]
    left_shift: float
    left_turn: float

    def __post_init__(self) -> None:
        check_bounds(self, "left_shift left_turn", above=0, at_most=1)


@dataclass(frozen=True)
class RollingShutter:
    """The read-out of a photograph by a rolling shutter, and what is known of the camera's motion meanwhile.

    Attributes:
        readout_s: time between the first and the last row, seconds.
        direction: which row is the first, in the raster as it is stored.
        speed_m_per_s: standard deviation of each component of the camera's speed; 0 for a motion that moves the image
            as much as the angular speed does.
        turn_deg_per_s: the same of its angular speed; 0 for the usual one.
        tracked: the motion that a device's tracking says; None if it says none.
    """

    readout_s: float
    direction: ReadoutDirection = ReadoutDirection.TOP_TO_BOTTOM
    speed_m_per_s: float = 0.0
    turn_deg_per_s: float = 0.0
    tracked: TrackedMotion | None = None

    def __post_init__(self) -> None:
        check_bounds(self, "readout_s", above=0)
        check_bounds(self, "speed_m_per_s turn_deg_per_s", at_least=0)

    @property
    def turn(self) -> float:
        """Standard deviation of the rotation about each axis during the read-out, radians."""
        return self.readout_s * math.radians(self.turn_deg_per_s or USUAL_TURN_DEG_PER_S)

    @property
    def shift(self) -> float:
        """Standard deviation of the shift along each axis during the read-out, metres; 0 where no speed is stated."""
        return self.readout_s * self.speed_m_per_s
