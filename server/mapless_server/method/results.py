"""What the stages give one another: scale, structure, matches, pose. Data only; made in the stage of its name."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform, Similarity

from .arrays import (
    AnyArray,
)
from .priors.known import PriorCheck
from .priors.pose_only import reprojection_errors_px as reprojection_errors_px
from .tracks import Tracks
from .views import PosedView, View


class ScaleStage(str, Enum):
    """Which stage gave it."""

    TRIANGULATION = "triangulation"
    TRAJECTORY = "trajectory"


@dataclass(frozen=True, eq=False)
class MetricScale:
    """A reconstruction made metric.

    Attributes:
        metres_per_unit: S, above 0; metres per unit of the reconstruction.
        stage: which stage gave it.
        deviation: d of this scale, 0 and above.
        anchor: index of the reference whose pose ties the local frame to the world.
        world_from_local: the reconstruction's frame in the world, metres.
        world_from_query: the query camera's initial pose P_q^init, metres.
    """

    metres_per_unit: float
    stage: ScaleStage
    deviation: float
    anchor: int
    world_from_local: Similarity
    world_from_query: RigidTransform


@dataclass(frozen=True)
class KeypointNoise:
    """How far keypoints lie from where they should: sigma^2 = level^2 + (slope * size)^2.

    Attributes:
        level_px: what all keypoints share: detection, and what errors of poses and lenses look like in pixels. While it
            is being estimated, an array of that one number.
        slope: error per diameter of the patch; a blob of 20 px is found to a pixel, one of 3 px to a fifth. Measured on
            photographs with surveyed poses.
    """

    level_px: float
    slope: float

    def sigma_px(self, sizes_px: AnyArray) -> AnyArray:
        """Standard deviation (N,) of each coordinate of keypoints of these sizes (N,)."""
        return (self.level_px**2 + (self.slope * sizes_px) ** 2) ** 0.5


@dataclass(frozen=True, eq=False)
class Structure:
    """Points and the tracks they come from.

    Attributes:
        x_in_world: (P, 3) metres.
        tracks: of these points over the references, in the order of the points.
        noise: of the keypoints, as estimated from the residuals.
    """

    x_in_world: Array
    tracks: Tracks
    noise: KeypointNoise


@dataclass(frozen=True, eq=False)
class PointMatches:
    """2D-3D matches; no point and no keypoint stands twice.

    Attributes:
        point: (M,) index into the structure.
        keypoint: (M,) index into the query's keypoints.
        guided: (M,) whether the match was searched for near its projection, rather than found in the whole image.
        radius_px: how near.
    """

    point: NDArray[np.intp]
    keypoint: NDArray[np.intp]
    guided: NDArray[np.bool_]
    radius_px: float

    def __len__(self) -> int:
        return len(self.point)


class PoseStage(str, Enum):
    """Which stage gave the pose."""

    INITIAL = "initial"
    REFINED = "refined"
    COARSE = "coarse"
    """The initial one, because there was no time to refine it."""


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """What is known of a pose's error.

    Attributes:
        covariance: (6, 6) of world_from_camera, order x y z rx ry rz, fixed world axes, metres and radians.
        motions: (K, 6) how the pose would move, in the same coordinates, without each of its references.
        inflation: i, by how much the references' errors exceed those of independent matches.
    """

    covariance: Array
    motions: Array
    inflation: float


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """A pose, believed or not.

    Attributes:
        world_from_camera: metric.
        stage: whether it is the refined or the initial pose.
        inliers: (M,) which of the matches agree with it.
        errors_px: (M,) reprojection errors; NaN for points behind the camera.
        covariance: (6, 6), order x y z rx ry rz, fixed world axes, metres and radians.
        prior_checks: of each prior.
        uncertainty: what the covariance was computed from, before priors sharpened it; None where it is from the
            residuals alone, and errors that go together are not in it yet (see `pose_covariance`).
        without_priors: the estimate before priors were used; None where none were.
    """

    world_from_camera: RigidTransform
    stage: PoseStage
    inliers: NDArray[np.bool_]
    errors_px: Array
    covariance: Array
    prior_checks: tuple[PriorCheck, ...] = ()
    uncertainty: Uncertainty | None = None
    without_priors: PoseEstimate | None = None


@dataclass(frozen=True, eq=False)
class Support:
    """The matches of a query with the points of its references.

    Everything is in a world in which the first reference stands at the origin; `origin` says where that is in the
    caller's.

    Attributes:
        query: the photograph.
        references: in the order that the structure's tracks number them.
        structure: metric points and the references' keypoints that show them.
        matches: of the query with the points.
        estimate: the pose and which matches agree with it; None where there is none.
        origin: (3,) metres.
    """

    query: View
    references: tuple[PosedView, ...]
    structure: Structure
    matches: PointMatches
    estimate: PoseEstimate | None
    origin: Array

    def inliers_by_reference(self) -> tuple[int, ...]:
        """Per reference, inliers on points that it observes."""
        count = len(self.references)
        if self.estimate is None:
            return (0,) * count
        agreeing = np.zeros(len(self.structure.x_in_world), bool)
        agreeing[self.matches.point[self.estimate.inliers]] = True
        seen = self.structure.tracks.view[agreeing[self.structure.tracks.point]]
        return tuple(np.bincount(seen, minlength=count).tolist())
