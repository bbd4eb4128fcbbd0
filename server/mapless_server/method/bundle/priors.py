"""Priors on the pose of a photograph: position, gravity, heading, a previous pose.

Each prior gives, for a pose, a residual r, its covariance C, and the derivative J of r by the pose error: a shift
(x, y, z) and a rotation (rx, ry, rz) about fixed world axes, as in the covariances of poses (ROS's order). From these:

    distance        m^2 = r^T (C + J Sigma J^T)^-1 r,    Sigma the covariance of a pose estimated without the prior
    cost            r^T C^-1 r,                          which `adjust` and `informed` add to the reprojection errors
    information     J^T C^-1 J,                          which reduces the covariance of the answer.

m^2 of a consistent prior follows a chi-square distribution. A prior beyond the quantile of `CONFLICT_PROBABILITY` is in
conflict with the photograph and is not used: compasses are wrong more often than photographs.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from enum import Enum
from typing import TypeAlias

import numpy as np

from mapless.geometry import Array, Camera, RigidTransform, cross_matrix
from mapless_server.bounds import check_bounds

from ..optim.rotations import rotation_vector

CONFLICT_PROBABILITY = 1e-4
"""Probability that a consistent prior is taken for one in conflict."""

LIKELY_PROBABILITY = 0.01
"""Probability that a consistent prior is not likely, where one of two poses is to be chosen by it."""

MIN_RELATIVE_INFORMATION = 0.1
"""A prior with a smaller share of the photograph's information is not used: it could lower no standard deviation by
more than 5 %."""

UNIT_TOLERANCE = 1e-6
"""Largest deviation of the length of a direction from one."""


class PriorKind(str, Enum):
    """Kinds of priors."""

    POSITION = "position"
    HEADING = "heading"
    GRAVITY = "gravity"
    POSE = "pose"


@dataclass(frozen=True)
class IntrinsicsSigma:
    """Standard deviations of a photograph's intrinsics.

    Attributes:
        focal_share: standard deviation of both focal lengths together, as a share of them. Lenses change by this much
            with focus and temperature, and calibrations are not more repeatable.
        principal_share: standard deviation of each coordinate of the principal point, as a share of the image's width.
        k1: standard deviation of the first radial coefficient.
        is_guess: whether the intrinsics are a guess, which the adjustment improves with the pose, and no calibration.
    """

    focal_share: float = 0.003
    principal_share: float = 0.003
    k1: float = 0.01
    is_guess: bool = False

    def __post_init__(self) -> None:
        check_bounds(self, "focal_share principal_share k1", above=0, at_most=1)

    def of(self, camera: Camera) -> Array:
        """Standard deviations (4,) of s, of the principal point in pixels of this camera, and of k1."""
        principal_px = self.principal_share * camera.width_px
        return np.array([self.focal_share, principal_px, principal_px, self.k1])


@dataclass(frozen=True, eq=False)
class Term:
    """A prior evaluated at a pose.

    Attributes:
        residual: r, (n,).
        jacobian: J, (n, 6): the derivative of r by an error of the pose.
        covariance: C, (n, n), of r at the true pose.
    """

    residual: Array
    jacobian: Array
    covariance: Array

    @property
    def cost(self) -> float:
        """Cost of the prior, r^T C^-1 r."""
        return float(self.residual @ np.linalg.solve(self.covariance, self.residual))

    def gradient_and_information(self) -> tuple[Array, Array]:
        """Half the cost's derivatives (Gauss-Newton): gradient J^T C^-1 r (6,) and information J^T C^-1 J (6, 6)."""
        weighted = np.linalg.solve(self.covariance, self.jacobian).T
        return weighted @ self.residual, weighted @ self.jacobian

    def squared_distance(self, pose_covariance: Array) -> float:
        """Squared distance m^2 to a pose with a covariance (6, 6)."""
        covariance = self.covariance + self.jacobian @ pose_covariance @ self.jacobian.T
        return float(self.residual @ np.linalg.solve(covariance, self.residual))

    def relative_information(self, pose_covariance: Array) -> float:
        """Largest ratio over all directions of the prior's information to that of a pose with a covariance (6, 6)."""
        known = self.jacobian @ pose_covariance @ self.jacobian.T
        return float(np.abs(np.linalg.eigvals(np.linalg.solve(self.covariance, known))).max())


@dataclass(frozen=True, eq=False)
class PositionPrior:
    """A prior on the camera centre.

    Attributes:
        position: (3,) world, metres.
        covariance: (3, 3) square metres.
    """

    position: Array
    covariance: Array
    kind = PriorKind.POSITION
    degrees_of_freedom = 3

    def __post_init__(self) -> None:
        if not (np.shape(self.position) == (3,) and np.isfinite(self.position).all()):
            raise ValueError(f"position must be three finite numbers, is {self.position}")
        check_covariance(self.covariance, 3)

    def term(self, world_from_camera: RigidTransform) -> Term:
        """The term with r = t - position."""
        return Term(world_from_camera.translation - self.position, np.eye(3, 6), self.covariance)

    def loosened(self, factor: float) -> PositionPrior:
        """Returns the prior with its covariance multiplied by a factor."""
        return replace(self, covariance=factor * self.covariance)

    def shifted(self, offset: Array) -> PositionPrior:
        """Returns the prior in a world in which everything lies `offset` (3,) further."""
        return replace(self, position=self.position + offset)


@dataclass(frozen=True, eq=False)
class DirectionPrior:
    """A direction known both in the camera and in the world; the rotation about it is free.

    Attributes:
        in_camera: (3,) unit length.
        in_world: (3,) unit length.
        sigma_deg: standard deviation about each of the two perpendicular axes.
    """

    in_camera: Array
    in_world: Array
    sigma_deg: float
    kind = PriorKind.GRAVITY
    degrees_of_freedom = 2

    def __post_init__(self) -> None:
        for direction in (self.in_camera, self.in_world):
            if not (np.shape(direction) == (3,) and abs(float(np.linalg.norm(direction)) - 1) < UNIT_TOLERANCE):
                raise ValueError(f"a direction must have unit length, is {direction}")
        if not 0 < self.sigma_deg <= 180:
            raise ValueError(f"sigma must be above 0 and at most 180 degrees, is {self.sigma_deg}")

    @property
    def sigma(self) -> float:
        """The standard deviation in radians."""
        return math.radians(self.sigma_deg)

    def term(self, world_from_camera: RigidTransform) -> Term:
        """The term with the chord r = R in_camera - in_world: the angle if small, and longest for opposite directions.

        It has three components, but none along the direction itself, so two degrees of freedom.
        """
        turned = world_from_camera.rotation @ self.in_camera
        jacobian = np.concatenate([np.zeros((3, 3)), -cross_matrix(turned)], axis=1)
        return Term(turned - self.in_world, jacobian, self.sigma**2 * np.eye(3))

    def loosened(self, factor: float) -> DirectionPrior:
        """Returns the prior with its variance multiplied by a factor, up to a sigma of 180 degrees (no information)."""
        return replace(self, sigma_deg=min(180.0, math.sqrt(factor) * self.sigma_deg))


@dataclass(frozen=True, eq=False)
class GravityPrior(DirectionPrior):
    """The direction of gravity, down."""


@dataclass(frozen=True, eq=False)
class HeadingPrior(DirectionPrior):
    """The direction of the optical axis.

    Attributes:
        in_camera: (0, 0, 1).
    """

    kind = PriorKind.HEADING

    @staticmethod
    def looking(in_world: Array, sigma_deg: float) -> HeadingPrior:
        """The prior of an optical axis that points along `in_world` (3,), unit length."""
        return HeadingPrior(np.array([0.0, 0.0, 1.0]), in_world, sigma_deg)


@dataclass(frozen=True, eq=False)
class PosePrior:
    """A prior on the whole pose: a previous answer, continued by the device's tracking.

    Attributes:
        world_from_camera: metric.
        covariance: (6, 6), order x y z rx ry rz, fixed world axes, metres and radians.
    """

    world_from_camera: RigidTransform
    covariance: Array
    kind = PriorKind.POSE
    degrees_of_freedom = 6

    def __post_init__(self) -> None:
        if not np.isfinite(self.world_from_camera.matrix()).all():
            raise ValueError("PosePrior.world_from_camera must be finite")
        check_covariance(self.covariance, 6)

    def term(self, world_from_camera: RigidTransform) -> Term:
        """The term with r = (t - t_prior, Log(R R_prior^T))."""
        turn = rotation_vector(world_from_camera.rotation @ self.world_from_camera.rotation.T)
        shift = world_from_camera.translation - self.world_from_camera.translation
        jacobian = np.eye(6)
        jacobian[3:, 3:] = _log_jacobian(turn)
        return Term(np.concatenate([shift, turn]), jacobian, self.covariance)

    def loosened(self, factor: float) -> PosePrior:
        """Returns the prior with its covariance multiplied by a factor."""
        return replace(self, covariance=factor * self.covariance)

    def shifted(self, offset: Array) -> PosePrior:
        """Returns the prior in a world in which everything lies `offset` (3,) further."""
        return replace(self, world_from_camera=self.world_from_camera.shifted(offset))


Prior: TypeAlias = PositionPrior | HeadingPrior | GravityPrior | PosePrior


@dataclass(frozen=True, eq=False)
class PriorCheck:
    """Comparison of a prior with the pose from the photograph alone.

    Attributes:
        kind: kind of the prior.
        mahalanobis: m, 0 and above.
        degrees_of_freedom: degrees of freedom of m^2.
        conflict: whether the two contradict each other.
        used: whether the prior was used for the pose: not if it is in conflict, nor if it has too little information
            (`MIN_RELATIVE_INFORMATION`).
    """

    kind: PriorKind
    mahalanobis: float
    degrees_of_freedom: int
    conflict: bool
    used: bool

    @property
    def is_likely(self) -> bool:
        """Whether it agrees well: m^2 is below the quantile of `LIKELY_PROBABILITY`."""
        return self.mahalanobis**2 <= chi_square_quantile(self.degrees_of_freedom, LIKELY_PROBABILITY)


@dataclass(frozen=True, eq=False)
class Priors:
    """The priors on one pose; iterates over those that are given."""

    position: PositionPrior | None = None
    heading: HeadingPrior | None = None
    gravity: GravityPrior | None = None
    pose: PosePrior | None = None

    def __iter__(self) -> Iterator[Prior]:
        return iter([p for p in (self.position, self.heading, self.gravity, self.pose) if p is not None])

    def __bool__(self) -> bool:
        return any(True for _ in self)

    def shifted(self, offset: Array) -> Priors:
        """Returns the priors in a world in which everything lies `offset` (3,) further."""
        position, pose = self.position and self.position.shifted(offset), self.pose and self.pose.shifted(offset)
        return replace(self, position=position, pose=pose)

    def check(self, world_from_camera: RigidTransform, covariance: Array) -> tuple[PriorCheck, ...]:
        """Compares each prior with a pose that was estimated without priors and has this covariance (6, 6)."""
        checks = []
        for prior in self:
            term = prior.term(world_from_camera)
            squared = term.squared_distance(covariance)
            conflict = not squared <= conflict_threshold(prior.degrees_of_freedom)
            used = not conflict and term.relative_information(covariance) >= MIN_RELATIVE_INFORMATION
            checks.append(PriorCheck(prior.kind, math.sqrt(squared), prior.degrees_of_freedom, conflict, used))
        return tuple(checks)

    def consistent(self, checks: tuple[PriorCheck, ...]) -> Priors:
        """Returns the priors that are used, with covariances enlarged by their distance.

        The covariance of a prior that is further off than the average consistent one, m^2 > n, is multiplied by m^2 / n
        (Birge's ratio). Right priors lose little weight, and one that is wrong but not in conflict loses most of it.
        """
        used = {check.kind: check for check in checks if check.used}
        kept = {
            prior.kind.value: prior.loosened(max(1.0, used[prior.kind].mahalanobis ** 2 / prior.degrees_of_freedom))
            for prior in self
            if prior.kind in used
        }
        return Priors(**kept)  # type: ignore[arg-type]

    def penalty(self, world_from_camera: RigidTransform) -> float:
        """Sum of the priors' costs, each truncated at the conflict threshold.

        A prior may be wrong altogether, so it counts at most as much as one good match.
        """
        return sum(min(p.term(world_from_camera).cost, conflict_threshold(p.degrees_of_freedom)) for p in self)

    def cost(self, world_from_camera: RigidTransform) -> float:
        """Sum of the priors' costs."""
        return sum(prior.term(world_from_camera).cost for prior in self)

    def gradient_and_information(self, world_from_camera: RigidTransform) -> tuple[Array, Array]:
        """Sums (6,) and (6, 6) of `Term.gradient_and_information`."""
        gradient, information = np.zeros(6), np.zeros((6, 6))
        for prior in self:
            g, h = prior.term(world_from_camera).gradient_and_information()
            gradient += g
            information += h
        return gradient, information

    def log10_chance(self, world_from_camera: RigidTransform) -> float:
        """log10 of the probability that a pose found by chance agrees with gravity and heading; 0 if one disagrees.

        A random direction is within an angle a of the right one with probability (1 - cos a) / 2. Both priors may come
        from one sensor, so only the more accurate one counts. Position and pose priors do not count: they select the
        references and the area in which wrong matches are found.
        """
        directions = [prior for prior in (self.gravity, self.heading) if prior is not None]
        threshold = conflict_threshold(DirectionPrior.degrees_of_freedom)
        if not directions or max(prior.term(world_from_camera).cost for prior in directions) > threshold:
            return 0.0
        angle = min(math.pi, math.sqrt(threshold) * min(prior.sigma for prior in directions))
        return math.log10((1 - math.cos(angle)) / 2)

    def sharpened(self, covariance: Array, world_from_camera: RigidTransform) -> Array:
        """Covariance (6, 6) of a pose refined with these priors, from its covariance (6, 6) without them."""
        if not self:
            return covariance
        _, information = self.gradient_and_information(world_from_camera)
        return sharpened(covariance, information)


NO_PRIORS = Priors()
"""No prior at all."""


def sharpened(covariance: Array, information: Array) -> Array:
    """The covariance (N, N) with this information (N, N) added to what it knows."""
    # (S^-1 + J)^-1 = S (I + J S)^-1, which needs no inverse of S: some directions may be certain in it.
    sharper = np.linalg.solve((np.eye(len(covariance)) + information @ covariance).T, covariance.T).T
    return np.asarray((sharper + sharper.T) / 2)


def conflict_threshold(degrees_of_freedom: int) -> float:
    """The m^2 above which a prior is in conflict."""
    return chi_square_quantile(degrees_of_freedom, CONFLICT_PROBABILITY)


def chi_square_quantile(degrees_of_freedom: int, above: float) -> float:
    """The value above which a chi-square variable lies with this probability."""
    from scipy.special import chdtri  # here: services import this module, and answer before it is loaded

    return float(chdtri(degrees_of_freedom, above))


def check_covariance(covariance: Array, size: int) -> None:
    """Raises ValueError unless the covariance is symmetric, positive definite and of shape (size, size)."""
    c = np.asarray(covariance)
    if c.shape != (size, size) or not np.isfinite(c).all():
        raise ValueError(f"a covariance must be {size}x{size} finite numbers")
    deviations = np.sqrt(np.diag(c).clip(min=0))
    if not deviations.min() > 0:
        raise ValueError(f"a covariance must have variances above 0, the smallest is {np.diag(c).min():.3g}")
    # Compared as correlations: metres and radians, or an unknown height, differ by orders of magnitude.
    correlation = c / np.outer(deviations, deviations)
    if np.abs(correlation - correlation.T).max() > 1e-6:
        raise ValueError("a covariance must be symmetric")
    if not np.linalg.eigvalsh((correlation + correlation.T) / 2).min() > 1e-12:
        raise ValueError("a covariance must be positive definite")


def _log_jacobian(vector: Array) -> Array:
    """Derivative (3, 3) of Log(Exp(w) Exp(vector)) by w at zero: the inverse left Jacobian of SO(3)."""
    angle, k = float(np.linalg.norm(vector)), cross_matrix(vector)
    # (1 - (a / 2) cot(a / 2)) / a^2, which is 1 / 12 where the angle vanishes.
    factor = (1 - angle / 2 / math.tan(angle / 2)) / angle**2 if angle > 1e-4 else 1 / 12
    return np.asarray(np.eye(3) - k / 2 + factor * k @ k)
