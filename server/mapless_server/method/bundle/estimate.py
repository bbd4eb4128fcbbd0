"""A pose and its support: data between the estimators and the judge."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..features.views import Matches, PosedView, ReferenceErrors, View
from ..structure.model import PointMatches, Structure
from .priors import PriorCheck
from .unknowns import IntrinsicsSigma

if TYPE_CHECKING:  # services do not load what computes
    from .intrinsics import IntrinsicsEvidence


class PoseStage(str, Enum):
    """The stage that gave the pose."""

    INITIAL = "initial"
    REFINED = "refined"
    COARSE = "coarse"
    """The initial pose, because there was no time to refine it."""


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
        intrinsics: what the matches with points say of errors of the photograph's intrinsics, which the covariance of
            an adjusted pose contains; None without an adjustment.
        view: the photograph's view with the intrinsics of the estimate, if it contradicts the given ones; else None.
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
        """Median depth of the inliers' points at the estimate; always positive."""
        x_in_world = self.structure.x_in_world[self.matches.point[self.estimate.inliers]]
        if self.two_view is not None:
            x_in_world = np.concatenate([x_in_world, self.two_view.x_in_world[self.two_view.inliers]])
        depth_m = self.estimate.world_from_camera.inverse().apply(x_in_world)[:, 2]
        return max(float(np.median(depth_m)), float(np.finfo(float).tiny))

    def inliers_by_reference(self) -> tuple[int, ...]:
        """Number of inliers on points that each reference observes, and of two-view inliers with it."""
        agreeing = np.zeros(len(self.structure.x_in_world), bool)
        agreeing[self.matches.point[self.estimate.inliers]] = True
        seen = self.structure.tracks.view[agreeing[self.structure.tracks.point]]
        if self.two_view is not None:
            seen = np.concatenate([seen, self.two_view.reference[self.two_view.inliers]])
        return tuple(np.bincount(seen, minlength=len(self.references)).tolist())
