"""Comparison of a reference with neighbours: whether its pose and focal length fit, and if not, which would fit.

It also compares two references: whether they are the same photograph, or show the same view.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property

import numpy as np

from mapless.geometry import Array, RigidTransform
from mapless_server.method.bundle.estimate import PosedSupport, PoseEstimate, PoseStage
from mapless_server.method.features.views import Matches, PosedView
from mapless_server.method.judge.judge import JudgeOptions, judge
from mapless_server.method.optim.optimize import world_covariance
from mapless_server.method.options import LocalizeOptions
from mapless_server.method.pairs.readings.repeats import pose_difference
from mapless_server.method.pose.pnp import MIN_MATCHES, PnpOptions, false_alarms, ransac
from mapless_server.method.significance import least_sigmas
from mapless_server.method.structure.model import PixelPoints, PointMatches

from .neighbourhood import Neighbourhood, PairMatches, build_neighbourhood, match_points, observed_points
from .resection import CameraFit, Free, ObservedPoints, fit_camera
from .verdict import AuditVerdict

_RANSAC = PnpOptions(min_iterations=1000, inlier_px=6.0)
"""Wider than for queries: a focal length that is off by 5 % shifts pixels by 6 px before a pose compensates for it."""

_INFLATION = 2.0
"""Factor on standard deviations, because errors of neighbouring keypoints are correlated."""


# Measured on six real scenes with 8 to 60 references, unaltered and with planted faults.
POSITION_TOLERANCE_M = 0.035
"""Smaller offsets are no fault. Of unaltered kitchen, fountain, church and office references the worst is off by 0.027,
and faults of 0.05 are found to be 0.043 to 0.059."""
ROTATION_TOLERANCE_DEG = 1.0
"""Smaller rotations are no fault: the worst unaltered one is 0.65, and faults of 2 are found to be 1.8 to 2.15."""
_FOCAL_TOLERANCE = 0.02
"""Smaller errors of the focal length, as a share, are no fault: the worst unaltered one is 0.007, and faults of 0.05
are found to be 0.045 to 0.055."""
SIGNIFICANCE_SIGMA = 3.0
"""A pose is wrong only if its offset also exceeds this many of its own standard deviations along its direction (from
the matches, doubled as in the method's final adjustment)."""
_NEIGHBOUR_NOISE = 3.0
"""A pose is wrong only if its offset also exceeds this many times the median offset of its neighbours: if all poses are
off by 10 cm, as at one end of a drive with GPS poses, no single one is at fault."""
_MIN_INLIERS = 25
"""With fewer there is no verdict. Repeated texture has given up to 23 wrong ones."""
_MAX_LOG10_FALSE_ALARMS = -6.0
"""Bound of chance as for acceptance (`pnp.MAX_LOG10_FALSE_ALARMS`), with a reserve, since an audit makes
thousands of decisions."""
_BOTH_EXCESS = 2.0
"""If a changed pose alone and a changed focal length alone leave more robust cost per match than this, both are wrong.
One true cause leaves up to 0.75, two leave 4."""
_SAME_PHOTOGRAPH_PX, _SAME_PHOTOGRAPH_SHARE = 0.5, 0.7
"""The median shift of the keypoints of one photograph, recompressed, is smaller, and the share that matches larger."""
_SAME_VIEW_SHARE, _SAME_VIEW_MATCHED_SHARE = 0.003, 0.3
"""The same for equivalent views; the shift as a share of the image's width."""


_CHANGED = {
    AuditVerdict.WRONG_POSE: Free.POSE,
    AuditVerdict.WRONG_INTRINSICS: Free.FOCAL,
    AuditVerdict.WRONG_POSE_AND_INTRINSICS: Free.BOTH,
}
"""The part that is wrong, by the alarm that names it."""


@dataclass(frozen=True, eq=False)
class Comparison:
    """A reference compared with neighbours: the points that are matched in it, and the matches with each neighbour.

    The fits are by what they may change; too few matches have none.
    """

    subject: PosedView
    neighbourhood: Neighbourhood
    matches: PointMatches
    neighbour_matches: tuple[Matches, ...]
    points: ObservedPoints
    fits: dict[Free, CameraFit]

    @cached_property
    def is_usable(self) -> bool:
        """Whether enough matches agree with any fit."""
        if not self.fits:
            return False
        camera, inliers = self.subject.view.camera, self.fits[Free.BOTH].inlier_count
        chance = np.pi * _RANSAC.inlier_px**2 / (camera.width_px * camera.height_px)
        expected = false_alarms(len(self.points), inliers, float(chance))
        return inliers >= _MIN_INLIERS and expected <= _MAX_LOG10_FALSE_ALARMS

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

    def focal_is_right(self, free: Free) -> bool:
        """Whether a fit's focal length is the given one, within the tolerance and what is not significant."""
        fit, rows = self.fits[free], list(free.value)
        variance = np.linalg.inv(fit.information[np.ix_(rows, rows)] + 1e-9 * np.eye(len(rows)))[-1, -1]
        sigma = _INFLATION * float(np.sqrt(max(variance, 0.0)))
        ratio = fit.camera.focal_x_px / self.subject.view.camera.focal_x_px
        return abs(ratio - 1) <= max(_FOCAL_TOLERANCE, least_sigmas(tested=1) * sigma)

    def excess(self, free: Free) -> float:
        """Robust cost per match of a fit, minus that of the fit that may change everything."""
        best = self.fits[Free.BOTH]
        return (self.fits[free].cost - best.cost) / max(best.inlier_count, 1)

    def verdict(self, noise_m: float = 0.0, noise_deg: float = 0.0) -> AuditVerdict:
        """Verdict by the smallest change that fits the matches; the noise is the median offset of the neighbours."""
        if not self.is_usable:
            return AuditVerdict.UNVERIFIABLE
        focal_could_be = self.excess(Free.FOCAL) < self.excess(Free.POSE)
        focal_is_right = self.focal_is_right(Free.FOCAL)
        if self.severity(noise_m, noise_deg) <= 1 and (focal_is_right or not focal_could_be):
            return AuditVerdict.CONSISTENT
        # With both free, what is right stays, unless the scene is too flat to distinguish them.
        pose_stays = self.severity(noise_m, noise_deg, self.fits[Free.BOTH].world_from_camera) <= 1
        focal_stays = self.focal_is_right(Free.BOTH)
        if not pose_stays and not focal_stays:
            if min(self.excess(Free.POSE), self.excess(Free.FOCAL)) > _BOTH_EXCESS:
                return AuditVerdict.WRONG_POSE_AND_INTRINSICS
        elif pose_stays != focal_stays:
            focal_could_be = pose_stays
        if not focal_could_be:
            return AuditVerdict.WRONG_POSE
        return AuditVerdict.UNVERIFIABLE if focal_is_right else AuditVerdict.WRONG_INTRINSICS

    def objection(self, verdict: AuditVerdict) -> str:
        """Why the camera that a verdict is based on does not suffice to contradict the given one; empty if it does.

        It must explain more, and a query with it must pass the checks of answers.
        """
        if verdict is AuditVerdict.UNVERIFIABLE:
            return "another pose fits less well than a focal length that is right within the tolerance"
        fit = self.fits[_CHANGED[verdict]]
        if fit.inlier_count < _MIN_INLIERS:
            return f"{fit.inlier_count} matches agree with another camera, {_MIN_INLIERS} are needed"
        if fit.inlier_count <= (given := self.fits[Free.NOTHING].inlier_count):
            return f"{fit.inlier_count} matches agree with another camera, and {given} with the given one"
        estimate = PoseEstimate(
            fit.world_from_camera, PoseStage.REFINED, fit.inliers, fit.error_px, self._covariance_of(fit)
        )
        query, hood = replace(self.subject.view, camera=fit.camera), self.neighbourhood
        matched = self.matches, np.zeros(3), tuple(self.neighbour_matches)
        support = PosedSupport(query, hood.references, hood.structure, *matched, estimate=estimate)
        rejection = judge(support, LocalizeOptions().coverage, JudgeOptions()).rejection
        return f"another camera fits, but would be rejected as an answer: {rejection.message}" if rejection else ""

    def severity(
        self, noise_m: float = 0.0, noise_deg: float = 0.0, world_from_camera: RigidTransform | None = None
    ) -> float:
        """Distance of a pose, by default the fitted one, from the given one, as a multiple of the tolerance.

        What the given pose states of its own errors, at 95 %, is tolerated.
        """
        sigma, noise = SIGNIFICANCE_SIGMA, _NEIGHBOUR_NOISE
        stated = self.subject.provenance.accuracy
        own_m, own_deg = (stated.position_95_m, stated.rotation_95_deg) if stated else (0.0, 0.0)
        allowed_m = max(POSITION_TOLERANCE_M, sigma * self.sigma_m, noise * noise_m, own_m)
        allowed_deg = max(ROTATION_TOLERANCE_DEG, sigma * self.sigma_deg, noise * noise_deg, own_deg)
        off_m, off_deg = self.distance(world_from_camera or self.world_from_camera)
        return max(off_m / allowed_m, off_deg / allowed_deg)

    @cached_property
    def _covariance(self) -> Array:
        return self._covariance_of(self.fits[Free.POSE])

    @staticmethod
    def _covariance_of(fit: CameraFit) -> Array:
        return _INFLATION**2 * world_covariance(fit.information[:6, :6], fit.world_from_camera)


def compare(subject: PosedView, neighbours: Sequence[PosedView], pairs: PairMatches) -> Comparison:
    """Compares a reference with neighbours, whose poses are used as far as they agree with one another."""
    neighbourhood = build_neighbourhood(neighbours, pairs)
    matches, neighbour_matches = match_points(subject, neighbourhood, pairs)
    points = observed_points(subject, neighbourhood, matches)
    fits: dict[Free, CameraFit] = {}
    if len(points) >= MIN_MATCHES:
        camera, given = subject.view.camera, subject.world_from_camera
        found = ransac(PixelPoints(camera, points.x_in_world, points.pixel), None, _RANSAC)
        starts = (given,) if found is None else (given, found)
        for free in Free:
            # Where there are several minima, more freedom can lead to a worse one.
            narrower = [fits[other] for other in fits if set(other.value) <= set(free.value)]
            fits[free] = min([fit_camera(points, camera, starts, free), *narrower], key=lambda fit: fit.cost)
    return Comparison(subject, neighbourhood, matches, neighbour_matches, points, fits)


class Likeness(Enum):
    """How alike two references are; greater values are more alike."""

    DIFFERENT = 0
    SAME_VIEW = 1
    """Taken from one place in one direction, without parallax between them."""
    SAME_PHOTOGRAPH = 2
    """One photograph, perhaps recompressed."""


def likeness(first: PosedView, second: PosedView, matches: Matches) -> Likeness:
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
    if matched_share < min(_SAME_PHOTOGRAPH_SHARE, _SAME_VIEW_MATCHED_SHARE):
        return Likeness.DIFFERENT
    shift = first.view.features.keypoints[matches[:, 0]] - second.view.features.keypoints[matches[:, 1]]
    shift_px = float(np.median(np.linalg.norm(shift, axis=1)))
    if shift_px < _SAME_PHOTOGRAPH_PX and matched_share >= _SAME_PHOTOGRAPH_SHARE:
        return Likeness.SAME_PHOTOGRAPH
    is_near = shift_px < _SAME_VIEW_SHARE * cameras[0].width_px
    return Likeness.SAME_VIEW if is_near and matched_share >= _SAME_VIEW_MATCHED_SHARE else Likeness.DIFFERENT
