"""What is known of where the camera is and where it looks, before its photograph is compared with any."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

PRIOR_MARGIN_M = 10.0
"""References further from a prior's sphere than this are not considered: they see other things."""

PRIOR_MARGIN_DEG = 60.0
"""References that look further beside a prior's cone than this are not considered: two cameras with the usual 60
degrees of view have then nothing in common."""


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """The camera is within `radius_m` of `position` (3,), world, metres."""

    position: Array
    radius_m: float

    def distance_m(self, position: Array) -> float:
        """How far from the sphere's surface a position lies; negative inside."""
        return float(np.linalg.norm(position - self.position)) - self.radius_m


@dataclass(frozen=True, eq=False)
class HeadingPrior:
    """The camera looks along `forward` (3,), unit length, world, give or take `max_angle_deg`."""

    forward: Array
    max_angle_deg: float

    def __post_init__(self) -> None:
        if not (abs(float(np.linalg.norm(self.forward)) - 1) < 1e-3 and 0 <= self.max_angle_deg <= 180):
            raise ValueError(f"senseless heading: {self.forward}, {self.max_angle_deg} degrees")

    def angle_deg(self, axis: Array) -> float:
        """How far beside the cone an optical axis (3,) of unit length points; negative inside."""
        return float(np.degrees(np.arccos(np.clip(self.forward @ axis, -1.0, 1.0)))) - self.max_angle_deg


@dataclass(frozen=True, eq=False)
class Narrowing:
    """Which references come into question; without anything known, all do.

    Attributes:
        position: of the camera.
        heading: of the camera.
        margin_m: how far beyond the prior's sphere a reference may stand.
        margin_deg: how far beside the prior's cone it may look.
    """

    position: PositionPrior | None = None
    heading: HeadingPrior | None = None
    margin_m: float = PRIOR_MARGIN_M
    margin_deg: float = PRIOR_MARGIN_DEG

    @property
    def is_empty(self) -> bool:
        """Whether nothing is known."""
        return self.position is None and self.heading is None

    def contradiction(self, world_from_camera: RigidTransform) -> str:
        """What speaks against a pose of the camera itself, without the margins; empty if nothing does."""
        if self.position is not None:
            outside_m = self.position.distance_m(world_from_camera.translation)
            if outside_m > 0:
                return f"the pose lies {outside_m:.2f} m outside the prior's radius of {self.position.radius_m:g} m"
        if self.heading is not None:
            outside_deg = self.heading.angle_deg(world_from_camera.rotation[:, 2])
            if outside_deg > 0:
                angle_deg = self.heading.max_angle_deg
                return f"the pose looks {outside_deg:.1f} degrees outside the prior's angle of {angle_deg:g} degrees"
        return ""

    def keeps(self, centres: Array, axes: Array) -> NDArray[np.bool_]:
        """Whether cameras come into question, (N,), by centres (N, 3) and optical axes (N, 3), world."""
        kept = np.ones(len(centres), bool)
        if self.position is not None:
            away = centres - self.position.position
            kept &= np.einsum("ij,ij->i", away, away) <= (self.position.radius_m + self.margin_m) ** 2
        if self.heading is not None:
            widest_deg = self.heading.max_angle_deg + self.margin_deg
            if widest_deg < 180:
                # A hundredth of a degree forgives rounding.
                kept &= axes @ self.heading.forward >= np.cos(np.radians(widest_deg + 0.01))
        return kept
