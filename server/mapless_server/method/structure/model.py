"""Results that stages pass on: scale, structure, matches, pose. Data only; computed by the stage of the same name."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, Camera, RigidTransform, Similarity

if TYPE_CHECKING:  # services do not load what computes
    from ..features.tracks import Tracks
    from ..features.views import Rows, View
    from .observations import KeypointNoise

MIN_ADDED_SHARE = 0.4
"""Points of the query's own matches are added where there are so many for each match with a triangulated point."""


class ScaleStage(str, Enum):
    """The stage that gave the scale."""

    TRIANGULATION = "triangulation"
    TRAJECTORY = "trajectory"
    NETWORK = "network"
    """The network's own metres, with a single reference."""
    DEPTH = "depth"
    """The measured or kept depth of a single reference."""


class ScaleSource(str, Enum):
    """The basis of an answer's lengths."""

    REFERENCES = "references"
    """The references' given poses."""
    NETWORK = "network"
    """The metres that a network predicts, with a single reference."""
    DEPTH = "depth"
    """The depth that a sensor measured with a single reference."""


@dataclass(frozen=True, eq=False)
class MetricScale:
    """A reconstruction made metric.

    Attributes:
        metres_per_unit: S, above 0; metres per unit of the reconstruction.
        stage: the stage that gave it.
        deviation: the trajectory deviation d of this scale, 0 or more.
        anchor: index of the reference whose pose ties the local frame to the world.
        world_from_local: the reconstruction's frame in the world, metres.
        world_from_query: the query camera's initial pose P_q^init, metres.
        relative_sigma: standard deviation of the depths' common factor, if they give the scale; otherwise 0.
        is_measured: whether a sensor measured the depths that give the scale.
    """

    metres_per_unit: float
    stage: ScaleStage
    deviation: float
    anchor: int
    world_from_local: Similarity
    world_from_query: RigidTransform
    relative_sigma: float = 0.0
    is_measured: bool = False

    @property
    def source(self) -> ScaleSource:
        """The basis of the scale."""
        if self.is_measured:
            return ScaleSource.DEPTH
        return ScaleSource.NETWORK if self.is_from_depth else ScaleSource.REFERENCES

    @property
    def is_from_depth(self) -> bool:
        """Whether the depths of a single reference give it."""
        return self.stage in (ScaleStage.NETWORK, ScaleStage.DEPTH)


@dataclass(frozen=True, eq=False)
class DepthPlanes:
    """Planes from depths: each of P points is near a plane, normal . x = offset, or near none.

    Attributes:
        normal: (P, 3) unit vectors, world.
        offset: (P,) metres.
        information: (P,) inverse variance of the distance from the plane; 0 if unknown.
        view: (P,) the reference whose depth it is.
        common: (P, 2) change of the offset by one standard deviation of each of the independent errors that all depths
            of the reference share, metres.
    """

    normal: Array
    offset: Array
    information: Array
    view: NDArray[np.intp]
    common: Array

    def __getitem__(self, points: Rows) -> DepthPlanes:
        columns = self.offset[points], self.information[points], self.view[points], self.common[points]
        return DepthPlanes(self.normal[points], *columns)

    @staticmethod
    def unknown(count: int) -> DepthPlanes:
        """Planes of points that are near none."""
        nothing = np.zeros(count)
        return DepthPlanes(np.zeros((count, 3)), nothing, nothing, np.zeros(count, np.intp), np.zeros((count, 2)))

    def and_last(self, others: DepthPlanes) -> DepthPlanes:
        """Appends the planes of further points."""
        names = ("normal", "offset", "information", "view", "common")
        return DepthPlanes(*(np.concatenate([getattr(self, it), getattr(others, it)]) for it in names))

    def cost(self, x_in_world: Array) -> float:
        """Sum over the points (P, 3) of their squared distances, in standard deviations."""
        return float(self.information @ self.distance(x_in_world) ** 2)

    def distance(self, x_in_world: Array) -> Array:
        """Signed distances (P,) of points (P, 3) from their planes."""
        return np.asarray((self.normal * x_in_world).sum(axis=1) - self.offset)


@dataclass(frozen=True, eq=False)
class Structure:
    """Points and their tracks.

    Attributes:
        x_in_world: (P, 3) metres.
        tracks: observations of these points by the references, in the order of the points.
        noise: noise of the keypoints, estimated from the residuals.
        planes: planes of the points, if references have depths; points that a single reference observes are
            last.
    """

    x_in_world: Array
    tracks: Tracks
    noise: KeypointNoise
    planes: DepthPlanes | None = None

    @property
    def triangulated(self) -> NDArray[np.bool_]:
        """Mask (P,) of the points that several references observe."""
        if self.planes is None:
            return np.ones(len(self.x_in_world), bool)
        return np.bincount(self.tracks.point, minlength=len(self.x_in_world)) > 1

    @property
    def size_bytes(self) -> int:
        """Memory of points and tracks, bytes."""
        tracks = self.tracks
        return self.x_in_world.nbytes + tracks.point.nbytes + tracks.view.nbytes + tracks.keypoint.nbytes

    def moved(self, order: Sequence[int], offset: Array) -> Structure:
        """The triangulated structure with view v renumbered order[v], and an offset (3,) added to the points.

        Points are in the order of their first keypoints, as in `build_tracks`.
        """
        if not len(self.x_in_world):
            return self
        tracks, view = self.tracks, np.asarray(order, np.intp)[self.tracks.view]
        keypoint = view * (tracks.keypoint.max() + 1) + tracks.keypoint  # counted through all references
        points = np.argsort(np.minimum.reduceat(keypoint, tracks.starts))
        moved = tracks.in_order(np.argsort(points)[tracks.point], view, tracks.keypoint)
        return Structure(self.x_in_world[points] + offset, moved, self.noise)

    def shifted(self, offset: Array) -> Structure:
        """The structure in a world in which everything lies `offset` (3,) further."""
        planes = self.planes and replace(self.planes, offset=self.planes.offset + self.planes.normal @ offset)
        return Structure(self.x_in_world + offset, self.tracks, self.noise, planes)

    def and_last(self, x_in_world: Array, tracks: Tracks, planes: DepthPlanes | None = None) -> Structure:
        """Appends points (Q, 3) with their tracks; without `planes`, none of these is near a plane."""
        both = self.tracks.and_last(tracks, len(self.x_in_world))
        if self.planes is not None:
            planes = self.planes.and_last(planes or DepthPlanes.unknown(len(x_in_world)))
        return Structure(np.concatenate([self.x_in_world, x_in_world]), both, self.noise, planes)


@dataclass(frozen=True, eq=False)
class PixelPoints:
    """Points, and where a photograph shows them.

    Attributes:
        camera: pinhole camera of the photograph.
        x_in_world: (N, 3) metres.
        pixels: (N, 2) in pixels of the camera.
    """

    camera: Camera
    x_in_world: Array
    pixels: Array

    def __len__(self) -> int:
        return len(self.pixels)

    def __getitem__(self, rows: Rows) -> PixelPoints:
        return PixelPoints(self.camera, self.x_in_world[rows], self.pixels[rows])

    def errors_px(self, world_from_camera: RigidTransform) -> Array:
        """Distances (N,) of the points' projections from their pixels at a pose; NaN behind the camera."""
        projected = self.camera.project(world_from_camera.inverse().apply(self.x_in_world))
        return np.asarray(np.linalg.norm(projected - self.pixels, axis=1))

    def inlier_count(self, world_from_camera: RigidTransform, inlier_px: float) -> int:
        """Number of points with a smaller error at a pose."""
        return int((self.errors_px(world_from_camera) < inlier_px).sum())


@dataclass(frozen=True, eq=False)
class PointMatches:
    """2D-3D matches; each point and each keypoint occurs at most once.

    Attributes:
        point: (M,) index into the structure.
        keypoint: (M,) index into the query's keypoints.
        guided: (M,) whether the match was searched near the point's projection, rather than in the whole image.
        radius_px: radius of that search.
    """

    point: NDArray[np.intp]
    keypoint: NDArray[np.intp]
    guided: NDArray[np.bool_]
    radius_px: float

    def __len__(self) -> int:
        return len(self.point)

    def unguided(self) -> PointMatches:
        """The matches of the whole image; all, if all were searched near projections."""
        return self if self.guided.all() else self.select(~self.guided)

    def seen(self, query: View, x_in_world: Array) -> PixelPoints:
        """The matched points, of all points (P, 3) of the structure, with the query's keypoints."""
        return PixelPoints(query.camera, x_in_world[self.point], query.features.pixels(self.keypoint))

    def select(self, rows: Rows) -> PointMatches:
        """Some of the matches."""
        return PointMatches(self.point[rows], self.keypoint[rows], self.guided[rows], self.radius_px)

    def and_last(
        self, point: NDArray[np.intp], keypoint: NDArray[np.intp], guided: NDArray[np.bool_] | None = None
    ) -> PointMatches:
        """Appends matches, by default of the whole image."""
        guided = np.zeros(len(point), bool) if guided is None else guided
        return PointMatches(
            np.concatenate([self.point, point]),
            np.concatenate([self.keypoint, keypoint]),
            np.concatenate([self.guided, guided]),
            self.radius_px,
        )
