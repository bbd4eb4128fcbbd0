"""One look at a reference from given others: whether its pose and focal length fit, and if not, what would."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from mapless.geometry import Array, RigidTransform, rotation_angle_deg
from mapless_server.method.pnp import PnpOptions, ransac
from mapless_server.method.trust.gate import false_alarms
from mapless_server.method.uncertainty.perturbation import world_covariance
from mapless_server.method.views import PosedView

from .neighbourhood import Neighbourhood, PairMatches, build_neighbourhood, sight
from .options import AuditOptions
from .resection import Explanation, Freedom, ObservedPoints, explain
from .verdict import Verdict

_RANSAC = PnpOptions(min_iterations=1000, inlier_px=6.0)
"""Wider than the query's: a focal length that is off by 5 % bends the image by 6 px before a pose makes up for it."""

_INFLATION = 2.0
"""Of standard deviations: errors of neighbouring keypoints go together."""


@dataclass(frozen=True, eq=False)
class Look:
    """What one look found.

    Attributes:
        subject: the reference looked at.
        neighbourhood: the others, and the points they know.
        observed: those of them that the subject shows.
        explanations: by what they may change; empty with too few matches.
        options: of the audit.
    """

    subject: PosedView
    neighbourhood: Neighbourhood
    observed: ObservedPoints
    explanations: dict[Freedom, Explanation]
    options: AuditOptions

    @cached_property
    def is_usable(self) -> bool:
        """Whether enough matches agree on anything to judge by."""
        if not self.explanations:
            return False
        camera, inliers = self.subject.view.camera, self.explanations[Freedom.BOTH].inlier_count
        chance = np.pi * _RANSAC.inlier_px**2 / (camera.width_px * camera.height_px)
        expected = false_alarms(len(self.observed), inliers, float(chance))
        return inliers >= self.options.min_inliers and expected <= self.options.max_log10_false_alarms

    @cached_property
    def offset_m(self) -> float:
        """How far the pose that explains the matches is from the given one."""
        return self.distance(self.world_from_camera)[0]

    @cached_property
    def turn_deg(self) -> float:
        """How far its rotation is."""
        return self.distance(self.world_from_camera)[1]

    def distance(self, world_from_camera: RigidTransform) -> tuple[float, float]:
        """How far a pose is from the given one, metres and degrees."""
        return pose_difference(world_from_camera, self.subject.world_from_camera)

    @cached_property
    def focal_ratio(self) -> float:
        """Focal length that explains the matches with the given pose, by the given focal length."""
        return self.explanations[Freedom.FOCAL].camera.focal_x_px / self.subject.view.camera.focal_x_px

    @property
    def world_from_camera(self) -> RigidTransform:
        """The pose that explains the matches with the given focal length."""
        return self.explanations[Freedom.POSE].world_from_camera

    @cached_property
    def sigma_m(self) -> float:
        """Standard deviation of the offset along itself."""
        covariance = self._covariance[:3, :3]
        return _along(covariance, self._shift)

    @cached_property
    def largest_sigma_m(self) -> float:
        """Standard deviation of the position in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self._covariance[:3, :3])[-1]))

    @cached_property
    def sigma_deg(self) -> float:
        """Standard deviation of the turn, the largest about any axis."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self._covariance[3:, 3:])[-1])))

    @cached_property
    def focal_sigma(self) -> float:
        """Standard deviation of the focal ratio."""
        information = float(self.explanations[Freedom.FOCAL].information[6, 6])
        return float(_INFLATION / np.sqrt(max(information, 1e-12)))

    def excess(self, freedom: Freedom) -> float:
        """Robust cost per match above that of the freest explanation."""
        best = self.explanations[Freedom.BOTH]
        return (self.explanations[freedom].cost - best.cost) / max(best.inlier_count, 1)

    def verdict(self, noise_m: float = 0.0, noise_deg: float = 0.0) -> Verdict:
        """What explains the matches with the least changes; the noise is what neighbours are off in the median."""
        if not self.is_usable:
            return Verdict.UNVERIFIABLE
        options = self.options
        allowed = max(options.focal_tolerance, options.significance_sigma * self.focal_sigma)
        focal_could_be = self.excess(Freedom.FOCAL) < self.excess(Freedom.POSE)
        if self.severity(noise_m, noise_deg) <= 1 and not (focal_could_be and abs(self.focal_ratio - 1) > allowed):
            return Verdict.CONSISTENT
        # With both free, what is right stays where it is, unless the scene is too flat to tell them apart.
        both = self.explanations[Freedom.BOTH]
        pose_stays = self.severity(noise_m, noise_deg, both.world_from_camera) <= 1
        focal_stays = abs(both.camera.focal_x_px / self.subject.view.camera.focal_x_px - 1) <= allowed
        if pose_stays != focal_stays:
            return Verdict.WRONG_POSE if focal_stays else Verdict.WRONG_INTRINSICS
        if not pose_stays and min(self.excess(Freedom.POSE), self.excess(Freedom.FOCAL)) > options.both_excess:
            return Verdict.WRONG_POSE_AND_INTRINSICS
        return Verdict.WRONG_INTRINSICS if focal_could_be else Verdict.WRONG_POSE

    def severity(
        self, noise_m: float = 0.0, noise_deg: float = 0.0, world_from_camera: RigidTransform | None = None
    ) -> float:
        """How many times a pose, by default the one that explains the matches, is off by what is tolerated."""
        options = self.options
        sigma, noise = options.significance_sigma, options.neighbour_noise
        allowed_m = max(options.position_tolerance_m, sigma * self.sigma_m, noise * noise_m)
        allowed_deg = max(options.rotation_tolerance_deg, sigma * self.sigma_deg, noise * noise_deg)
        off_m, off_deg = self.distance(world_from_camera or self.world_from_camera)
        return max(off_m / allowed_m, off_deg / allowed_deg)

    @property
    def _shift(self) -> Array:
        return np.asarray(self.world_from_camera.translation - self.subject.world_from_camera.translation)

    @cached_property
    def _covariance(self) -> Array:
        information = self.explanations[Freedom.POSE].information[:6, :6]
        return _INFLATION**2 * world_covariance(information, self.world_from_camera)


def look_at(subject: PosedView, neighbours: Sequence[PosedView], pairs: PairMatches, options: AuditOptions) -> Look:
    """Looks at a reference from these others, whose poses it believes as far as they agree with one another."""
    neighbourhood = build_neighbourhood(neighbours, pairs, options.epipolar_px, options.structure)
    observed = sight(subject, neighbourhood, pairs)
    explanations = {}
    if len(observed) >= _RANSAC.min_matches:
        camera, given = subject.view.camera, subject.world_from_camera
        found = ransac(camera, observed.x_in_world, observed.pixel, None, _RANSAC)
        starts = (given,) if found is None else (given, found)
        explanations = {freedom: explain(observed, camera, starts, freedom, options.resection) for freedom in Freedom}
    return Look(subject, neighbourhood, observed, explanations, options)


def pose_difference(first: RigidTransform, second: RigidTransform) -> tuple[float, float]:
    """Distance of the centres in metres, and angle between the rotations in degrees."""
    apart_m = float(np.linalg.norm(first.translation - second.translation))
    return apart_m, rotation_angle_deg(first.rotation @ second.rotation.T)


def _along(covariance: Array, direction: Array) -> float:
    length = float(np.linalg.norm(direction))
    if not length > 0:
        return float(np.sqrt(np.linalg.eigvalsh(covariance)[-1]))
    unit = direction / length
    return float(np.sqrt(np.clip(unit @ covariance @ unit, 0.0, None)))
