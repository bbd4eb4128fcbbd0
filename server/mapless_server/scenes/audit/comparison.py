"""Comparison of a reference with neighbours: whether its pose and focal length fit, and if not, which would fit.

It also compares two references: whether they are the same photograph, or show the same view.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from functools import cached_property

import numpy as np

from mapless.geometry import Array, RigidTransform, rotation_angle_deg
from mapless_server.method.options import check_bounds
from mapless_server.method.perturbation import world_covariance
from mapless_server.method.pnp import PnpOptions, ransac
from mapless_server.method.trust.gate import false_alarms
from mapless_server.method.views import Matches, PosedView

from .neighbourhood import Neighbourhood, PairMatches, build_neighbourhood, match_points
from .resection import CameraFit, Free, ObservedPoints, fit_camera
from .verdict import AuditVerdict

_RANSAC = PnpOptions(min_iterations=1000, inlier_px=6.0)
"""Wider than for queries: a focal length that is off by 5 % shifts pixels by 6 px before a pose compensates for it."""

_INFLATION = 2.0
"""Factor on standard deviations, because errors of neighbouring keypoints are correlated."""


@dataclass(frozen=True)
class AuditOptions:
    """Options of an audit; measured on six real scenes with 8 to 60 references, unaltered and with planted faults.

    Attributes:
        position_tolerance_m: smaller offsets are no fault. Of unaltered kitchen, fountain, church and office references
            the worst is off by 0.027, and faults of 0.05 are found to be 0.043 to 0.059.
        rotation_tolerance_deg: smaller rotations are no fault: the worst unaltered one is 0.65, and faults of 2 are
            found to be 1.8 to 2.15.
        focal_tolerance: smaller errors of the focal length, as a share, are no fault: the worst unaltered one is 0.007,
            and faults of 0.05 are found to be 0.045 to 0.055.
        significance_sigma: an offset must also exceed this many of its own standard deviations along its direction
            (from the matches, doubled as in the method's final adjustment).
        neighbour_noise: and this many times the median offset of its neighbours: if all poses are off by 10 cm, as at
            one end of a drive with GPS poses, no single one is at fault.
        candidate_count: number of references, nearest by position and heading, that are matched.
        neighbour_count: number of these, with the most matches, that are used. Points need two, a verdict needs more.
        wide_count: number of references that are matched if the nearest by pose do not show what the photograph shows.
        epipolar_px: as for matching references.
        min_inliers: with fewer there is no verdict. Repeated texture has given up to 23 wrong ones.
        max_log10_false_alarms: as in `GateOptions`, with a reserve, since an audit makes thousands of decisions.
        swap_reach: a reference within this many tolerances of where a photograph was taken may be its partner in a
            swap; many, because that pose was fitted to neighbours of the wrong place.
        both_excess: if a changed pose alone and a changed focal length alone leave more robust cost per match than
            this, both are wrong. One true cause leaves up to 0.75, two leave 4.
        same_photograph_px: median shift of the keypoints of one photograph, recompressed, is smaller.
        same_photograph_share: and the share of them that match is larger.
        same_view_share: median shift of the keypoints of equivalent views is smaller, as a share of the image's width,
        same_view_matched_share: and the share of them that match is larger.
    """

    position_tolerance_m: float = 0.035
    rotation_tolerance_deg: float = 1.0
    focal_tolerance: float = 0.02
    significance_sigma: float = 3.0
    neighbour_noise: float = 3.0
    candidate_count: int = 12
    neighbour_count: int = 8
    wide_count: int = 64
    epipolar_px: float = 2.0
    min_inliers: int = 25
    max_log10_false_alarms: float = -6.0
    swap_reach: float = 4.0
    both_excess: float = 2.0
    same_photograph_px: float = 0.5
    same_photograph_share: float = 0.7
    same_view_share: float = 0.003
    same_view_matched_share: float = 0.3

    def __post_init__(self) -> None:
        check_bounds(self, "position_tolerance_m rotation_tolerance_deg focal_tolerance epipolar_px", above=0)
        check_bounds(self, "significance_sigma neighbour_noise swap_reach both_excess same_photograph_px", above=0)
        check_bounds(self, "candidate_count wide_count", at_least=1)
        check_bounds(self, "neighbour_count", at_least=2)
        check_bounds(self, "min_inliers", at_least=8)
        check_bounds(self, "same_photograph_share same_view_share same_view_matched_share", above=0, at_most=1)


@dataclass(frozen=True, eq=False)
class Comparison:
    """A reference compared with neighbours: the points that are matched in it.

    The fits are by what they may change; too few matches have none.
    """

    subject: PosedView
    neighbourhood: Neighbourhood
    points: ObservedPoints
    fits: dict[Free, CameraFit]
    options: AuditOptions

    @cached_property
    def is_usable(self) -> bool:
        """Whether enough matches agree with any fit."""
        if not self.fits:
            return False
        camera, inliers = self.subject.view.camera, self.fits[Free.BOTH].inlier_count
        chance = np.pi * _RANSAC.inlier_px**2 / (camera.width_px * camera.height_px)
        expected = false_alarms(len(self.points), inliers, float(chance))
        return inliers >= self.options.min_inliers and expected <= self.options.max_log10_false_alarms

    @property
    def world_from_camera(self) -> RigidTransform:
        """The pose that fits the matches with the given focal length."""
        return self.fits[Free.POSE].world_from_camera

    @cached_property
    def offset_m(self) -> float:
        """Distance of the fitted pose from the given one."""
        return self.distance(self.world_from_camera)[0]

    @cached_property
    def turn_deg(self) -> float:
        """Angle between the fitted rotation and the given one."""
        return self.distance(self.world_from_camera)[1]

    def distance(self, world_from_camera: RigidTransform) -> tuple[float, float]:
        """Distance of a pose from the given one, metres and degrees."""
        return pose_difference(world_from_camera, self.subject.world_from_camera)

    @cached_property
    def focal_ratio(self) -> float:
        """Focal length that fits the matches with the given pose, divided by the given focal length."""
        return self.fits[Free.FOCAL].camera.focal_x_px / self.subject.view.camera.focal_x_px

    @cached_property
    def sigma_m(self) -> float:
        """Standard deviation of the offset along itself."""
        covariance = self._covariance[:3, :3]
        shift = self.world_from_camera.translation - self.subject.world_from_camera.translation
        length = float(np.linalg.norm(shift))
        if not length > 0:
            return self.largest_sigma_m
        return float(np.sqrt(np.clip(shift / length @ covariance @ (shift / length), 0.0, None)))

    @cached_property
    def largest_sigma_m(self) -> float:
        """Standard deviation of the position in its worst direction."""
        return float(np.sqrt(np.linalg.eigvalsh(self._covariance[:3, :3])[-1]))

    @cached_property
    def sigma_deg(self) -> float:
        """Standard deviation of the rotation, the largest about any axis."""
        return float(np.degrees(np.sqrt(np.linalg.eigvalsh(self._covariance[3:, 3:])[-1])))

    @cached_property
    def focal_sigma(self) -> float:
        """Standard deviation of the focal ratio."""
        information = float(self.fits[Free.FOCAL].information[6, 6])
        return float(_INFLATION / np.sqrt(max(information, 1e-12)))

    def excess(self, free: Free) -> float:
        """Robust cost per match of a fit, minus that of the fit that may change everything."""
        best = self.fits[Free.BOTH]
        return (self.fits[free].cost - best.cost) / max(best.inlier_count, 1)

    def verdict(self, noise_m: float = 0.0, noise_deg: float = 0.0) -> AuditVerdict:
        """Verdict by the smallest change that fits the matches; the noise is the median offset of the neighbours."""
        if not self.is_usable:
            return AuditVerdict.UNVERIFIABLE
        options = self.options
        allowed = max(options.focal_tolerance, options.significance_sigma * self.focal_sigma)
        focal_could_be = self.excess(Free.FOCAL) < self.excess(Free.POSE)
        if self.severity(noise_m, noise_deg) <= 1 and not (focal_could_be and abs(self.focal_ratio - 1) > allowed):
            return AuditVerdict.CONSISTENT
        # With both free, what is right stays, unless the scene is too flat to distinguish them.
        both = self.fits[Free.BOTH]
        pose_stays = self.severity(noise_m, noise_deg, both.world_from_camera) <= 1
        focal_stays = abs(both.camera.focal_x_px / self.subject.view.camera.focal_x_px - 1) <= allowed
        if pose_stays != focal_stays:
            return AuditVerdict.WRONG_POSE if focal_stays else AuditVerdict.WRONG_INTRINSICS
        if not pose_stays and min(self.excess(Free.POSE), self.excess(Free.FOCAL)) > options.both_excess:
            return AuditVerdict.WRONG_POSE_AND_INTRINSICS
        return AuditVerdict.WRONG_INTRINSICS if focal_could_be else AuditVerdict.WRONG_POSE

    def severity(
        self, noise_m: float = 0.0, noise_deg: float = 0.0, world_from_camera: RigidTransform | None = None
    ) -> float:
        """Distance of a pose, by default the fitted one, from the given one, as a multiple of the tolerance."""
        options = self.options
        sigma, noise = options.significance_sigma, options.neighbour_noise
        allowed_m = max(options.position_tolerance_m, sigma * self.sigma_m, noise * noise_m)
        allowed_deg = max(options.rotation_tolerance_deg, sigma * self.sigma_deg, noise * noise_deg)
        off_m, off_deg = self.distance(world_from_camera or self.world_from_camera)
        return max(off_m / allowed_m, off_deg / allowed_deg)

    @cached_property
    def _covariance(self) -> Array:
        information = self.fits[Free.POSE].information[:6, :6]
        return _INFLATION**2 * world_covariance(information, self.world_from_camera)


def compare(
    subject: PosedView, neighbours: Sequence[PosedView], pairs: PairMatches, options: AuditOptions
) -> Comparison:
    """Compares a reference with neighbours, whose poses are used as far as they agree with one another."""
    neighbourhood = build_neighbourhood(neighbours, pairs, options.epipolar_px)
    points = match_points(subject, neighbourhood, pairs)
    fits = {}
    if len(points) >= _RANSAC.min_matches:
        camera, given = subject.view.camera, subject.world_from_camera
        found = ransac(camera, points.x_in_world, points.pixel, None, _RANSAC)
        starts = (given,) if found is None else (given, found)
        fits = {free: fit_camera(points, camera, starts, free) for free in Free}
    return Comparison(subject, neighbourhood, points, fits, options)


def pose_difference(first: RigidTransform, second: RigidTransform) -> tuple[float, float]:
    """Distance of the centres in metres, and angle between the rotations in degrees."""
    apart_m = float(np.linalg.norm(first.translation - second.translation))
    return apart_m, rotation_angle_deg(first.rotation @ second.rotation.T)


class Likeness(Enum):
    """How alike two references are; greater values are more alike."""

    DIFFERENT = 0
    SAME_VIEW = 1
    """Taken from one place in one direction, without parallax between them."""
    SAME_PHOTOGRAPH = 2
    """One photograph, perhaps recompressed."""


def likeness(first: PosedView, second: PosedView, matches: Matches, options: AuditOptions) -> Likeness:
    """Compares the image positions of two photographs' matches; their poses are not used.

    Photographs of different sizes differ: positions are compared in the pixels that features were found in.
    """
    photographs = first.view.photograph, second.view.photograph
    if photographs[0] is not None and photographs[1] is not None and photographs[0].sha256 == photographs[1].sha256:
        return Likeness.SAME_PHOTOGRAPH
    cameras = first.view.camera, second.view.camera
    if (cameras[0].width_px, cameras[0].height_px) != (cameras[1].width_px, cameras[1].height_px):
        return Likeness.DIFFERENT
    matched_share = len(matches) / max(1, min(len(first.view.features), len(second.view.features)))
    if matched_share < min(options.same_photograph_share, options.same_view_matched_share):
        return Likeness.DIFFERENT
    shift = first.view.features.keypoints[matches[:, 0]] - second.view.features.keypoints[matches[:, 1]]
    shift_px = float(np.median(np.linalg.norm(shift, axis=1)))
    if shift_px < options.same_photograph_px and matched_share >= options.same_photograph_share:
        return Likeness.SAME_PHOTOGRAPH
    is_near = shift_px < options.same_view_share * cameras[0].width_px
    return Likeness.SAME_VIEW if is_near and matched_share >= options.same_view_matched_share else Likeness.DIFFERENT
