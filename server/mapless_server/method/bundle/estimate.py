"""A pose, its support and its radii, which errors do not exceed with a given probability.

These are the data between the estimators and the judge. Errors grow with the gap: the distance to the nearest reference
that holds the pose, as a share of the depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mapless.geometry import Array, Camera, RigidTransform

from ..features.views import Matches, PosedView, ReferenceErrors, View
from ..significance import HEAVY_TAIL
from ..structure.model import PointMatches, Structure
from .priors import IntrinsicsSigma, PriorCheck, sharpened

if TYPE_CHECKING:  # services do not load what computes
    from .intrinsics import IntrinsicsEvidence


class PoseStage(str, Enum):
    """The stage that gave the pose."""

    INITIAL = "initial"
    REFINED = "refined"
    COARSE = "coarse"
    """The initial pose, because there was no time to refine it."""


@dataclass(frozen=True)
class DepthCheck:
    """How the depth that was measured with a photograph compares with its matches at a pose.

    Attributes:
        keypoint_count: keypoints of the photograph that have a depth.
        compared_count: inliers with a depth, on points whose own depth does not come from this photograph.
        agreeing_count: those of them whose depths agree within the errors of sensor and points.
        factor: the most probable factor by which the measured depths are longer than those of the pose; 0 for none.
        factor_sigma: its standard deviation, as a share.
        conflict: whether the depths contradict the pose, or their own matches, or cannot be metres.
        used: whether the depths contributed to the pose: improved it, or gave points.
        median: median of the whole depth image, in the unit of poses; 0 for none.
        point_count: inliers on points whose distance these depths give.
    """

    keypoint_count: int = 0
    compared_count: int = 0
    agreeing_count: int = 0
    factor: float = 0.0
    factor_sigma: float = 0.0
    conflict: bool = False
    used: bool = False
    median: float = 0.0
    point_count: int = 0


NO_DEPTH = DepthCheck()
"""Nothing was compared."""


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose, before it is accepted or rejected.

    Attributes:
        world_from_camera: metric.
        stage: the stage that gave it.
        inliers: (M,) which of the matches are inliers.
        errors_px: (M,) reprojection errors; NaN for points behind the camera.
        covariance: (6, 6), order x y z rx ry rz, fixed world axes, metres and radians.
        prior_checks: comparison with each prior.
        is_adjusted: whether the pose is that of the adjustment. The covariance of another is from the residuals alone
            and leaves out correlated errors (see `adjust.with_covariance`).
        without_priors: the estimate before priors were used; None if none was used.
        intrinsics: evidence of the matches with points about errors of the photograph's intrinsics, which the
            covariance of an adjusted pose contains; None without an adjustment.
        view: the photograph's view with the intrinsics of the estimate, if it contradicts the given ones; else None.
        depth_check: how the photograph's depth compares with the pose; None without depth.
        depth_log10_chance: log10 of the chance that a wrong pose agrees with it so; above 0 if it contradicts the pose.
        motion_covariance: (6, 6) the part of the covariance by the camera's motion during a rolling shutter's read-out;
            None without one.
        reference_covariance: (6, 6) the part of the covariance by what adopted references are off in common (see
            `stated`); None without such.
    """

    world_from_camera: RigidTransform
    stage: PoseStage
    inliers: NDArray[np.bool_]
    errors_px: Array
    covariance: Array
    prior_checks: tuple[PriorCheck, ...] = ()
    is_adjusted: bool = False
    without_priors: PoseEstimate | None = None
    intrinsics: IntrinsicsEvidence | None = None
    view: View | None = None
    depth_check: DepthCheck | None = None
    depth_log10_chance: float = 0.0
    motion_covariance: Array | None = None
    reference_covariance: Array | None = None


@dataclass(frozen=True, eq=False)
class TwoViewSupport:
    """Matches of the query with single references, of keypoints that are no inliers through a point.

    Attributes:
        reference: (T,) index of the reference.
        keypoint: (T,) index into the query's keypoints; once for each reference at most.
        reference_keypoint: (T,) index into the reference's keypoints.
        x_in_world: (T, 3) metres, triangulated from both with the query's pose; NaN behind a camera.
        errors_px: (T,) Sampson distances from the epipolar constraint.
        inliers: (T,) which of them agree with the pose.
    """

    reference: NDArray[np.intp]
    keypoint: NDArray[np.intp]
    reference_keypoint: NDArray[np.intp]
    x_in_world: Array
    errors_px: Array
    inliers: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Support:
    """The data that a pose is estimated from.

    Everything is in a world whose origin is the camera centre of the first reference.

    Attributes:
        query: the photograph.
        references: the references, in the order of the structure's tracks.
        structure: metric points and the references' keypoints that observe them.
        matches: matches of the query with the points.
        origin: (3,) origin of this world in the caller's world, metres.
        query_matches: matches of the query with each reference.
        intrinsics_sigma: the caller's standard deviations of the query's intrinsics; None for the usual ones.
        reference_error_px: returns the error of a pair of references, see `agreement`; None if it is not known.
    """

    query: View
    references: tuple[PosedView, ...]
    structure: Structure
    matches: PointMatches
    origin: Array
    query_matches: tuple[Matches, ...] = ()
    intrinsics_sigma: IntrinsicsSigma | None = None
    reference_error_px: ReferenceErrors | None = None

    def posed(self, estimate: PoseEstimate, two_view: TwoViewSupport | None = None) -> PosedSupport:
        """The same data with the pose that is estimated from them, and the photograph's view by its intrinsics."""
        given = vars(self) | {"query": estimate.view or self.query}
        return PosedSupport(**given, estimate=estimate, two_view=two_view)

    def inliers_by_reference(self) -> tuple[int, ...]:
        """Number of inliers on points that each reference observes; 0 without a pose."""
        return (0,) * len(self.references)


@dataclass(frozen=True, eq=False, kw_only=True)
class PosedSupport(Support):
    """The data that a pose is estimated from, and the estimate.

    Attributes:
        estimate: pose and inliers.
        two_view: matches with single references, where the pose rests on them too.
    """

    estimate: PoseEstimate
    two_view: TwoViewSupport | None = None

    def inlier_count(self) -> int:
        """Number of inliers of the estimate, two-view inliers included."""
        of_two_views = 0 if self.two_view is None else int(self.two_view.inliers.sum())
        return int(self.estimate.inliers.sum()) + of_two_views

    def distance_m(self) -> float:
        """Median depth of the inliers' points at the estimate; always positive, and next to 0 without points."""
        return self._distance_m

    @cached_property
    def _distance_m(self) -> float:
        x_in_world = self.structure.x_in_world[self.matches.point[self.estimate.inliers]]
        if self.two_view is not None:
            x_in_world = np.concatenate([x_in_world, self.two_view.x_in_world[self.two_view.inliers]])
        depth_m = self.estimate.world_from_camera.inverse().apply(x_in_world)[:, 2]
        depth_m = depth_m[~np.isnan(depth_m)]
        return max(float(np.median(depth_m)) if len(depth_m) else 0.0, float(np.finfo(float).tiny))

    def inliers_by_reference(self) -> tuple[int, ...]:
        """Number of inliers on points that each reference observes, and of two-view inliers with it."""
        return self._inliers_by_reference

    @cached_property
    def _inliers_by_reference(self) -> tuple[int, ...]:
        seen = observers(self.structure, self.matches.point[self.estimate.inliers])
        if self.two_view is not None:
            seen = np.concatenate([seen, self.two_view.reference[self.two_view.inliers]])
        return tuple(np.bincount(seen, minlength=len(self.references)).tolist())


def determined_intrinsics(support: PosedSupport) -> tuple[Camera, IntrinsicsSigma] | None:
    """The camera that a photograph was read with, in its pixels as sent, and standard deviations after its matches.

    None where the pose has no evidence about the intrinsics.
    """
    evidence, photograph = support.estimate.intrinsics, support.query.photograph
    if evidence is None:
        return None
    focal, x_px, y_px, k1 = np.sqrt(np.diag(evidence.covariance)).tolist()
    shares = focal, max(x_px, y_px) / evidence.given.width_px, k1
    sigma = IntrinsicsSigma(*(min(1.0, it) for it in shares))
    return photograph.camera if photograph else evidence.sent, sigma


def observers(structure: Structure, points: NDArray[np.intp]) -> NDArray[np.intp]:
    """Index of the reference (O,) of each observation of some of the points, by their indices."""
    is_chosen = np.zeros(len(structure.x_in_world), bool)
    is_chosen[points] = True
    return structure.tracks.view[is_chosen[structure.tracks.point]]


TAIL_95 = HEAVY_TAIL
"""Factor on the radius of 95 %, for heavy tails; the covariance is right at 68 %. Evidence: radii."""

SELF_TAIL_95 = 1.3
"""The same for answers of a scene that many answers calibrate: the other one has to cover that scenes differ. Evidence:
first-answers."""


@dataclass(frozen=True)
class Accuracy:
    """Radii: errors not exceeded in 68 and 95 % of cases."""

    position_68_m: float
    position_95_m: float
    rotation_68_deg: float
    rotation_95_deg: float


def accuracy_from_covariance(covariance: Array) -> Accuracy:
    """Radii of a pose's covariance (6, 6): order x y z rx ry rz, metres and radians."""
    shares = np.array([0.68, 0.95])
    position_68_m, position_95_m = error_radii(covariance[:3, :3], shares).tolist()
    rotation_68, rotation_95 = error_radii(covariance[3:, 3:], shares).tolist()
    radii_deg = math.degrees(rotation_68), TAIL_95 * math.degrees(rotation_95)
    return Accuracy(position_68_m, TAIL_95 * position_95_m, *radii_deg)


def with_information(estimate: PoseEstimate, information: Array) -> PoseEstimate:
    """An estimate of whose pose other data give this information J (6, 6), too, so that less of its errors remains.

    The covariance C becomes C' = (C^-1 + J)^-1. Of an error of the estimate K = C' C^-1 = (I + C J)^-1 remains, so the
    part R by adopted references becomes K R K^T.
    """
    covariance, theirs = sharpened(estimate.covariance, information), estimate.reference_covariance
    if theirs is not None:
        # C' contains it as C contains R: K R K^T <= K C K^T = C' C^-1 C' <= C'.
        remaining = np.linalg.inv(np.eye(6) + estimate.covariance @ information)
        theirs = remaining @ theirs @ remaining.T
    return replace(estimate, covariance=covariance, reference_covariance=theirs)


JACKKNIFE_SHARE = 0.6
"""Share of the jackknife's variance where halves count, too; alone it has to contain all of the errors. Evidence:
references-left-out."""

MOST_DISAGREEMENT = 3.0
"""Largest half of the distance between halves that counts, in 68 % radii by the jackknife; beyond, one has failed.
Evidence: references-left-out."""


def with_halves(estimate: PoseEstimate, apart_m: float) -> PoseEstimate:
    """An estimate whose radii contain, too, that the cameras by halves of its data are `apart_m` from each other.

    Two independent halves have twice the variance of both together each, so their cameras are two standard deviations
    apart, and the square of half of the distance estimates the variance. The jackknife, which is linear at the pose,
    does not see how far halves move that fit as well elsewhere. The distance of a few splits varies, so a share of the
    jackknife's variance is added. Turning and stepping aside look alike, so the whole covariance is multiplied. Errors
    of the intrinsics and of adopted references, the same in both halves, count in full. An estimate with priors, which
    halves have not, stays.
    """
    radius_m = accuracy_from_covariance(estimate.covariance).position_68_m
    if estimate.without_priors is not None or not radius_m > 0:
        return estimate
    in_radii = min(apart_m / 2 / radius_m, MOST_DISAGREEMENT)
    covariance = (JACKKNIFE_SHARE + in_radii**2) * estimate.covariance + (1 - JACKKNIFE_SHARE) * _shared(estimate)
    return replace(estimate, covariance=covariance)


def _shared(estimate: PoseEstimate) -> Array:
    """The part (6, 6) of the covariance by errors that are the same in all halves of the data.

    Evidence that contradicts the intrinsics may say more than the covariance contains: no more than this counts.
    """
    by_references = np.zeros((6, 6)) if estimate.reference_covariance is None else estimate.reference_covariance
    if estimate.intrinsics is None:
        return by_references
    found, total = estimate.intrinsics.pose_covariance + by_references, estimate.covariance
    least = max(1.0, *(np.trace(found[part, part]) / np.trace(total[part, part]) for part in (slice(3), slice(3, 6))))
    return np.asarray(found / least)


def error_radii(covariance: Array, probabilities: ArrayLike) -> Array:
    """Lengths (P,) that a zero-mean normal vector of covariance (n, n) does not exceed with probabilities (P,).

    The squared length is a sum of chi-squares weighted by the eigenvalues, approximated by one scaled chi-square with
    the same mean and variance (Satterthwaite): within 4 %, exact if all eigenvalues are equal or all but one vanish.
    """
    probabilities = np.asarray(probabilities, float)
    eigenvalues = np.linalg.eigvalsh(covariance).clip(min=0)
    total = float(eigenvalues.sum())
    if total <= 0:
        return np.zeros(len(probabilities))
    scale = float((eigenvalues**2).sum()) / total
    degrees_of_freedom = total / scale
    from scipy.special import gammaincinv  # here: services import this module, and answer before it is loaded

    return np.asarray(np.sqrt(2 * scale * gammaincinv(degrees_of_freedom / 2, probabilities)), float)


GROWTH = 0.2
"""Exponent of the gap in the ratio of errors to radii, which contain 0.1 of it. Evidence: self-calibration."""

USUAL_GAP = 0.1
"""The gap at which factors are stated."""

LEAST_GAP, LARGEST_GAP = 0.03, 0.5
"""Beyond these, radii do not change with the gap."""

SMALLEST_GAP = 0.01
"""Below, the ratio of errors to radii does not change either. Evidence: self-calibration."""

SUPPORTING_SHARE = 0.1
"""References with fewer inliers, by those of the one with the most, do not hold the pose."""


def viewpoint_gap(support: PosedSupport) -> tuple[float, float]:
    """Distance to the nearest reference that holds the pose, over the median depth of the inliers; and that depth."""
    centres = np.array([it.world_from_camera.translation for it in support.references])
    centre, depth_m = support.estimate.world_from_camera.translation, support.distance_m()
    return holding_distance(centre, centres, support.inliers_by_reference()) / depth_m, depth_m


def holding_distance(centre: Array, reference_centres: Array, inlier_counts: ArrayLike) -> float:
    """Distance of a camera centre (3,) to the nearest of the references (R, 3) that hold its pose, by inliers (R,)."""
    counts = np.asarray(inlier_counts)
    holding = reference_centres[counts >= SUPPORTING_SHARE * counts.max()]
    return float(np.linalg.norm(holding - centre, axis=1).min())


def gap_ratio(gap: float) -> float:
    """The gap by the usual one, within the bounds."""
    return float(np.clip(gap, LEAST_GAP, LARGEST_GAP)) / USUAL_GAP


def growth(gap: float) -> float:
    """Ratio of errors to radii at a gap, relative to that at the usual gap; of positions and of angles."""
    return float((np.clip(gap, SMALLEST_GAP, LARGEST_GAP) / USUAL_GAP) ** GROWTH)
