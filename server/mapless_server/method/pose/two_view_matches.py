"""Two-view matches: keypoints of the query matched with keypoints of posed references, without a triangulated point.

With the query's camera centre c and rotation R (world from camera), a keypoint with the ray y in the query's frame and
the matched keypoint of a reference with centre c_r, rotation R_r and the ray a in its own frame satisfy

    e = (R y) . (b x R_r a) = 0,    b = c_r - c.

The Sampson distance |e| / |grad e| is, to first order, how far both keypoints together are from satisfying it, pixels;
grad e is the derivative by both keypoints,

    R^T (b x R_r a) / f    and    R_r^T (R y x b) / f_r    (their components x and y).

All of these are linear in b, hence in c: along a line of camera centres they cost two evaluations.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from mapless.geometry import Array, RigidTransform

from ..features.tracks import Tracks
from ..features.views import Matches, PosedView, View
from ..structure.observations import KeypointNoise, triangulate
from ..structure.structure import observe

MIN_TWO_VIEW = 8
"""Fewer two-view matches do not determine a pose with any redundancy."""


@dataclass(frozen=True, eq=False)
class TwoViewMatches:
    """Matches of one query with its references; row m is one match.

    Attributes:
        reference: (T,) index of the reference.
        keypoint: (T,) keypoint of the query; once for each reference at most.
        reference_keypoint: (T,) keypoint of the reference.
        ray: (T, 3) viewing ray in the query's frame, of depth 1.
        reference_ray: (T, 3) viewing ray of the reference, of depth 1 in its camera, in world axes.
        reference_centre: (T, 3) camera centre of the reference, metres, world frame.
        reference_rotation: (T, 3, 3) world from camera of the reference.
        focal_px, reference_focal_px: (T, 2) focal lengths along x and y.
    """

    reference: NDArray[np.intp]
    keypoint: NDArray[np.intp]
    reference_keypoint: NDArray[np.intp]
    ray: Array
    reference_ray: Array
    reference_centre: Array
    reference_rotation: Array
    focal_px: Array
    reference_focal_px: Array

    def __len__(self) -> int:
        return len(self.reference)

    def __getitem__(self, rows: NDArray[np.bool_]) -> "TwoViewMatches":
        return TwoViewMatches(*(getattr(self, name)[rows] for name in self.__dataclass_fields__))

    @staticmethod
    def of(query: View, references: Sequence[PosedView], query_matches: Sequence[Matches]) -> "TwoViewMatches":
        """Makes the matches from those (query keypoint, reference keypoint) with each reference."""
        count = [len(it) for it in query_matches]
        reference = np.repeat(np.arange(len(references)), count)
        pairs = np.concatenate([np.asarray(it, np.intp).reshape(-1, 2) for it in query_matches])
        rays = [
            it.view.camera.rays(it.view.features.keypoints[matches[:, 1]]) @ it.world_from_camera.rotation.T
            for it, matches in zip(references, query_matches, strict=True)
        ]
        poses, cameras = [it.world_from_camera for it in references], [it.view.camera for it in references]
        own = query.camera
        return TwoViewMatches(
            reference,
            pairs[:, 0],
            pairs[:, 1],
            own.rays(query.features.keypoints[pairs[:, 0]]),
            np.concatenate(rays),
            np.stack([it.translation for it in poses])[reference],
            np.stack([it.rotation for it in poses])[reference],
            np.tile([own.focal_x_px, own.focal_y_px], (len(pairs), 1)),
            np.array([(it.focal_x_px, it.focal_y_px) for it in cameras])[reference],
        )

    def sampson_px(self, world_from_query: RigidTransform) -> Array:
        """Sampson distances (T,) of the matches, pixels; NaN without a baseline."""
        return np.asarray(np.abs(self.signed_sampson_px(world_from_query)[0]))

    def read_as(self, query: View) -> "TwoViewMatches":
        """The same matches of the photograph, whose keypoints are read with other intrinsics."""
        camera = query.camera
        focal_px = np.tile([camera.focal_x_px, camera.focal_y_px], (len(self), 1))
        return replace(self, ray=camera.rays(query.features.keypoints[self.keypoint]), focal_px=focal_px)

    def signed_sampson_px(self, world_from_query: RigidTransform) -> tuple[Array, Array]:
        """The distances (T,) with their signs, and their derivatives (T, 4) by the pixels of query and reference."""
        rotation, centre = world_from_query.rotation, world_from_query.translation
        error, gradient = self._constraint(rotation, self.ray @ rotation.T, self.reference_centre - centre)
        length = np.linalg.norm(gradient, axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(error / length), np.asarray(gradient / length[:, None])

    def sampson_along_px(self, rotation: Array, centre: Array, direction: Array, distance: Array) -> Array:
        """Sampson distances (S, T) of queries at centre + distance * direction, for S distances."""
        in_world = self.ray @ rotation.T
        at_zero = self._constraint(rotation, in_world, self.reference_centre - centre)
        slope = self._constraint(rotation, in_world, np.broadcast_to(-direction, in_world.shape))
        error, gradient = (a + distance.reshape(-1, *[1] * a.ndim) * b for a, b in zip(at_zero, slope, strict=True))
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.asarray(np.abs(error) / np.linalg.norm(gradient, axis=2))

    def _constraint(self, rotation: Array, in_world: Array, baseline: Array) -> tuple[Array, Array]:
        """The error e (T,) and grad e (T, 4) for baselines b (T, 3)."""
        across = _cross(baseline, self.reference_ray)
        by_query = (across @ rotation)[:, :2] / self.focal_px
        reference_across = np.einsum("tji,tj->ti", self.reference_rotation[:, :, :2], _cross(in_world, baseline))
        by_reference = reference_across / self.reference_focal_px
        return (in_world * across).sum(axis=1), np.concatenate([by_query, by_reference], axis=1)

    def triangulated(
        self, query: View, references: Sequence[PosedView], world_from_query: RigidTransform, noise: KeypointNoise
    ) -> tuple[Array, Array]:
        """Points (T, 3) of the matches with the query at a pose, NaN behind a camera; and parallaxes (T,), degrees."""
        count, rows = len(self), np.arange(len(self))
        tracks = Tracks(
            np.repeat(rows, 2),
            np.stack([self.reference, np.full(count, len(references))], axis=1).ravel(),
            np.stack([self.reference_keypoint, self.keypoint], axis=1).ravel(),
        )
        observations = observe(tracks, [*references, PosedView("", "", query, world_from_query)], noise)
        points = triangulate(observations)
        in_front = (observations.in_camera(points)[2] > 0).reshape(-1, 2).all(axis=1)
        _, direction = observations.rays()
        cosine = (direction[:, ::2] * direction[:, 1::2]).sum(axis=0).clip(-1, 1)
        return np.where(in_front[:, None], points, np.nan), np.rad2deg(np.arccos(cosine))


def _cross(first: Array, second: Array) -> Array:
    """Cross products (T, 3); np.cross takes half as long again."""
    (a, b, c), (x, y, z) = first.T, second.T
    return np.stack([b * z - c * y, c * x - a * z, a * y - b * x], axis=1)
