"""Knowledge of a camera's pose before its photograph is compared with references: limits and likely values.

Limits are hard: references beyond them are not considered, and a pose beyond them is rejected. Likely values narrow the
choice of references, too, but not to nothing, and never reject a pose.
"""

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform
from mapless_server.bounds import check_bounds
from mapless_server.method.bundle.priors import PosePrior, PositionPrior, Priors

PRIOR_MARGIN_M = 10.0
"""References further than this from where the camera may be are not considered: they see other things."""

PRIOR_MARGIN_DEG = 60.0
"""References that look further than this outside a cone are not considered: two cameras with the usual 60 degrees of
view then have nothing in common."""

REACH_SIGMA = 4.0
"""Standard deviations within which the camera is likely: 1 of 2000 is further out in three dimensions."""


@dataclass(frozen=True, eq=False)
class Sphere:
    """The camera is within `radius_m` of `position` (3,), world, metres."""

    position: Array
    radius_m: float

    def distance_m(self, position: Array) -> float:
        """Distance of a position from the sphere's surface, metres; negative inside."""
        return float(np.linalg.norm(position - self.position)) - self.radius_m

    def keeps(self, centres: Array, margin_m: float | Array) -> NDArray[np.bool_]:
        """Mask (N,) of the centres (N, 3) that are outside by at most the margin, one for all or each its own (N,)."""
        # Not squared: a radius may be any number.
        return np.asarray(np.linalg.norm(centres - self.position, axis=1) <= self.radius_m + margin_m)


@dataclass(frozen=True, eq=False)
class Ellipsoid:
    """The camera is likely within `REACH_SIGMA` standard deviations (covariance (3, 3)) of `position` (3,), world."""

    position: Array
    covariance: Array

    def keeps(self, centres: Array, margin_m: float) -> NDArray[np.bool_]:
        """Mask (N,) of the centres (N, 3) in the ellipsoid with each half-axis longer by the margin."""
        half_axes_m, away_m = self._away(centres, margin_m)
        away = away_m / half_axes_m
        return np.asarray(np.einsum("ij,ij->i", away, away) <= 1)

    def reaches(self, centres: Array, radii_m: Array, margin_m: float) -> NDArray[np.bool_]:
        """Mask (N,) of the spheres that may contain a centre that `keeps` keeps, by centres (N, 3) and radii (N,).

        The others are apart from the longer ellipsoid along one of its axes, or along the line from its centre. A few
        that are apart from it in no such direction are kept, too.
        """
        half_axes_m, away_m = self._away(centres, margin_m)
        lengths_m = np.linalg.norm(away_m, axis=1)
        along = away_m / np.maximum(lengths_m, np.finfo(float).tiny)[:, None]
        is_apart = lengths_m > np.linalg.norm(half_axes_m * along, axis=1) + radii_m
        is_apart |= (np.abs(away_m) > half_axes_m + radii_m[:, None]).any(axis=1)
        return np.asarray(~is_apart)

    def _away(self, centres: Array, margin_m: float) -> tuple[Array, Array]:
        """Half-axes (3,) longer by the margin, and the vectors (N, 3) from the centre along these axes, metres."""
        variances, axes = np.linalg.eigh(self.covariance)
        return REACH_SIGMA * np.sqrt(variances.clip(min=0)) + margin_m, (centres - self.position) @ axes


@dataclass(frozen=True, eq=False)
class Cone:
    """The camera looks along `forward` (3,), unit length, world, within `max_angle_deg`."""

    forward: Array
    max_angle_deg: float

    def __post_init__(self) -> None:
        if not abs(float(np.linalg.norm(self.forward)) - 1) < 1e-3:
            raise ValueError(f"Cone.forward must have unit length, is {self.forward}")
        check_bounds(self, "max_angle_deg", at_least=0, at_most=180)

    def angle_deg(self, axis: Array) -> float:
        """Angle of an optical axis (3,) of unit length outside the cone; negative inside."""
        return float(np.degrees(np.arccos(np.clip(self.forward @ axis, -1.0, 1.0)))) - self.max_angle_deg

    def keeps(self, axes: Array, margin_deg: float) -> NDArray[np.bool_]:
        """Mask (N,) of the optical axes (N, 3) that are outside the cone by at most the margin."""
        widest_deg = self.max_angle_deg + margin_deg
        if widest_deg >= 180:
            return np.ones(len(axes), bool)
        # A hundredth of a degree allows for rounding.
        return np.asarray(axes @ self.forward >= math.cos(math.radians(widest_deg + 0.01)))


@dataclass(frozen=True, eq=False)
class Narrowing:
    """Defines which references are considered; all if nothing is known.

    Attributes:
        position: limit of the camera's position.
        heading: limit of the camera's heading.
        margin_m: how far outside of the sphere or an ellipsoid a reference may be.
        margin_deg: how far outside of a cone it may look.
        likely_positions: where the camera likely is; all hold at once.
        likely_headings: where it likely looks; all hold at once.
    """

    position: Sphere | None = None
    heading: Cone | None = None
    margin_m: float = PRIOR_MARGIN_M
    margin_deg: float = PRIOR_MARGIN_DEG
    likely_positions: tuple[Ellipsoid, ...] = ()
    likely_headings: tuple[Cone, ...] = ()

    @staticmethod
    def of(priors: Priors) -> "Narrowing":
        """Makes the likely values of priors; gravity gives none."""
        positions, headings = [], []
        for prior in priors:
            if isinstance(prior, PositionPrior):
                positions.append(Ellipsoid(prior.position, prior.covariance))
            elif isinstance(prior, PosePrior):
                pose, covariance = prior.world_from_camera, prior.covariance
                positions.append(Ellipsoid(pose.translation, covariance[:3, :3]))
                sigma = math.sqrt(float(np.linalg.eigvalsh(covariance[3:, 3:])[-1]))
                headings.append(_likely(pose.rotation[:, 2], math.degrees(sigma)))
        if priors.heading is not None:
            headings.append(_likely(priors.heading.in_world, priors.heading.sigma_deg))
        return Narrowing(likely_positions=tuple(positions), likely_headings=tuple(headings))

    @property
    def is_empty(self) -> bool:
        """Whether nothing is known."""
        return not (self.position or self.heading or self.likely_positions or self.likely_headings)

    @property
    def has_likely(self) -> bool:
        """Whether soft priors narrow the choice."""
        return bool(self.likely_positions or self.likely_headings)

    @property
    def limits(self) -> "Narrowing":
        """The hard limits alone."""
        return replace(self, likely_positions=(), likely_headings=())

    @property
    def centre(self) -> Array | None:
        """Approximate position (3,) of the camera in the world; None if unknown."""
        if self.position is not None:
            return self.position.position
        return self.likely_positions[0].position if self.likely_positions else None

    def contradiction(self, world_from_camera: RigidTransform, unit: str = "m") -> str:
        """Names the limit, without margins, that a pose violates; empty if none. `unit` is the scene's, in the text."""
        if self.position is not None:
            outside_m = self.position.distance_m(world_from_camera.translation)
            if outside_m > 0:
                radius = f"{self.position.radius_m:g} {unit}"
                return f"the pose lies {outside_m:.2f} {unit} outside the prior's radius of {radius}"
        if self.heading is not None:
            outside_deg = self.heading.angle_deg(world_from_camera.rotation[:, 2])
            if outside_deg > 0:
                angle_deg = self.heading.max_angle_deg
                return f"the pose looks {outside_deg:.1f} degrees outside the prior's angle of {angle_deg:g} degrees"
        return ""

    def keeps(self, centres: Array, axes: Array) -> NDArray[np.bool_]:
        """Mask (N,) of the cameras that are considered, by centres (N, 3) and optical axes (N, 3) in the world."""
        kept = np.ones(len(centres), bool)
        if self.position is not None:
            kept &= self.position.keeps(centres, self.margin_m)
        if self.heading is not None:
            kept &= self.heading.keeps(axes, self.margin_deg)
        likely = kept.copy()
        for position in self.likely_positions:
            likely &= position.keeps(centres, self.margin_m)
        for heading in self.likely_headings:
            likely &= heading.keeps(axes, self.margin_deg)
        # If no reference is likely, a prior is wrong, which the pose will show; the limits still hold.
        return likely if likely.any() else kept

    def reaches(self, centres: Array, radii_m: Array) -> NDArray[np.bool_]:
        """Mask (N,) of the spheres that may contain cameras that `keeps` keeps, by their centres (N, 3) and radii (N,).

        All true where no sphere is within the limits; likely values hold among those that are, as far as any is likely.
        """
        kept = np.ones(len(centres), bool)
        if self.position is not None:
            kept &= self.position.keeps(centres, self.margin_m + radii_m)
        likely = kept.copy()
        for position in self.likely_positions:
            likely &= position.reaches(centres, radii_m, self.margin_m)
        return next((it for it in (likely, kept) if it.any()), np.ones(len(centres), bool))


ANYWHERE = Narrowing()
"""The narrowing of queries without priors: none."""


def _likely(forward: Array, sigma_deg: float) -> Cone:
    return Cone(forward, min(180.0, REACH_SIGMA * sigma_deg))
